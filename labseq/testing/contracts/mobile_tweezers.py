"""What mobile tweezers promise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from time import perf_counter
from typing import Any, ClassVar, Final, cast

import numpy as np

from labseq.errors import DeviceError, LimitError
from labseq.model import Plan, ToneProgram
from labseq.motion import tone_program
from labseq.roles import MobileTweezers, offers
from labseq.testing.contracts.hardware import Action, Factory, HardwareContract, Wait
from labseq.testing.contracts.process import quietly
from labseq.testing.contracts.promises import doing, promise, refusal

CLOCK_S: Final = 0.05
"""Two clocks of a computer may differ by that."""


class MobileTweezersContract(HardwareContract[MobileTweezers]):
    """Promises of the mobile tweezers.

    Attributes:
        timeout_s: Timeout for the end of a program beyond its duration, in seconds.
    """

    role: ClassVar[str] = "mobile_tweezers"
    timeout_s: ClassVar[float] = 2.0

    def program(self) -> ToneProgram:
        """What is played: on the context's grid, one atom moves along a row, then another down a column."""
        context = self.context()
        n_rows, n_cols = context.grid.shape
        there, below = min(2, n_cols - 1), min(2, n_rows - 1)
        plan = Plan.from_batches([([(0, 0)], [(0, there)]), ([(0, 0)], [(below, 0)])])
        return tone_program(plan, grid=context.grid, motion=context.motion)

    def work(self, device: MobileTweezers) -> None:
        """Prepare, play, wait."""
        duration_s = device.prepare(self.program())
        device.play()
        device.wait(duration_s + self.timeout_s)

    def uses(self) -> Mapping[str, Action[MobileTweezers]]:
        """Prepare, play, wait."""
        return {
            "prepare()": lambda tweezers: tweezers.prepare(self.program()),
            "play()": lambda tweezers: tweezers.play(),
            "wait()": lambda tweezers: tweezers.wait(0.1),
        }

    def states(self) -> Mapping[str, Action[MobileTweezers]]:
        """Prepared, playing, played."""
        return {
            "while prepared": lambda tweezers: tweezers.prepare(self.program()),
            "while playing": self.begin,
            "after playing": self.work,
        }

    def begin(self, tweezers: MobileTweezers) -> None:
        """Prepare and play."""
        tweezers.prepare(self.program())
        tweezers.play()

    def excesses(self) -> Mapping[str, Action[MobileTweezers]]:
        """Programs that no AOD can play."""
        program = self.program()
        row, column = program.row, program.column

        def prepare(excessive: ToneProgram) -> Action[MobileTweezers]:
            return lambda tweezers: tweezers.prepare(excessive)

        far, loud = np.full_like(row.end_hz, 1e11), np.full_like(column.start_amplitude, 3.0)
        return {
            "prepare() of tones at 100 GHz": prepare(replace(program, row=replace(row, end_hz=far))),
            "prepare() of tones at a frequency of nan": prepare(
                replace(program, column=replace(column, start_hz=column.start_hz * math.nan))
            ),
            "prepare() of amplitudes beyond full scale": prepare(
                replace(program, column=replace(column, start_amplitude=loud))
            ),
        }

    def waits(self) -> Mapping[str, Wait[MobileTweezers]]:
        """For a program that plays longer."""
        timeout_s = 0.1 * self.program().total_duration_s
        return {
            "wait() shorter than the program": Wait(
                timeout_s, self.begin, lambda tweezers: tweezers.wait(timeout_s)
            )
        }

    @promise("prepare() returns the playing time, not less than the program's")
    def test_tells_the_playing_time(self, factory: Factory[MobileTweezers]) -> None:
        """The sequencer waits that long."""
        with self.opened(factory) as (tweezers, _):
            wanted_s = self.program().total_duration_s
            duration_s = tweezers.prepare(self.program())
            told = f"prepare() returned {duration_s!r}; the program takes {wanted_s} s"
            assert math.isfinite(duration_s), told
            assert duration_s >= wanted_s - 1e-9, told

    @promise("prepare, play, wait works again and again")
    def test_plays_programs(self, factory: Factory[MobileTweezers]) -> None:
        """One program per cycle."""
        with self.opened(factory) as (tweezers, _):
            for count in ("first", "second", "third"):
                with doing(f"the {count} program"):
                    self.work(tweezers)

    @promise("play() returns at once")
    def test_play_returns_at_once(self, factory: Factory[MobileTweezers]) -> None:
        """Waiting is left to wait(), so that a stop request is heard."""
        with self.opened(factory) as (tweezers, context):
            duration_s = tweezers.prepare(self.program())
            before_s = context.clock.now()
            tweezers.play()
            passed_s = context.clock.now() - before_s
            assert passed_s < 0.5 * duration_s, f"play() took {passed_s} s of the program's {duration_s} s"

    @promise("play() without prepare() raises DeviceError")
    def test_refuses_play_without_prepare(self, factory: Factory[MobileTweezers]) -> None:
        """Nor after safe_state(), which forgets what was prepared."""
        with self.opened(factory) as (tweezers, _):
            refusal(DeviceError, "play() after open()", tweezers.play)
            tweezers.prepare(self.program())
            tweezers.safe_state()
            refusal(DeviceError, "play() after safe_state()", tweezers.play)

    @promise(
        "timings(), if there is one, gives the seconds that parts of the last prepare() took, without I/O"
    )
    def test_tells_its_timings(self, factory: Factory[MobileTweezers]) -> None:
        """They are recorded for every cycle, in the middle of a shot."""
        with self.opened(factory) as (tweezers, _):
            if not offers(tweezers, "timings"):
                return
            start_s = perf_counter()
            tweezers.prepare(self.program())
            limit_s = perf_counter() - start_s + CLOCK_S
            with quietly():
                timings: Any = tweezers.timings()
            assert isinstance(timings, Mapping), f"timings() gave a {type(timings).__name__}"
            for part, taken_s in cast("Mapping[Any, Any]", timings).items():
                assert isinstance(part, str), f"timings() names a part {part!r}; expected text"
                told = f"timings() tells {taken_s!r} s for '{part}'; prepare() took {limit_s:.2g} s at most"
                assert 0.0 <= taken_s <= limit_s, told

    @promise("an empty program is played, or refused with LimitError")
    def test_takes_an_empty_program(self, factory: Factory[MobileTweezers]) -> None:
        """A plan without batches has no segments."""
        context = self.context()
        empty = tone_program(Plan.from_batches([]), grid=context.grid, motion=context.motion)
        with self.opened(factory) as (tweezers, _):
            try:
                duration_s = tweezers.prepare(empty)
            except LimitError:
                return
            assert duration_s >= 0.0, f"prepare() returned {duration_s}"
            tweezers.play()
            tweezers.wait(duration_s + self.timeout_s)
