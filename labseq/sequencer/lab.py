"""The devices of a run, their order, their safe state and how they are closed."""

from __future__ import annotations

import time
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

from labseq.errors import DeviceError, LabseqError
from labseq.guard import Guard
from labseq.messages import format_error
from labseq.model import (
    CalibrationEntry,
    LinesFacts,
    LineSpec,
    MotionSpec,
    RandomStream,
    SiteGrid,
    TargetPattern,
)
from labseq.model.policies import Blinding, Timeouts
from labseq.roles import (
    Camera,
    Clock,
    Detector,
    Device,
    Hardware,
    Lines,
    MobileTweezers,
    Planner,
    Simulation,
    StaticTweezers,
    StepContext,
    in_opening_order,
    in_safe_order,
)
from labseq.sequencer.lines import blinding_lines
from labseq.watchdog import Watchdog


def check_blinding(lab: Lab, guard: Guard) -> None:
    """Raise before an exposure with EM gain if light is on that would age or destroy the EM register.

    Raises:
        DeviceError: Such a light is on. Nothing was exposed.
    """
    em_gain = lab.camera.facts.em_gain
    if em_gain <= 1.0:
        return
    if lines := blinding_lines(lab.line_specs, "image"):
        text = f"no exposure with an EM gain of {em_gain:g} while '{lines[0]}' is on, which the profile marks"
        raise DeviceError("camera", f"{text} as blinding; remove `image` from the `on` of this line")
    for name, state in _on(lab, lab.blinding, guard).items():
        text = f"no exposure with an EM gain of {em_gain:g} while '{name}' is on (its value is {state!r})"
        raise DeviceError(
            "camera", f"{text}, as the profile marks it as blinding; turn it off before the image"
        )


def _on(lab: Lab, marks: Mapping[str, Blinding], guard: Guard) -> dict[str, Any]:
    """The marked devices whose light is on, with their values."""
    values = {
        name: guard.call(name, lab.timeouts.call_s, lab.devices[name].read, mark.value)
        for name, mark in marks.items()
    }
    return {name: value for name, value in values.items() if value in marks[name].when}


@dataclass(frozen=True, slots=True)
class Lab:
    """Devices, planner, detector, clock and settings that a shot uses.

    Attributes:
        budgets: Budgets of stages that do not have their own, stage -> seconds.
        camera_is_simulated: Whether the camera sees the simulated atoms, so that their truth is recorded.
    """

    grid: SiteGrid
    motion: MotionSpec
    target: TargetPattern
    clock: Clock
    camera: Camera
    static_tweezers: StaticTweezers
    mobile_tweezers: MobileTweezers
    detector: Detector
    planner: Planner
    planner_name: str
    degree_of_parallelism: int
    devices: Mapping[str, Device]
    simulation: Simulation | None
    random_streams: tuple[RandomStream, ...]
    timeouts: Timeouts
    calibrations: Mapping[str, CalibrationEntry] = field(
        default_factory=dict[str, CalibrationEntry], kw_only=True
    )
    blinding: Mapping[str, Blinding] = field(default_factory=dict[str, Blinding], kw_only=True)
    lines: Lines | None = field(default=None, kw_only=True)
    line_specs: tuple[LineSpec, ...] = field(default=(), kw_only=True)
    budgets: Mapping[str, float] = field(default_factory=dict[str, float], kw_only=True)
    camera_is_simulated: bool = field(default=True, kw_only=True)

    @property
    def step_context(self) -> StepContext:
        """The context from which steps lay out their timelines."""
        return StepContext(
            self.grid,
            self.motion,
            self.target,
            self.camera.facts,
            self.line_specs,
            LinesFacts(()) if self.lines is None else self.lines.lines_facts,
            self.static_tweezers.facts,
        )

    def hardware(self) -> list[tuple[str, Hardware]]:
        """Name and device, in the order of opening."""
        devices: dict[str, Hardware] = {
            "camera": self.camera,
            "static_tweezers": self.static_tweezers,
            "mobile_tweezers": self.mobile_tweezers,
            **self.devices,
        }
        if self.lines is not None:
            devices["lines"] = self.lines
        return in_opening_order(devices)

    @property
    def direct_calls(self) -> frozenset[str]:
        """Devices and plugins that a shot calls in the thread of its steps."""
        any_thread = (name for name, device in self.hardware() if device.any_thread)
        return frozenset({"detector", "planner", *any_thread})

    def safe_order(self) -> list[tuple[str, Hardware]]:
        """Name and device, in the order of the safe state."""
        return in_safe_order(dict(self.hardware()))


