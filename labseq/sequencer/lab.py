"""The devices of a run, as the sequencer holds them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from labseq.errors import LabseqError
from labseq.model import CameraFacts, MotionSpec, RandomStream, SiteGrid, TargetPattern
from labseq.roles import (
    Camera,
    Clock,
    Detector,
    Device,
    Hardware,
    KnownCamera,
    MobileTweezers,
    Planner,
    Simulation,
    StaticTweezers,
    StepContext,
)
from labseq.sequencer.guard import Guard


@dataclass(frozen=True, slots=True)
class Timeouts:
    """How long labseq waits before a device or plugin counts as hung.

    Attributes:
        call_s: Longest time a call may take beyond its own duration.
        safe_state_s: Longest time for one device's safe state.
        plan_s: Longest time for one plan.
    """

    call_s: float = 10.0
    safe_state_s: float = 5.0
    plan_s: float = 5.0


@dataclass(frozen=True, slots=True)
class Lab:
    """Everything that a shot is made with."""

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

    @property
    def step_context(self) -> StepContext:
        """What steps need to lay out their timelines."""
        facts = self.camera.facts if isinstance(self.camera, KnownCamera) else CameraFacts()
        return StepContext(self.grid, self.motion, self.target, facts)

    def hardware(self) -> Iterator[tuple[str, Hardware]]:
        """Name and device, in the order of opening: static tweezers first."""
        yield "static_tweezers", self.static_tweezers
        yield "camera", self.camera
        yield from self.devices.items()
        yield "mobile_tweezers", self.mobile_tweezers

    def safe_order(self) -> Iterator[tuple[str, Hardware]]:
        """Name and device, in the order of the safe state."""
        return in_safe_order(dict(self.hardware()))


def in_safe_order(devices: Mapping[str, Hardware]) -> Iterator[tuple[str, Hardware]]:
    """Name and device, in the order of the safe state.

    Mobile tweezers ramp down first, then devices and camera, static tweezers last.
    """
    ends = ("mobile_tweezers", "camera", "static_tweezers")
    others = tuple(name for name in devices if name not in ends)
    for name in (ends[0], *others, *ends[1:]):
        yield name, devices[name]


Report = Callable[[str, LabseqError | None], None]


def make_safe(lab: Lab, guard: Guard, report: Report) -> bool:
    """Bring every device to its safe state; one that fails never stops the others.

    Args:
        lab: The devices.
        guard: Runs the calls; each device has a timeout of its own.
        report: Told each device's name and its error, or None.

    Returns:
        Whether every device is in its safe state.
    """
    return _each(lab, guard, report, "safe_state", lab.timeouts.safe_state_s)


def close_all(lab: Lab, guard: Guard, report: Report) -> bool:
    """Close every device, in the order of the safe state; failures never stop the others."""
    return _each(lab, guard, report, "close", lab.timeouts.safe_state_s)


def _each(lab: Lab, guard: Guard, report: Report, method: str, timeout_s: float) -> bool:
    all_well = True
    for name, device in lab.safe_order():
        error: LabseqError | None = None
        try:
            guard.call_to_the_end(name, timeout_s, getattr(device, method))
        except LabseqError as failure:
            error = failure
            all_well = False
        report(name, error)
    return all_well


def describe(lab: Lab, guard: Guard) -> dict[str, Mapping[str, Any]]:
    """What each device says of itself: name -> JSON-ready values."""
    described: dict[str, Mapping[str, Any]] = {}
    for name, device in lab.hardware():
        described[name] = guard.call(name, lab.timeouts.call_s, device.describe)
    if lab.simulation is not None:
        described["simulation"] = lab.simulation.describe()
    return described
