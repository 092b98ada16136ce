"""What the installed plugins offer, by kind and name."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from labseq.errors import PluginLoadError, UnknownPluginError

KINDS: Final = (
    "planner",
    "camera",
    "static_tweezers",
    "mobile_tweezers",
    "detector",
    "device",
    "lines",
    "step",
    "pattern",
    "simulation",
    "analysis",
)
"""Kinds of plugin that the registry knows."""

VIRTUAL_TWIN: Final = "virtual"
"""Name under which a plugin offers the virtual twin of a hardware role."""

Factory = Callable[..., Any]


@dataclass(frozen=True, slots=True)
class Entry:
    """One thing that a plugin offers.

    Attributes:
        kind: One of :data:`KINDS`.
        name: The name that a sequence or profile uses.
        factory: ``factory(settings, context)``; steps: ``factory(settings)``;
            patterns: ``factory(settings, grid)``.
        settings_model: pydantic model of its settings, a subclass of
            ``labseq.Settings``; None if it takes none.
        origin: Name of the plugin that registered it.
        virtual_time: Whether it keeps to the session's clock only, so that a run
            need not wait in real time.
        simulated: Settings that turn a driver into its own simulated counterpart, for
            example ``{"card": "simulated"}``; None if it has none. A dry run gives them;
            a driver that has them keeps to the session's clock.
    """

    kind: str
    name: str
    factory: Factory
    settings_model: type[Any] | None
    origin: str
    virtual_time: bool = False
    simulated: Mapping[str, Any] | None = None


class Registry:
    """Filled by the plugins' ``labseq_register``; read by the session.

    Every method ``registry.<kind>(name, factory, settings_model)`` adds an entry.
    A name that is taken is an error that names both origins.

    Attributes:
        contested: Kind and name of what more than one plugin offers, and what is said of that.
    """

    def __init__(self) -> None:
        self.contested: dict[tuple[str, str], PluginLoadError] = {}
        self._entries: dict[tuple[str, str], Entry] = {}
        self._origin = "labseq"

    def set_origin(self, origin: str) -> None:
        """Name the plugin whose ``labseq_register`` is called next."""
        self._origin = origin

    def drop_origin(self, origin: str) -> None:
        """Forget everything that a plugin registered."""
        self._entries = {key: e for key, e in self._entries.items() if e.origin != origin}

    def _add(
        self,
        kind: str,
        name: str,
        factory: Factory,
        settings_model: type[Any] | None,
        *,
        virtual_time: bool = False,
        simulated: Mapping[str, Any] | None = None,
    ) -> None:
        if not isinstance(name, str) or not name:  # pyright: ignore[reportUnnecessaryIsInstance]
            raise PluginLoadError(self._origin, f"a {kind} needs a name, not {name!r}")
        if not callable(factory):
            raise PluginLoadError(self._origin, f"the factory of {kind} '{name}' cannot be called")
        taken = self._entries.get((kind, name))
        if taken is not None:
            text = f"{kind} '{name}' is offered by '{taken.origin}' already; rename one of them"
            error = PluginLoadError(self._origin, text)
            if taken.origin != self._origin:
                self.contested[kind, name] = error
            raise error
        if settings_model is not None and not callable(getattr(settings_model, "model_validate_json", None)):
            text = f"the settings model of {kind} '{name}' is {settings_model!r}"
            raise PluginLoadError(self._origin, f"{text}; expected a subclass of labseq.Settings")
        self._entries[kind, name] = Entry(
            kind, name, factory, settings_model, self._origin, virtual_time, simulated
        )

    def planner(self, name: str, factory: Factory, settings_model: type[Any] | None = None) -> None:
        """Offer a planner: ``factory(settings, context) -> Planner``."""
        self._add("planner", name, factory, settings_model)

    def detector(self, name: str, factory: Factory, settings_model: type[Any] | None = None) -> None:
        """Offer a detector: ``factory(settings, context) -> Detector``."""
        self._add("detector", name, factory, settings_model)

    def step(self, name: str, factory: Factory, settings_model: type[Any] | None = None) -> None:
        """Offer a step of a shot: ``factory(settings) -> Step``."""
        self._add("step", name, factory, settings_model)

    def pattern(self, name: str, factory: Factory, settings_model: type[Any] | None = None) -> None:
        """Offer a target pattern: ``factory(settings, grid) -> TargetPattern``."""
        self._add("pattern", name, factory, settings_model)

    def simulation(self, name: str, factory: Factory, settings_model: type[Any] | None = None) -> None:
        """Offer a simulated world: ``factory(settings, context) -> Simulation``."""
        self._add("simulation", name, factory, settings_model, virtual_time=True)

    def analysis(self, name: str, factory: Factory, settings_model: type[Any] | None = None) -> None:
        """Offer an analysis of shots: ``factory(settings, context) -> Analysis``."""
        self._add("analysis", name, factory, settings_model)

    def camera(
        self, name: str, factory: Factory, settings_model: type[Any] | None = None, **options: Any
    ) -> None:
        """Offer a camera. Options: ``virtual_time``, ``simulated`` (see :class:`Entry`)."""
        self._add("camera", name, factory, settings_model, **options)

    def static_tweezers(
        self, name: str, factory: Factory, settings_model: type[Any] | None = None, **options: Any
    ) -> None:
        """Offer static tweezers. Options as for :meth:`camera`."""
        self._add("static_tweezers", name, factory, settings_model, **options)

    def mobile_tweezers(
        self, name: str, factory: Factory, settings_model: type[Any] | None = None, **options: Any
    ) -> None:
        """Offer mobile tweezers. Options as for :meth:`camera`."""
        self._add("mobile_tweezers", name, factory, settings_model, **options)

    def device(
        self, name: str, factory: Factory, settings_model: type[Any] | None = None, **options: Any
    ) -> None:
        """Offer any other instrument. Options as for :meth:`camera`."""
        self._add("device", name, factory, settings_model, **options)

    def lines(
        self, name: str, factory: Factory, settings_model: type[Any] | None = None, **options: Any
    ) -> None:
        """Offer a timing box that switches lines. Options as for :meth:`camera`."""
        self._add("lines", name, factory, settings_model, **options)

    def get(self, kind: str, name: str) -> Entry:
        """Find an entry.

        Raises:
            UnknownPluginError: Nothing of that kind has this name.
        """
        entry = self._entries.get((kind, name))
        if entry is None:
            known = self.names(kind)
            close = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean '{close[0]}'?" if close else ""
            raise UnknownPluginError(kind, name, known, hint)
        return entry

    def find(self, kind: str, name: str) -> Entry | None:
        """Find an entry, or None."""
        return self._entries.get((kind, name))

    def names(self, kind: str) -> list[str]:
        """Names of all entries of a kind, sorted."""
        return sorted(name for k, name in self._entries if k == kind)

    def entries(self, origin: str | None = None) -> list[Entry]:
        """All entries, or those of one plugin, by kind and name."""
        found = [e for e in self._entries.values() if origin in (None, e.origin)]
        return sorted(found, key=lambda e: (KINDS.index(e.kind), e.name))
