"""The registry of everything that the installed plugins offer, by kind and name."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from labseq.errors import PluginLoadError, UnknownPluginError
from labseq.roles.table import ROLES, Role

VIRTUAL_TWIN: Final = "virtual"
"""Name under which a plugin offers the virtual twin of a hardware role."""

LOAD_S: Final = 30.0
"""Default time limit for a plugin to load, and for a constructor to return."""

_NAME: Final = re.compile(r"[^\W\d][\w-]{0,63}")

Factory = Callable[..., Any]
FactoryOrPlace = Factory | str
ModelOrPlace = type[Any] | str | None
Call = Callable[["Owner", str, Callable[[], Any]], Any]
"""Function that runs code of a plugin, ``call(owner, what, work)``."""


@dataclass(frozen=True, slots=True, eq=False)
class Owner:
    """The plugin that offers something, with its name for error messages and the time limit for its code.

    Attributes:
        name: Name of the plugin.
        source: Its file or its distribution, as text. "" for labseq's own.
        home: The file or the folder that its code is in, or None if that is not known.
        max_wait_s: Time limit for it to load, and for a constructor to return.
        notes: Its output when it was loaded, or in a constructor.
    """

    name: str
    source: str = ""
    home: Path | None = None
    max_wait_s: float = LOAD_S
    notes: list[str] = field(default_factory=list[str])

    def fault(self, reason: str) -> PluginLoadError:
        """The error that names this plugin."""
        return PluginLoadError(self.name, reason, self.source)

    def note(self, sentence: str) -> None:
        """Add a note about the plugin, unless it is there already."""
        if sentence not in self.notes:
            self.notes.append(sentence)


@dataclass(frozen=True, slots=True)
class Entry:
    """One thing that a plugin offers.

    Attributes:
        kind: Name of its role, one of :data:`labseq.roles.ROLES`, or "fit".
        name: The name that a sequence or profile uses.
        factory: ``factory(settings, context)``. For steps ``factory(settings)``, for patterns
            ``factory(settings, grid)``, for scanners ``factory(settings, space)``. An installed plugin may
            give the place of factory, settings and ``simulated`` as text, ``"package.module:Name"``. They are
            imported when they are first needed.
        settings_model: pydantic model of its settings, a subclass of ``labseq.plugin.Settings``, or its
            place. None if it takes none.
        owner: The plugin that registered it.
        virtual_time: Whether it keeps to the session's clock only, so that a run need not wait in real time.
        simulated: Settings that make a driver use its simulated device, for example
            ``{"card": "simulated"}``. None if it has none. A dry run uses them. A driver that has them keeps
            to the session's clock. A place may lead to a function that returns them, or that returns as text
            why the device cannot be simulated on this computer.
        no_simulator: Reason why the device cannot be simulated on this computer, or "" if it can.
        units: Units of the parameters of a fit, see :meth:`Registry.fit`.
    """

    kind: str
    name: str
    factory: Factory
    settings_model: type[Any] | None
    owner: Owner = field(compare=False, repr=False)
    virtual_time: bool = False
    simulated: Mapping[str, Any] | None = None
    no_simulator: str = ""
    units: Mapping[str, str] = field(default_factory=dict[str, str])

    @property
    def origin(self) -> str:
        """Name of the plugin that registered the entry."""
        return self.owner.name

    @property
    def role(self) -> Role:
        """The role that it plays."""
        return ROLES[self.kind]

    @property
    def is_place(self) -> bool:
        """Whether parts of it are still given as places and not imported yet."""
        return any(isinstance(part, str) and ":" in part for part in (self.factory, self.settings_model))


class Registry:
    """Everything that plugins offer, added in their ``labseq_register`` and read by the session.

    Every method ``registry.<kind>(name, factory, settings_model)`` adds an entry. A name that is taken raises
    an error that names both plugins.

    Attributes:
        contested: Kind and name that more than one plugin offers -> the error.
        used: Kind and name of each entry requested by :meth:`get` -> the plugin that offers it.
    """

    def __init__(self, call: Call = lambda _owner, _what, work: work()) -> None:
        self._call = call
        self.contested: dict[tuple[str, str], PluginLoadError] = {}
        self.used: dict[tuple[str, str], str] = {}
        self._entries: dict[tuple[str, str], Entry] = {}
        self._owner = Owner("labseq")
        self._is_closed = False

    @contextmanager
    def opened_for(self, owner: Owner) -> Generator[Registry]:
        """The registry that a plugin registers with, within the block.

        If the block fails, all entries of the plugin are removed.
        """
        # each plugin gets its own, so that a plugin that keeps it can be refused later
        registry = Registry(self._call)
        registry._owner, registry._entries, registry.contested = owner, self._entries, self.contested
        registry.used = self.used
        try:
            yield registry
        except BaseException:
            registry._is_closed = True  # first, because the thread of a plugin that hung may still register
            self.forget(owner.name)
            raise
        finally:
            registry._is_closed = True

    def _add(
        self,
        kind: str,
        name: str,
        factory: FactoryOrPlace,
        settings_model: ModelOrPlace,
        *,
        virtual_time: bool = False,
        simulated: Mapping[str, Any] | str | None = None,
        units: Mapping[str, str] | None = None,
    ) -> None:
        fault = self._owner.fault
        if not isinstance(name, str) or not name:  # pyright: ignore[reportUnnecessaryIsInstance]
            raise fault(f"a {kind} needs a name, not {name!r}")
        is_key = (kind, name) == ("step", "name")  # a key next to a step in a sequence
        # YAML does not read these words as text
        if _NAME.fullmatch(name) is None or name.lower() in {"true", "false", "null"} or is_key:
            message = f"a {kind} cannot be called {name[:80]!r}"
            raise fault(
                f"{message}; expected a letter, then letters, digits, '_' and '-', "
                "and not 'true', 'false' or 'null'"
            )
        if self._is_closed:
            message = f"it registers {kind} '{name}' after its labseq_register has returned"
            raise fault(f"{message}; register everything there")
        taken = self._entries.get((kind, name))
        if taken is not None:
            message = f"{kind} '{name}' is already offered by '{taken.origin}'; rename one of them"
            error = fault(message)
            if taken.origin != self._owner.name:
                self.contested[kind, name] = error
            raise error
        parts: tuple[Any, Any, Any] = factory, settings_model, simulated  # of any type until they are checked
        entry = Entry(kind, name, *parts[:2], self._owner, virtual_time, parts[2], units=units or {})
        if not entry.is_place:
            _check(entry)
        self._entries[kind, name] = entry

    def forget(self, origin: str) -> None:
        """Remove all entries of a plugin."""
        for key in self.offers(origin):
            del self._entries[key]

    def planner(self, name: str, factory: FactoryOrPlace, settings_model: ModelOrPlace = None) -> None:
        """Offer a planner: ``factory(settings, context) -> Planner``."""
        self._add("planner", name, factory, settings_model)

    def detector(self, name: str, factory: FactoryOrPlace, settings_model: ModelOrPlace = None) -> None:
        """Offer a detector: ``factory(settings, context) -> Detector``."""
        self._add("detector", name, factory, settings_model)

    def step(self, name: str, factory: FactoryOrPlace, settings_model: ModelOrPlace = None) -> None:
        """Offer a step of a shot: ``factory(settings) -> Step``."""
        self._add("step", name, factory, settings_model)

    def pattern(self, name: str, factory: FactoryOrPlace, settings_model: ModelOrPlace = None) -> None:
        """Offer a target pattern: ``factory(settings, grid) -> TargetPattern``."""
        self._add("pattern", name, factory, settings_model)

    def simulation(self, name: str, factory: FactoryOrPlace, settings_model: ModelOrPlace = None) -> None:
        """Offer a simulation: ``factory(settings, context) -> Simulation``."""
        self._add("simulation", name, factory, settings_model, virtual_time=True)

    def scanner(self, name: str, factory: FactoryOrPlace, settings_model: ModelOrPlace = None) -> None:
        """Offer a scanner for adaptive scans: ``factory(settings, space) -> Scanner``."""
        self._add("scanner", name, factory, settings_model)

    def analysis(self, name: str, factory: FactoryOrPlace, settings_model: ModelOrPlace = None) -> None:
        """Offer an analysis of shots: ``factory(settings, context) -> Analysis``."""
        self._add("analysis", name, factory, settings_model)

    def fit(self, name: str, factory: FactoryOrPlace, units: Mapping[str, str] | None = None) -> None:
        """Offer a model to ``--fit``: ``factory() -> lmfit.Model``. It plays no role in a run.

        Args:
            name: Its name.
            factory: Makes the model, or the place of such a function.
            units: Parameter -> its unit, which is "x" for the unit of the scanned value, "y" for the unit of
                the quantity, "1/x", "y/x" or an SI unit.
        """
        self._add("fit", name, factory, None, units=units)

    def camera(
        self, name: str, factory: FactoryOrPlace, settings_model: ModelOrPlace = None, **options: Any
    ) -> None:
        """Offer a camera. Options: ``virtual_time``, ``simulated`` (see :class:`Entry`)."""
        self._add("camera", name, factory, settings_model, **options)

    def static_tweezers(
        self, name: str, factory: FactoryOrPlace, settings_model: ModelOrPlace = None, **options: Any
    ) -> None:
        """Offer static tweezers. Options as for :meth:`camera`."""
        self._add("static_tweezers", name, factory, settings_model, **options)

    def mobile_tweezers(
        self, name: str, factory: FactoryOrPlace, settings_model: ModelOrPlace = None, **options: Any
    ) -> None:
        """Offer mobile tweezers. Options as for :meth:`camera`."""
        self._add("mobile_tweezers", name, factory, settings_model, **options)

    def device(
        self, name: str, factory: FactoryOrPlace, settings_model: ModelOrPlace = None, **options: Any
    ) -> None:
        """Offer any other instrument. Options as for :meth:`camera`."""
        self._add("device", name, factory, settings_model, **options)

    def lines(
        self, name: str, factory: FactoryOrPlace, settings_model: ModelOrPlace = None, **options: Any
    ) -> None:
        """Offer a timing box that switches lines. Options as for :meth:`camera`."""
        self._add("lines", name, factory, settings_model, **options)

    def find(self, kind: str, name: str) -> Entry | None:
        """Find an entry, and import the parts given only by their place. None if there is no such entry.

        Raises:
            PluginLoadError: It cannot be imported.
        """
        entry = self._entries.get((kind, name))
        if entry is None or not entry.is_place:
            return entry
        parts = (entry.factory, entry.settings_model, entry.simulated)
        work = f"the import of {kind} '{name}'"
        factory, model, simulated = self._call(entry.owner, work, lambda: [*map(_import_place, parts)])
        simulated = simulated() if callable(simulated) else simulated
        reason, simulated = (simulated, None) if isinstance(simulated, str) else ("", simulated)
        entry = replace(
            entry, factory=factory, settings_model=model, simulated=simulated, no_simulator=reason
        )
        _check(entry)
        self._entries[kind, name] = entry
        return entry

    def get(self, kind: str, name: str) -> Entry:
        """Find an entry in order to use it. Plugins that build on another plugin call this, too.

        Raises:
            UnknownPluginError: There is no such entry.
            PluginLoadError: It cannot be imported.
        """
        entry = self.find(kind, name)
        if entry is None:
            raise UnknownPluginError(kind, name, self.names(kind))
        self.used[kind, name] = entry.origin
        return entry

    def names(self, kind: str) -> list[str]:
        """Names of all entries of a kind, sorted."""
        return sorted(name for k, name in self._entries if k == kind)

    def offers(self, origin: str | None = None) -> list[tuple[str, str]]:
        """Kind and name of all entries, or of a plugin's entries, sorted. Nothing is imported."""
        keys = [key for key, entry in self._entries.items() if origin in (None, entry.origin)]
        order = [*ROLES, "fit"]
        return sorted(keys, key=lambda key: (order.index(key[0]), key[1]))

    def entries(self, origin: str | None = None) -> list[Entry]:
        """All entries, or the entries of one plugin, by kind and name."""
        return [entry for key in self.offers(origin) if (entry := self.find(*key)) is not None]


