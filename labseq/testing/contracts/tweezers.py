"""Promises of static and mobile tweezers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from time import perf_counter
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from labseq.errors import DeviceError, LimitError
from labseq.model import Plan, SiteGrid, ToneProgram
from labseq.motion import tone_program
from labseq.roles import Context, MobileTweezers, StaticTweezers, overrides
from labseq.testing.contracts.hardware import Action, Factory, HardwareContract, Wait, n_calls
from labseq.testing.contracts.promises import doing, promise, quietly, refusal
from labseq.testing.fakes.lab import RecordingSimulation


class StaticTweezersContract(HardwareContract[StaticTweezers]):
    """Promises of the static array.

    Attributes:
        ramp_s: Duration of the test ramps, in seconds.
        too_deep: A depth, as a fraction of the nominal depth, that the device cannot reach.
    """

    role: ClassVar[str] = "static_tweezers"
    ramp_s: ClassVar[float] = 0.01
    too_deep: ClassVar[float] = 10.0

    def work(self, device: StaticTweezers) -> None:
        """Turn on, lower and raise the array."""
        device.load(None)
        device.start()
        if device.facts.ramps:
            device.ramp(0.5, self.ramp_s)
            device.ramp(1.0, self.ramp_s)

    def ready(self, device: StaticTweezers) -> None:
        """Turn on."""
        device.start()

    def uses(self) -> Mapping[str, Action[StaticTweezers]]:
        """Load, start, ramp."""
        return {
            "load()": lambda tweezers: tweezers.load(None),
            "start()": lambda tweezers: tweezers.start(),
            "ramp()": lambda tweezers: tweezers.ramp(0.5, self.ramp_s),
        }

    def states(self) -> Mapping[str, Action[StaticTweezers]]:
        """States with amplitudes loaded, on, and lowered."""

        def lower(tweezers: StaticTweezers) -> None:
            tweezers.start()
            if tweezers.facts.ramps:
                tweezers.ramp(0.2, self.ramp_s)

        return {
            "with amplitudes loaded": lambda tweezers: tweezers.load(None),
            "while on": lambda tweezers: tweezers.start(),
            "while lowered": lower,
        }

    def excesses(self) -> Mapping[str, Action[StaticTweezers]]:
        """Depths, durations and amplitudes outside every array's limits."""
        grid = self.context().grid
        rows, cols = amplitudes_of(grid)

        def ramp(depth: float, duration_s: float) -> Action[StaticTweezers]:
            return lambda tweezers: tweezers.ramp(depth, duration_s)

        return {
            "ramp() too deep": ramp(self.too_deep, self.ramp_s),
            "ramp() to a negative depth": ramp(-0.1, self.ramp_s),
            "ramp() to a depth of nan": ramp(float("nan"), self.ramp_s),
            "ramp() in a negative time": ramp(0.5, -self.ramp_s),
            "load() of amplitudes beyond full scale": lambda tweezers: tweezers.load((rows * 0 + 10.0, cols)),
            "load() of a negative amplitude": lambda tweezers: tweezers.load((rows, -cols)),
            "load() of one amplitude too few": lambda tweezers: tweezers.load((rows[:-1], cols)),
        }

    @promise("start() turns the array on, and does nothing if it is on")
    def test_starts_twice(self, factory: Factory[StaticTweezers]) -> None:
        """Start the array twice, because every shot starts it."""
        with self.opened(factory) as (tweezers, context):
            tweezers.start()
            before = n_calls(context)
            with doing("start() while on"):
                tweezers.start()
            assert n_calls(context) == before, "start() while on was played again"

    @promise("start() brings the array back to its nominal depth after a ramp")
    def test_starts_after_a_ramp(self, factory: Factory[StaticTweezers]) -> None:
        """Start after a ramp, because each shot begins at full depth."""
        with self.opened(factory) as (tweezers, context):
            tweezers.start()
            if not tweezers.facts.ramps:
                return
            tweezers.ramp(0.5, self.ramp_s)
            before = _n_played(context)
            with doing("start() after a ramp to half the depth"):
                tweezers.start()
            depth = tweezers.describe().get("depth", 1.0)
            assert depth == 1.0, f"the depth is {depth} after start(); expected 1"
            assert not before or _n_played(context) > before, "start() after a ramp played nothing"

    @promise("ramp() takes every depth from 0 to 1 (or only 0 and 1 if `facts` say so), and a duration of 0")
    def test_ramps(self, factory: Factory[StaticTweezers]) -> None:
        """Ramp down to 0 and back."""
        with self.opened(factory) as (tweezers, _):
            tweezers.start()
            if not tweezers.facts.ramps:
                refusal(LimitError, "ramp(0.5)", tweezers.ramp, 0.5, self.ramp_s)
                return
            for depth, duration_s in ((0.5, self.ramp_s), (0.0, self.ramp_s), (1.0, self.ramp_s), (0.3, 0.0)):
                with doing(f"ramp({depth}, {duration_s})"):
                    tweezers.ramp(depth, duration_s)

    @promise("release(), if `facts` offer it, returns the time without light, when the light is on again")
    def test_releases(self, factory: Factory[StaticTweezers]) -> None:
        """The device itself turns the light on again."""
        with self.opened(factory) as (tweezers, context):
            shortest_s = tweezers.facts.shortest_release_s
            if shortest_s == math.inf:
                return
            tweezers.start()
            wanted_s, start_s = max(2 * shortest_s, 1e-5), context.clock.now()
            released_s = tweezers.release(wanted_s)
            step_s = tweezers.facts.resolution_s
            assert abs(released_s - wanted_s) <= step_s, f"release({wanted_s}) returned {released_s} s"
            passed_s = context.clock.now() - start_s
            assert passed_s >= wanted_s - step_s, f"release({wanted_s}) returned after {passed_s} s"
            depth = tweezers.describe().get("depth", 1.0)
            assert depth == 1.0, f"the depth is {depth} after release(); expected 1"
            for duration_s in (-wanted_s, 0.0, float("nan")):
                refusal(LimitError, f"release({duration_s})", tweezers.release, duration_s)

    @promise("load_weights(), if `facts` offer it, takes a weight above 0 for each site")
    def test_loads_weights(self, factory: Factory[StaticTweezers]) -> None:
        """The array stays as it is while it is on. Amplitudes of tones and wrong weights are refused."""
        with self.opened(factory) as (tweezers, context):
            if tweezers.facts.control != "sites":
                return
            n_rows, n_cols = context.grid.shape
            weights = np.linspace(1.0, 2.0, n_rows * n_cols).reshape(n_rows, n_cols)
            before = weights.copy()
            with doing("load_weights()"):
                tweezers.start()
                tweezers.load_weights(weights)
            assert np.array_equal(before, weights), "load_weights() changed the caller's array"
            wrong = {
                "negative": -weights,
                "of 0": np.zeros_like(weights),
                "nan": np.full_like(weights, math.nan),
            }
            for what, each in {**wrong, "of another shape": weights[1:]}.items():
                refusal(LimitError, f"load_weights() of weights that are {what}", tweezers.load_weights, each)

    @promise("load() takes None, or one amplitude for each row and column, and leaves them untouched")
    def test_loads_amplitudes(self, factory: Factory[StaticTweezers]) -> None:
        """Calibrated amplitudes, then given ones. LimitError if no tones can be set."""
        with self.opened(factory) as (tweezers, context):
            with doing("load(None)"):
                tweezers.load(None)
            amplitudes = amplitudes_of(context.grid)
            if tweezers.facts.control != "tones":
                refusal(LimitError, "load((rows, columns))", tweezers.load, amplitudes)
                return
            before = [values.copy() for values in amplitudes]
            with doing("load((rows, columns))"):
                tweezers.load(amplitudes)
            untouched = all(np.array_equal(a, b) for a, b in zip(before, amplitudes, strict=True))
            assert untouched, "load() changed the caller's arrays"


