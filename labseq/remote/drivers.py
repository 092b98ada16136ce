"""The driver that a server constructs for a client, and the methods that the client may call.

Each client has its own driver object. Several may exist at a time, but only one may be open.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

from labseq.assembly.lab import construct
from labseq.assembly.plugin_choice import ChosenPlugin
from labseq.errors import ConfigError, DeviceError, LabseqError, Problem
from labseq.files import devices_root
from labseq.guard import Guard, StopFlag
from labseq.kernels.kernel import load_kernels
from labseq.messages import format_error
from labseq.model import CalibrationEntry, LineSpec, MotionSpec, SiteGrid
from labseq.recording import clear_active, mark_active
from labseq.roles import ROLES, Context, overrides
from labseq.sequencer.clock import RealClock
from labseq.sequencer.lab import attempt
from labseq.watchdog import Watchdog

_COMMON: Final = frozenset(
    {"safe_state", "describe", "versions", "warm", "settle", "self_test", "poll", "check_interlocks"}
)
METHODS: Final[Mapping[str, frozenset[str]]] = {
    "camera": _COMMON | {"arm", "disarm", "trigger", "read"},
    "static_tweezers": _COMMON | {"load", "load_weights", "start", "ramp", "release", "leave_on"},
    "mobile_tweezers": _COMMON | {"check_program", "prepare", "play", "wait", "prepare_beginning", "append"},
    "device": _COMMON | {"command", "read", "check_command"},
    "lines": _COMMON | {"check_program", "idle", "compile", "arm", "fire", "wait"},
}
"""Kind of device -> methods that clients may call, besides ``open`` and ``close``."""
DESCRIBING: Final = frozenset({"describe", "versions"})
"""Methods that any client may call, always on the driver of the client that has opened the device."""
_WITHOUT_OPENING: Final = DESCRIBING | {"safe_state", "warm", "check_program", "check_command"}

_HARDWARE_PROPERTIES: Final = ("settling_timeout_s", "idle_output")
_PLAYING_PROPERTIES: Final = ("start_delay_s", "beginning_s")
_PROPERTIES: Final[Mapping[str, tuple[str, ...]]] = {
    "camera": (*_HARDWARE_PROPERTIES, "facts"),
    "static_tweezers": (*_HARDWARE_PROPERTIES, "facts"),
    "mobile_tweezers": (*_HARDWARE_PROPERTIES, "waits_for_trigger", *_PLAYING_PROPERTIES),
    "device": _HARDWARE_PROPERTIES,
    "lines": (*_HARDWARE_PROPERTIES, "lines_facts"),
}
"""Kind of device -> properties that the client gets after ``attach`` and ``open``."""


@dataclass(frozen=True, slots=True)
class DeviceEntry:
    """A device of the profile that is served.

    Attributes:
        name: Role of the device, or its name in the profile.
        plugin: Its plugin.
        simulation: Plugin of the simulation on which it acts, if it is simulated.
        identities: Identifiers of the hardware, for its marker. Empty if it is simulated.
    """

    name: str
    plugin: ChosenPlugin
    simulation: ChosenPlugin | None = None
    identities: tuple[str, ...] = ()

    @property
    def kind(self) -> str:
        """Kind of the device, "camera"."""
        return self.plugin.entry.kind

    @property
    def key(self) -> str:
        """Name of this server in the device's marker, in place of a run's profile."""
        return f"labseq serve-devices {self.name}"


def _checked_context(context: Any) -> tuple[str, tuple[LineSpec, ...]]:
    """Name and lines in a client's context, after the types of all its fields have been checked.

    Raises:
        DeviceError: A field is wrong.
    """
    kinds = {"name": str, "grid": SiteGrid, "motion": MotionSpec, "lines": list, "calibrations": dict}
    if not isinstance(context, dict):
        raise DeviceError("server", "the context is not a mapping")
    for key, kind in kinds.items():
        if type(context.get(key)) is not kind:
            raise DeviceError("server", f"'{key}' of the context is not of the type {kind.__name__}")
    if not all(isinstance(line, LineSpec) for line in context["lines"]):
        raise DeviceError("server", "'lines' of the context contains values that are not lines")
    if not all(isinstance(entry, CalibrationEntry) for entry in context["calibrations"].values()):
        raise DeviceError("server", "'calibrations' of the context contains values that are not calibrations")
    return context["name"], tuple(context["lines"])


class ClientDriver:
    """A client's own object of the driver of a served device, with its watchdog.

    All methods are called in the thread of the device, except for :meth:`make_safe_during_call`.

    Attributes:
        device: The driver.
        clock: Clock of the driver.
        is_open: Whether the client has opened the device and may act with it.
        is_safe: Whether nothing was called since the last successful safe state.

    Args:
        entry: The device.
        client_context: The client's context: name, grid, motion, lines and calibrations.
        abort: Flag that ends waits of the driver.
        report: Receives lines of text for the operator.

    Raises:
        ConfigError: The driver refuses its settings, or a simulated device would need the client's lines.
    """

    def __init__(
        self,
        entry: DeviceEntry,
        client_context: Any,
        abort: StopFlag,
        report: Callable[[str], object],
    ) -> None:
        self.clock = RealClock(abort)
        self.is_open = self.is_safe = False
        self._entry = entry
        self._abort = abort
        self._report = report
        self._watchdog: Watchdog | None = None
        name, lines = _checked_context(client_context)
        if entry.plugin.virtual_time and name in [line.triggers for line in lines]:
            problem = f"'{entry.name}' is simulated at its server, where no line can trigger it"
            raise ConfigError(Problem(problem, hint="'--dry-run' simulates all devices in one place"))
        context = Context(
            name,
            client_context["grid"],
            client_context["motion"],
            self.clock,
            calibrations=client_context["calibrations"],
            lines=lines,
        )
        plugins = {name: entry.plugin}
        if entry.simulation is not None:
            plugins["simulation"] = entry.simulation
        devices, _ = construct(plugins, context, seed=0)
        self.device = devices[name]
        self._simulation = devices.get("simulation")

    def abilities(self) -> list[str]:
        """The optional methods that the driver has. The client need not ask for the others."""
        base = ROLES[self._entry.kind].base
        return [name for name in METHODS[self._entry.kind] if overrides(self.device, getattr(base, name))]

    def open(self, lost: Callable[[str], object]) -> None:
        """Open the device.

        Args:
            lost: Called, from another thread, when the watchdog is lost.
        """
        self.is_open, self.is_safe = True, False
        self._mark()
        with self._abort.held():
            if self._simulation is not None:
                self._simulation.open()
                self._simulation.begin_shot()
            self.device.open()
        emergency = self.device.emergency()
        if emergency is not None and self._watchdog is None:
            self._watchdog = Watchdog("labseq serve-devices", lost=lost, may_end=True)
            self._watchdog.add(self._entry.name, 0, emergency.script, dict(emergency.arguments))
            for note in self._watchdog.notes():
                self._report(f"{self._entry.name}: {note}")

    def call(self, name: str, args: list[Any], named: dict[str, Any]) -> Any:
        """Call a method of the driver.

        Raises:
            DeviceError: A client may not call the method, or has to open the device first.
        """
        if name not in METHODS[self._entry.kind]:
            raise DeviceError(self._entry.name, f"a client cannot call {name[:40]!r}")
        if not self.is_open and name not in _WITHOUT_OPENING:
            raise DeviceError(self._entry.name, "this connection has not opened the device")
        if name == "warm":
            self.device.warm()
            return load_kernels()
        if name == "safe_state":
            return self._make_safe() if self.is_open else None
        self.is_safe = self.is_safe and name in _WITHOUT_OPENING
        value = getattr(self.device, name)(*args, **named)
        if name == "leave_on" and value:
            self.is_safe = True  # it is meant to stay on, so the watchdog must not switch it off
            self._give_up()
        return dict(value) if isinstance(value, Mapping) else value

    def state_after(self, name: str) -> dict[str, Any]:
        """Values of the properties that a call may have changed."""
        is_mobile = self._entry.kind == "mobile_tweezers"
        if name in ("attach", "open"):
            names = _PROPERTIES[self._entry.kind]
        elif is_mobile and name in ("prepare", "prepare_beginning", "append", "play"):
            names = _PLAYING_PROPERTIES
        else:
            return {}
        state = {name: getattr(self.device, name) for name in names}
        if is_mobile:
            state["timings"] = dict(self.device.timings())
        return state

    def make_safe_during_call(self, timeout_s: float = 5.0) -> str:
        """Make the device safe while a call hangs in its thread. Returns why that failed, or "".

        If it fails or takes longer than ``timeout_s``, the watchdog switches the device off.
        """
        guard = Guard(self._abort)
        with self._abort.held():
            failure = attempt(guard, self._entry.name, timeout_s, self.device.safe_state)
        guard.end()
        if failure is not None and self._watchdog is not None:
            self._watchdog.end()  # it switches off all outputs that it was not told to forget
        return "" if failure is None else str(failure)

    def close(self) -> list[str]:
        """Make the device safe, unless it is, and close it. Returns the failures."""
        failures: list[str] = []

        def try_call(method: Callable[[], object], name: str) -> None:
            try:
                method()
            except BaseException as error:  # noqa: BLE001 - of the driver's class
                failures.append(f"{name} failed: {format_error(error)}")

        with self._abort.held():
            if self.is_open and not self.is_safe:
                try_call(self._make_safe, "safe_state()")
            try_call(self.device.close, "close()")
            if self._simulation is not None:
                try_call(self._simulation.close, "close() of its simulation")
        if self.is_open and not self.is_safe:
            watchdog = "its watchdog switches it off" if self._watchdog else "nothing else can switch it off"
            failures.append(f"the device is NOT SAFE: {watchdog}")
        self._give_up()
        return failures

    def _make_safe(self) -> None:
        self.is_safe = False
        with self._abort.held():
            self.device.safe_state()
        if self._simulation is not None:
            self._simulation.begin_shot()  # otherwise the interrupted exposure would block the next one
        self.is_safe = True

    def _give_up(self) -> None:
        """Let other clients use the device. The watchdog switches it off unless it is safe."""
        self.is_open = False
        if self._watchdog is not None:
            if self.is_safe:
                self._watchdog.forget([self._entry.name])
            self._watchdog.end()
            self._watchdog = None
        if self.is_safe and self._entry.identities:
            with suppress(LabseqError):
                clear_active(self._entry.key, self._entry.identities)

    def _mark(self) -> None:
        """Leave a marker until the device is safe, as a run does, for `labseq safe` and `labseq devices`."""
        if not self._entry.identities:
            return
        try:
            mark_active(self._entry.key, self._entry.identities, devices_root() / self._entry.key)
        except LabseqError as error:
            self._report(f"{self._entry.name}: {error}")
