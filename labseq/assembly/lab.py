"""Constructs the devices of a run, checks their wiring, and rebuilds devices that a scan changes."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from labseq import motion
from labseq.assembly.plugin_choice import ChosenPlugin, construct_one
from labseq.assembly.wiring import wrong_wiring
from labseq.errors import ConfigError, LabseqError, PlanError
from labseq.guard import Guard, StopFlag
from labseq.kernels.kernel import announcing, load_kernels
from labseq.model import MotionSpec, RandomStream, SiteGrid, TargetPattern
from labseq.plugins.calls import call_plugin
from labseq.roles import ChoosesPlanner, Clock, Context, NeedsWarmUp, Planner, RunObserver, Simulation
from labseq.sequencer.clock import PacedClock, RealClock, VirtualClock
from labseq.sequencer.lab import Lab

if TYPE_CHECKING:
    from labseq.assembly.point import Point


def clock_for(stop: StopFlag, *, virtual: bool, paced: bool = False) -> Clock:
    """The clock of a run."""
    if not virtual:
        return RealClock(stop)
    return PacedClock(stop) if paced else VirtualClock(stop)


def build_lab(point: Point, target: TargetPattern, clock: Clock, seed: int) -> Lab:
    """Construct the object of every role. No device is opened.

    Raises:
        ConfigError: A constructor refuses its settings, or the lines conflict with the devices.
    """
    hardware = point.hardware
    profile, motion = hardware.profile, hardware.motion
    chosen = {**hardware.chosen, "planner": point.planner}
    objects, streams = construct(
        chosen, hardware.context(clock), seed, truth=(profile.grid_model(), profile.motion)
    )
    lab = Lab(
        grid=hardware.grid,
        motion=motion,
        target=target,
        clock=clock,
        camera=objects["camera"],
        static_tweezers=objects["static_tweezers"],
        mobile_tweezers=objects["mobile_tweezers"],
        detector=objects["detector"],
        planner=objects["planner"],
        planner_name=point.planner.entry.name,
        degree_of_parallelism=parallelism_of(point.planner, objects["planner"], motion),
        devices={name: objects[name] for name in profile.devices},
        simulation=objects.get("simulation"),
        random_streams=streams,
        timeouts=profile.timeouts,
        calibrations=hardware.calibrations,
        blinding=profile.blinding,
        lines=objects.get("lines"),
        line_specs=profile.line_specs,
        budgets=profile.budgets.model_dump(),
        camera_is_simulated=chosen["camera"].virtual_time,
    )
    if problems := [*wrong_wiring(hardware.document, lab)]:
        raise ConfigError(problems)
    return lab


def construct(
    chosen: Mapping[str, ChosenPlugin],
    context: Context,
    seed: int,
    *,
    truth: tuple[SiteGrid, MotionSpec] | None = None,
    refused: dict[str, LabseqError] | None = None,
) -> tuple[dict[str, Any], tuple[RandomStream, ...]]:
    """Construct the object of every role. Constructors do no I/O, so nothing is open yet.

    Args:
        chosen: Role -> its plugin.
        context: Their common context. Each gets its own name and random numbers, and the simulation if that
            is chosen.
        truth: Grid and motion without calibrations, for the simulation in which they are measured. None
            without calibrations.
        refused: Receives the errors, role -> error. Without it they are raised.

    Returns:
        Role -> object, and the random streams that the objects received.

    Raises:
        ConfigError: A constructor refuses its settings. The error has their place.
        PluginLoadError: A constructor raised, or made no object of that role. The message names the plugin.
    """
    objects: dict[str, Any] = {}
    streams: list[RandomStream] = []
    for role in sorted(chosen, key=lambda role: role != "simulation"):  # the others receive the simulation
        simulation: Simulation | None = objects.get("simulation", context.simulation)
        role_context = replace(context, name=role, simulation=simulation)
        if chosen[role].entry.kind == "camera" != role:  # no line triggers it
            seen = None if simulation is None else simulation.seen_by(role)
            role_context = replace(role_context, simulation=seen, lines=())
        if role == "simulation":
            stream = RandomStream(seed, "")
            grid, motion = (context.grid, context.motion) if truth is None else truth
            role_context = replace(role_context, random=stream, grid=grid, motion=motion)
        else:
            stream = RandomStream(seed, role)
            role_context = replace(role_context, random=stream)
        streams.append(stream)
        try:
            objects[role] = construct_one(chosen[role], role_context)
        except LabseqError as error:
            if refused is None:
                raise
            refused[role] = error
    return objects, tuple(streams)


def choice_of(
    planner: Planner, target: TargetPattern, window_s: float = math.inf, stop: StopFlag | None = None
) -> Sequence[str]:
    """The way of planning that a planner has chosen, then the alternatives. This may take seconds.

    Empty if the planner has no choice, or nothing is planned. See ``labseq.roles.ChoosesPlanner``.
    """
    if not isinstance(planner, ChoosesPlanner) or target.is_none:
        return ()
    guard = Guard(stop)
    try:
        if isinstance(planner, NeedsWarmUp):
            guard.call("planner", WARM_S, planner.warm)
            load_kernels()
        return guard.call("planner", WARM_S, planner.choose, target, window_s)
    finally:
        guard.end()


def parallelism_of(chosen: ChosenPlugin, planner: Any, motion: MotionSpec) -> int:
    """Maximum number of mobile tweezers in a batch, from the planner or else from the motion."""
    dop = call_plugin(  # a property of the planner may raise, too
        chosen.entry.owner,
        "its degree_of_parallelism",
        lambda: getattr(planner, "degree_of_parallelism", motion.max_tweezers),
    )
    return dop if isinstance(dop, int) else motion.max_tweezers


WARM_S: Final = 300.0
"""Maximum time for a plugin to compile, in seconds. A slow computer needs half a minute."""


def warm(lab: Lab, stop_flag: StopFlag, observer: RunObserver, *, devices: bool = True) -> None:
    """Compile all kernels before the first shot, because compiling during a shot would lose the atoms.

    Args:
        lab: The lab whose objects need kernels.
        stop_flag: Checked all the time.
        observer: Receives an event before kernels are compiled, and how long that took.
        devices: Whether to compile the kernels of devices in addition to planner and detector.

    Raises:
        StopRequested: The operator asked to stop.
        PlanError: The planner's kernels failed.
        DeviceError: The kernels of a device or the detector failed.
        PluginLoadError: A kernel cannot be compiled.
    """
    started_s = list[float]()

    def announce(about_s: float) -> None:
        started_s.append(time.monotonic())
        observer.event("compiling", {"about_s": about_s})

    with announcing(announce):
        motion.warm()
        _warm_plugins(lab, stop_flag, devices)
        load_kernels(stop_flag.check)
    if started_s:
        observer.event("compiled", {"duration_s": time.monotonic() - started_s[0]})


def _warm_plugins(lab: Lab, stop_flag: StopFlag, devices: bool) -> None:
    guard = Guard(stop_flag)
    parts = (("planner", lab.planner), ("detector", lab.detector))
    for name, part in (*parts, *(lab.hardware() if devices else ())):
        if isinstance(part, NeedsWarmUp):
            try:
                guard.call(name, WARM_S, part.warm)
            except PlanError as error:
                raise error if error.planner else PlanError(str(error), lab.planner_name) from error
        stop_flag.check()
    guard.end()
