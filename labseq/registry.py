"""What the installed plugins offer, by kind and name."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
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
    "scanner",
    "analysis",
)
"""Kinds of plugin that the registry knows."""

VIRTUAL_TWIN: Final = "virtual"
"""Name under which a plugin offers the virtual twin of a hardware role."""

LOAD_S: Final = 30.0
"""Default for how long a plugin may take to load, and a constructor to return."""

_NAME: Final = re.compile(r"[^\W\d][\w-]{0,63}")
_NOT_NAMES: Final = {"true", "false", "null"}
"""Words that YAML does not read as text."""
_SETTINGS: Final = ("labseq.settings", "Settings")

Factory = Callable[..., Any]


@dataclass(frozen=True, slots=True, eq=False)
class Owner:
    """The plugin that offers something: its name for error messages, and how long to wait for its code.

    Attributes:
        name: Name of the plugin.
        source: Its file or its distribution, as text; "" for labseq's own.
        home: The file or the folder that its code is in; None if that is not known.
        max_wait_s: How long it may take to load, and a constructor to return.
        notes: What it printed when it was loaded, or in a constructor.
    """

    name: str
    source: str = ""
    home: Path | None = None
    max_wait_s: float = LOAD_S
    notes: list[str] = field(default_factory=list[str])

    def fault(self, reason: str) -> PluginLoadError:
        """The error that names this plugin."""
        return PluginLoadError(self.name, reason, self.source)

    def note(self, text: str) -> None:
        """Keep a sentence about it, once."""
        if text not in self.notes:
            self.notes.append(text)


@dataclass(frozen=True, slots=True)
class Entry:
    """One thing that a plugin offers.

    Attributes:
        kind: One of :data:`KINDS`.
        name: The name that a sequence or profile uses.
        factory: ``factory(settings, context)``; steps: ``factory(settings)``;
            patterns: ``factory(settings, grid)``; scanners: ``factory(settings, space)``.
        settings_model: pydantic model of its settings, a subclass of
            ``labseq.plugin.Settings``; None if it takes none.
        origin: Name of the plugin that registered it.
        virtual_time: Whether it keeps to the session's clock only, so that a run
            need not wait in real time.
        simulated: Settings that make a driver use its simulated device, for
            example ``{"card": "simulated"}``; None if it has none. A dry run gives them;
            a driver that has them keeps to the session's clock.
        owner: The plugin that registered it.
    """

    kind: str
    name: str
    factory: Factory
    settings_model: type[Any] | None
    origin: str
    virtual_time: bool = False
    simulated: Mapping[str, Any] | None = None
    owner: Owner = field(default=Owner("labseq"), compare=False, repr=False)


class Registry:
    """Filled by the plugins' ``labseq_register``; read by the session.

    Every method ``registry.<kind>(name, factory, settings_model)`` adds an entry.
    A name that is taken is an error that names both origins.

    Attributes:
        contested: Kind and name that more than one plugin offers -> the error.
    """

    def __init__(self) -> None:
        self.contested: dict[tuple[str, str], PluginLoadError] = {}
        self._entries: dict[tuple[str, str], Entry] = {}
        self._owner = Owner("labseq")
        self._is_closed = False

    @contextmanager
    def opened_for(self, owner: Owner) -> Generator[Registry]:
        """The registry that a plugin registers with, within the block.

        Nothing of the plugin stays if the block fails.
        """
        own = Registry()
        own._owner, own._entries, own.contested = owner, self._entries, self.contested
        try:
            yield own
        except BaseException:
            own._is_closed = True
            for entry in self.entries(owner.name):
                del self._entries[entry.kind, entry.name]
            raise
        finally:
            own._is_closed = True

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
        fault = self._owner.fault
        if not isinstance(name, str) or not name:  # pyright: ignore[reportUnnecessaryIsInstance]
            raise fault(f"a {kind} needs a name, not {name!r}")
        is_key = (kind, name) == ("step", "name")  # a key next to a step in a sequence
        if _NAME.fullmatch(name) is None or name.lower() in _NOT_NAMES or is_key:
            text = f"a {kind} cannot be called {name[:80]!r}"
            raise fault(f"{text}; expected a letter, then letters, digits, '_' and '-', and no word of YAML")
        if self._is_closed:
            text = f"it registers {kind} '{name}' after its labseq_register has returned"
            raise fault(f"{text}; register everything there")
        if not callable(factory):
            raise fault(f"the factory of {kind} '{name}' cannot be called")
        taken = self._entries.get((kind, name))
        if taken is not None:
            text = f"{kind} '{name}' is offered by '{taken.origin}' already; rename one of them"
            error = fault(text)
            if taken.origin != self._owner.name:
                self.contested[kind, name] = error
            raise error
        if settings_model is not None and not _is_settings(settings_model):
            text = f"the settings model of {kind} '{name}' is {settings_model!r:.200}"
            raise fault(f"{text}; expected a subclass of labseq.plugin.Settings")
        if simulated is not None:
            known = {} if settings_model is None else settings_model.model_fields
            if not isinstance(simulated, Mapping) or not set(simulated) <= set(known):  # pyright: ignore[reportUnnecessaryIsInstance]
                text = f"'simulated' of {kind} '{name}' is {simulated!r:.200}"
                raise fault(f"{text}; expected settings of its model")
        self._entries[kind, name] = Entry(
            kind, name, factory, settings_model, self._owner.name, virtual_time, simulated, self._owner
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
        """Offer a simulation: ``factory(settings, context) -> Simulation``."""
        self._add("simulation", name, factory, settings_model, virtual_time=True)

    def scanner(self, name: str, factory: Factory, settings_model: type[Any] | None = None) -> None:
        """Offer a scanner for adaptive scans: ``factory(settings, space) -> Scanner``."""
        self._add("scanner", name, factory, settings_model)

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


def _is_settings(model: object) -> bool:
    """Whether this is a subclass of ``Settings``, recognised by name: that is in a higher layer."""
    return isinstance(model, type) and any(
        (base.__module__, base.__qualname__) == _SETTINGS for base in model.__mro__
    )
