"""Commands that steps send to devices, checked by the devices that know theirs before they are opened."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from labseq.errors import ConfigError, LabseqError, Problem
from labseq.roles import KnownCommands
from labseq.sequencer import Guard, StopFlag
from labseq.sequencer.lab import Lab
from labseq.sequencer.steps import DeviceStep
from labseq.session.assembly import Assembly
from labseq.session.scan import Point


def check_commands(assembly: Assembly, points: Iterable[Point], build: Callable[[Point], Lab]) -> None:
    """Refuse commands that a device does not know, or whose arguments it would refuse; nothing is opened.

    Args:
        assembly: The run.
        points: The points of its scan.
        build: Constructs the devices of a point.

    Raises:
        ConfigError: Everything that is wrong with them, with its place.
    """
    if not any(isinstance(step, DeviceStep) for _, step in assembly.steps):
        return
    labs: dict[int, Lab] = {}
    problems: dict[str, Problem] = {}
    guard = Guard(StopFlag())
    for point in points:
        lab = labs.get(id(point.bench)) or labs.setdefault(id(point.bench), build(point))
        for spec, (_, step) in zip(assembly.sequence.shot, point.steps, strict=True):
            failure = _failure(guard, lab, step) if isinstance(step, DeviceStep) else None
            if failure is not None:
                problem = assembly.document.problem((*spec.loc, "do"), str(failure))
                problems[str(problem)] = problem
    guard.end()
    if problems:
        raise ConfigError([*problems.values()])


def _failure(guard: Guard, lab: Lab, step: DeviceStep) -> LabseqError | None:
    device = lab.devices.get(step.device)
    if not isinstance(device, KnownCommands):
        return None
    check, timeout_s = device.check_command, lab.timeouts.call_s
    try:
        guard.call(step.device, timeout_s, check, step.command, **step.arguments)
    except LabseqError as failure:
        return failure
    return None
