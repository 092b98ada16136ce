"""Compiling before the first shot."""

from __future__ import annotations

import time
from typing import Final

from labseq import motion
from labseq.errors import PlanError
from labseq.kernels.compile import announcing
from labseq.roles import RunObserver, NeedsWarmUp
from labseq.sequencer import Guard, StopFlag
from labseq.sequencer.lab import Lab

WARM_S: Final = 300.0
"""How long a plugin may compile; a slow computer needs half a minute."""


def warm(lab: Lab, stop_flag: StopFlag, observer: RunObserver, *, devices: bool = True) -> None:
    """Compile before the first shot: a compile in mid-shot would cost the atoms.

    Args:
        lab: What will need kernels.
        stop_flag: Looked at before each compile.
        observer: Told what is compiled, and how long it took.
        devices: Whether the devices will need theirs, too; else only what plans and detects.

    Raises:
        StopRequested: The operator asked to stop.
        PlanError: The planner's kernels failed.
        DeviceError: Those of a device or the detector did.
    """
    start_s, compiled = time.monotonic(), list[str]()

    def announce(module: str) -> None:
        stop_flag.check()
        compiled.append(module)
        observer.event("compiling", {"module": module})

    with announcing(announce):
        motion.warm()
        _warm_plugins(lab, stop_flag, devices)
    if compiled:
        observer.event("compiled", {"duration_s": time.monotonic() - start_s})


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