def _import_place(value: Any) -> Any:
    """The object at ``"package.module:Name"``. Any other value is returned unchanged."""
    if not isinstance(value, str):
        return value
    module, _, name = value.partition(":")
    return getattr(importlib.import_module(module), name)


def _check(entry: Entry) -> None:
    """Raise for a factory, a settings model or simulated settings that cannot be used."""
    fault, model, simulated = entry.owner.fault, entry.settings_model, entry.simulated
    label = f"{entry.kind} '{entry.name}'"
    if not callable(entry.factory):
        raise fault(f"the factory of {label} cannot be called")
    if model is not None and not _is_settings(model):
        message = f"the settings model of {label} is {model!r:.200}"
        raise fault(f"{message}; expected a subclass of labseq.plugin.Settings")
    if simulated is not None:
        fields = {} if model is None else model.model_fields
        if not isinstance(simulated, Mapping) or not set(simulated) <= set(fields):  # pyright: ignore[reportUnnecessaryIsInstance]
            message = f"'simulated' of {label} is {simulated!r:.200}"
            raise fault(f"{message}; expected settings of its model")


def _is_settings(model: object) -> bool:
    """Whether this is a subclass of ``Settings``, recognised by name because that is in a higher layer."""
    return isinstance(model, type) and any(
        (base.__module__, base.__qualname__) == ("labseq.settings", "Settings") for base in model.__mro__
    )