Emit = Callable[[str, Mapping[str, Any]], None]
"""Receives an event as name and values."""
Outcome = dict[str, LabseqError | None]
"""Device name -> its failure, or None, in the order of the calls."""


NEXT_S: Final = 0.2
"""How long a device may delay the safe state of the next one at the end of a run."""


def end_safely(lab: Lab, guard: Guard) -> tuple[Outcome, dict[str, float]]:
    """Bring every device to its safe state. A slow device does not delay the others.

    They begin in the order of the safe state. This is only for the end of a run, because devices that act at
    the same time need not give the same data as in turn.

    Returns:
        The outcome, and after how many seconds each device was safe.
    """
    begun_s = time.monotonic()
    results: dict[str, Callable[[], object]] = {}
    after_s: dict[str, float] = {}

    def safe_state(name: str, part: Hardware) -> None:
        part.safe_state()
        after_s[name] = time.monotonic() - begun_s

    for name, part in lab.safe_order():
        has_ended, results[name] = guard.begin(
            name, lab.timeouts.safe_state_s, partial(safe_state, name, part)
        )
        failure_of(name, "", partial(has_ended.wait, NEXT_S))  # Ctrl-C
    return {name: failure_of(name, "safe_state()", result) for name, result in results.items()}, after_s


def make_safe(lab: Lab, guard: Guard, names: Container[str] | None = None) -> Outcome:
    """Bring every device, or the named devices, to its safe state. No failure stops the others.

    Each device has its own timeout.
    """
    methods = {name: device.safe_state for name, device in lab.safe_order()}
    return _each(methods, guard, lab.timeouts.safe_state_s, names)


def close_all(lab: Lab, guard: Guard, names: Container[str] | None = None) -> Outcome:
    """Close every device in the safe order, then the simulation, or only the named ones."""
    methods = {name: device.close for name, device in lab.safe_order()}
    if lab.simulation is not None:
        methods["simulation"] = lab.simulation.close
    return _each(methods, guard, lab.timeouts.safe_state_s, names)


def _each(
    methods: Mapping[str, Callable[[], object]],
    guard: Guard,
    timeout_s: float,
    names: Container[str] | None,
) -> Outcome:
    """Call the methods in their order, or only the named ones if names are given."""
    return {
        name: attempt(guard, name, timeout_s, method)
        for name, method in methods.items()
        if names is None or name in names
    }


def attempt(guard: Guard, name: str, timeout_s: float, method: Callable[[], object]) -> LabseqError | None:
    """Call a method of a device even if the run is asked to stop. Returns why it failed, or None."""
    act = partial(guard.call_despite_stop, name, timeout_s, method)
    return failure_of(name, f"{method.__name__}()", act)


def failure_of(name: str, what: str, act: Callable[[], object]) -> LabseqError | None:
    """Call a function for a device. Returns why it failed, or None."""
    try:
        act()
    except LabseqError as failure:
        return failure
    except BaseException as failure:  # noqa: BLE001 - even after an unhandled Ctrl-C the others come first
        return DeviceError(name, f"{what} was interrupted by {format_error(failure)}")
    return None


def open_device(
    guard: Guard, name: str, device: Hardware, timeout_s: float, watchdog: Watchdog, order: int
) -> None:
    """Open a device, even if the run is asked to stop. The watchdog learns how it is switched off.

    A slow ``open()`` must end first, because its last actions would undo the safe state.

    Raises:
        LabseqError: It cannot be opened, or ``emergency()`` fails.
    """
    guard.call_despite_stop(name, timeout_s, device.open)
    emergency = guard.call_despite_stop(name, timeout_s, device.emergency)
    if emergency is not None:
        watchdog.add(name, order, emergency.script, dict(emergency.arguments))


def describe(lab: Lab, guard: Guard) -> dict[str, Mapping[str, Any]]:
    """The description of each device, name -> JSON-ready values."""
    parts: dict[str, Hardware | Simulation] = dict(lab.hardware())
    if lab.simulation is not None:
        parts["simulation"] = lab.simulation
    return {name: guard.call(name, lab.timeouts.call_s, part.describe) for name, part in parts.items()}