def _n_played(context: Context) -> int:
    """Number of signals that the array played to the simulation."""
    simulation = context.simulation
    calls = simulation.calls if isinstance(simulation, RecordingSimulation) else ()
    return sum(call.method == "play" for call in calls)


def amplitudes_of(grid: SiteGrid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Equal amplitudes that together reach half of full scale: rows (n_rows,), columns (n_cols,)."""
    return np.full(grid.n_rows, 0.5 / grid.n_rows), np.full(grid.n_cols, 0.5 / grid.n_cols)


class MobileTweezersContract(HardwareContract[MobileTweezers]):
    """Promises of the mobile tweezers.

    Attributes:
        timeout_s: Timeout for the end of a program beyond its duration, in seconds.
    """

    role: ClassVar[str] = "mobile_tweezers"
    timeout_s: ClassVar[float] = 2.0

    def program(self) -> ToneProgram:
        """The program to play. One atom moves along a row of the grid, then another down a column."""
        context = self.context()
        n_rows, n_cols = context.grid.shape
        there, below = min(2, n_cols - 1), min(2, n_rows - 1)
        plan = Plan.from_batches([([(0, 0)], [(0, there)]), ([(0, 0)], [(below, 0)])])
        return tone_program(plan, grid=context.grid, motion=context.motion)

    def work(self, device: MobileTweezers) -> None:
        """Prepare, play, wait. Then the same in two parts if the tweezers can."""
        duration_s = device.prepare(self.program())
        device.play()
        device.wait(duration_s + self.timeout_s)
        if math.isfinite(device.beginning_s):
            device.prepare_beginning(self.program())
            device.play()
            device.append(self.program())
            device.wait(2 * duration_s + self.timeout_s)

    def uses(self) -> Mapping[str, Action[MobileTweezers]]:
        """Prepare, play, wait."""
        return {
            "prepare()": lambda tweezers: tweezers.prepare(self.program()),
            "play()": lambda tweezers: tweezers.play(),
            "wait()": lambda tweezers: tweezers.wait(0.1),
        }

    def states(self) -> Mapping[str, Action[MobileTweezers]]:
        """States with a program prepared, playing, and played."""
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
        """Programs outside every AOD's limits."""
        program = self.program()
        row, column = program.row, program.column

        def prepare(excessive: ToneProgram) -> Action[MobileTweezers]:
            return lambda tweezers: tweezers.prepare(excessive)

        def check(tweezers: MobileTweezers) -> None:
            if overrides(tweezers, MobileTweezers.check_program):
                tweezers.check_program(too_far)
            else:
                tweezers.prepare(too_far)

        far, loud = np.full_like(row.end_hz, 1e11), np.full_like(column.start_amplitude, 3.0)
        too_far = replace(program, row=replace(row, end_hz=far))
        return {
            "prepare() of tones at 100 GHz": prepare(too_far),
            "check_program() of tones at 100 GHz": check,
            "prepare() of tones at a frequency of nan": prepare(
                replace(program, column=replace(column, start_hz=column.start_hz * math.nan))
            ),
            "prepare() of amplitudes beyond full scale": prepare(
                replace(program, column=replace(column, start_amplitude=loud))
            ),
        }

    def waits(self) -> Mapping[str, Wait[MobileTweezers]]:
        """Waits for a program longer than the timeout."""
        timeout_s = 0.1 * self.program().total_duration_s
        return {
            "wait() shorter than the program": Wait(
                timeout_s, self.begin, lambda tweezers: tweezers.wait(timeout_s)
            )
        }

    @promise("prepare() returns the playing time, not less than the program's")
    def test_tells_the_playing_time(self, factory: Factory[MobileTweezers]) -> None:
        """The sequencer waits for this time."""
        with self.opened(factory) as (tweezers, _):
            wanted_s = self.program().total_duration_s
            duration_s = tweezers.prepare(self.program())
            text = f"prepare() returned {duration_s!r}, but the program takes {wanted_s} s"
            assert math.isfinite(duration_s), text
            assert duration_s >= wanted_s - 1e-9, text

    @promise("prepare, play, wait can be repeated")
    def test_plays_programs(self, factory: Factory[MobileTweezers]) -> None:
        """Play a program several times, as in each cycle."""
        with self.opened(factory) as (tweezers, _):
            for count in ("first", "second", "third"):
                with doing(f"the {count} program"):
                    self.work(tweezers)

    @promise("play() returns at once")
    def test_play_returns_at_once(self, factory: Factory[MobileTweezers]) -> None:
        """Only wait() waits, so that a stop request takes effect."""
        with self.opened(factory) as (tweezers, context):
            duration_s = tweezers.prepare(self.program())
            before_s = context.clock.now()
            tweezers.play()
            passed_s = context.clock.now() - before_s
            assert passed_s < 0.5 * duration_s, f"play() took {passed_s} s of the program's {duration_s} s"

    @promise("play() without prepare() raises DeviceError")
    def test_refuses_play_without_prepare(self, factory: Factory[MobileTweezers]) -> None:
        """Play without preparing, so that no program of an earlier shot is played by mistake."""
        with self.opened(factory) as (tweezers, _):
            refusal(DeviceError, "play() after open()", tweezers.play)

    @promise(
        "after safe_state() neither play() nor a trigger plays the prepared program",
        "let safe_state() drop the prepared program, and disarm everything that waits for its trigger",
    )
    def test_drops_its_program(self, factory: Factory[MobileTweezers]) -> None:
        """Play after safe_state() in every state, and by a trigger if a line can start the tweezers."""
        with self.each_state(factory) as states:
            for state, tweezers, _ in states:
                tweezers.safe_state()
                refusal(DeviceError, f"play() after safe_state() {state}", tweezers.play)
        with self.wired(factory, "rearrange") as (tweezers, context, pulse):
            if tweezers is None or not tweezers.waits_for_trigger:
                return
            duration_s = tweezers.prepare(self.program())
            tweezers.play()
            tweezers.safe_state()
            before = n_calls(context)
            pulse(1e-4)
            context.clock.sleep(duration_s)
            assert n_calls(context) == before, "a trigger after safe_state() started the program"

    @promise(
        "timings(), if there is one, gives the seconds that parts of the last prepare() took, without I/O"
    )
    def test_tells_its_timings(self, factory: Factory[MobileTweezers]) -> None:
        """The timings are recorded for every cycle, in the middle of a shot."""
        with self.opened(factory) as (tweezers, _):
            start_s = perf_counter()
            tweezers.prepare(self.program())
            limit_s = perf_counter() - start_s + 0.05  # clocks of a computer may differ
            with quietly():
                timings: Any = tweezers.timings()
            assert isinstance(timings, Mapping), f"timings() gave a {type(timings).__name__}"
            for part, taken_s in cast("Mapping[Any, Any]", timings).items():
                assert isinstance(part, str), f"timings() names a part {part!r}; expected text"
                text = f"timings() gives {taken_s!r} s for '{part}', but prepare() took {limit_s:.2g} s"
                assert 0.0 <= taken_s <= limit_s, text

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
