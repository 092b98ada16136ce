"""A tone program on its way to the mobile tweezers and through its end."""

from __future__ import annotations

import math
from collections.abc import Callable
from numbers import Real

from labseq.errors import DeviceError
from labseq.model import ToneProgram
from labseq.roles import Shot, ReportsTimings


def play(shot: Shot, build: Callable[[], ToneProgram], start_s: float, cycle: int = 0) -> None:
    """Build a tone program, play it and wait for its end.

    What real hardware spends on the overhead of a cycle, the model spends too.

    Args:
        shot: The running shot.
        build: Makes the program.
        start_s: Start of the cycle on the session's clock; its overhead counts from there.
        cycle: Rearrangement cycle, counted from 1; 0 outside of one.

    Raises:
        LimitError: The program breaks a limit.
        DeviceError: The mobile tweezers fail, or a watched value is past its limit.
    """
    overhead_s = shot.motion.overhead_per_cycle_s
    mobile, limit_s = shot.mobile_tweezers, shot.call_timeout_s
    with shot.stage("prepare", overhead_s, cycle):
        with shot.stage("tones", cycle=cycle):
            program = build()
        duration_s = _duration(shot.call("mobile_tweezers", limit_s, mobile.prepare, program))
        if isinstance(mobile, ReportsTimings):
            for part, host_s in shot.call("mobile_tweezers", limit_s, mobile.timings).items():
                shot.stage_done(part, 0.0 if shot.clock.virtual else host_s, host_s, cycle=cycle)
        if shot.clock.virtual:
            shot.clock.sleep(max(0.0, overhead_s - (shot.clock.now() - start_s)))
    shot.check_interlocks()
    budget_s = duration_s + shot.margin_s("rearrange")
    with shot.stage("play", budget_s, cycle), shot.lines_on("rearrange", duration_s):
        shot.call("mobile_tweezers", limit_s, mobile.play)
        shot.call("mobile_tweezers", duration_s + 2 * limit_s, mobile.wait, duration_s + limit_s)


def _duration(answer: object) -> float:
    """The playing time that ``prepare`` returned; every wait for the device is reckoned from it."""
    if not (isinstance(answer, Real) and 0 <= float(answer) < math.inf):
        text = f"prepare() returned {answer!r}; expected the playing time in seconds, 0 or more"
        raise DeviceError("mobile_tweezers", text)
    return float(answer)
