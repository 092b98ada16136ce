"""What steps ask of devices: commands, checked by devices that know theirs, and leaders to wait for."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from labseq.config import Loc
from labseq.errors import ConfigError, LabseqError, Problem
from labseq.roles import ChecksCommands
from labseq.sequencer import Guard, StopFlag
from labseq.sequencer.lab import Lab
from labseq.sequencer.leading import FollowStep, find_leader, leaders
from labseq.sequencer.steps import DeviceStep
from labseq.session.assembly import Assembly
from labseq.session.scan import Point


def check_commands(assembly: Assembly, points: Iterable[Point], build: Callable[[Point], Lab]) -> None:
    """Refuse what a device does not know, or would refuse, and waits for a leader that there is not.

    Nothing is opened.

    Args:
        assembly: The run.
        points: The points of its scan.
        build: Constructs the devices of a point.

    Raises:
        ConfigError: Everything that is wrong with them, with its place.
    """
    if not any(isinstance(step, DeviceStep | FollowStep) for _, step in assembly.steps):
        return
    labs: dict[int, Lab] = {}
    problems: dict[str, Problem] = {}
    guard = Guard(StopFlag())
    for point in points:
        lab = labs.get(id(point.bench)) or labs.setdefault(id(point.bench), build(point))
        for spec, (_, step) in zip(assembly.sequence.shot, point.steps, strict=True):
            problem: Problem | None = None
            if isinstance(step, DeviceStep) and (failure := _failure(guard, lab, step)) is not None:
                problem = assembly.document.problem((*spec.loc, "do"), str(failure))
            elif isinstance(step, FollowStep):
                problem = _leaderless(assembly, lab, spec.loc, step)
            if problem is not None:
                problems[str(problem)] = problem
    guard.end()
    if problems:
        raise ConfigError([*problems.values()])


def _failure(guard: Guard, lab: Lab, step: DeviceStep) -> LabseqError | None:
    device = lab.devices.get(step.device)
    if not isinstance(device, ChecksCommands):
        return None
    check, timeout_s = device.check_command, lab.timeouts.call_s
    try:
        guard.call(step.device, timeout_s, check, step.command, **step.arguments)
    except LabseqError as failure:
        return failure
    return None


def _leaderless(assembly: Assembly, lab: Lab, loc: Loc, step: FollowStep) -> Problem | None:
    """Why nobody can lead whom a step could wait for."""
    try:
        find_leader(dict(lab.hardware()), step.device)
    except ConfigError as error:
        hint = ""
        if assembly.dry_run == "fast":
            hint = "virtual twins do not lead: '--dry-run' without 'fast' has one that says `go` by itself"
        elif not dict(leaders(dict(lab.hardware()))):
            hint = "add one to its `devices`: `leader: {use: tcp_leader}`"
        key = "device" if step.device else "for"
        return assembly.document.problem((*loc, key), str(error), hint=hint)
    return None
