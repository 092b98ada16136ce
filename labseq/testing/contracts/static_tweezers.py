"""What static tweezers promise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from labseq.model import SiteGrid
from labseq.roles import Context, StaticTweezers
from labseq.testing.contracts.hardware import Action, Factory, HardwareContract, n_calls
from labseq.testing.contracts.promises import doing, promise
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
        """Turn on, lower, raise."""
        device.load(None)
        device.start()
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
        """Loaded, on, lowered."""

        def lower(tweezers: StaticTweezers) -> None:
            tweezers.start()
            tweezers.ramp(0.2, self.ramp_s)

        return {
            "with amplitudes loaded": lambda tweezers: tweezers.load(None),
            "while on": lambda tweezers: tweezers.start(),
            "while lowered": lower,
        }

    def excesses(self) -> Mapping[str, Action[StaticTweezers]]:
        """Depths, durations and amplitudes that no array can have."""
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
        """Every shot starts it."""
        with self.opened(factory) as (tweezers, context):
            tweezers.start()
            before = n_calls(context)
            with doing("start() while on"):
                tweezers.start()
            assert n_calls(context) == before, "start() while on was played again"

    @promise("start() brings the array back to its nominal depth after a ramp")
    def test_starts_after_a_ramp(self, factory: Factory[StaticTweezers]) -> None:
        """Each shot begins at full depth, whatever the last one did."""
        with self.opened(factory) as (tweezers, context):
            tweezers.start()
            tweezers.ramp(0.5, self.ramp_s)
            before = _n_played(context)
            with doing("start() after a ramp to half the depth"):
                tweezers.start()
            told = tweezers.describe().get("depth", 1.0)
            assert told == 1.0, f"the depth is {told} after start(); expected 1"
            assert not before or _n_played(context) > before, "start() after a ramp played nothing"

    @promise("ramp() takes every depth from 0 to 1, and a duration of 0")
    def test_ramps(self, factory: Factory[StaticTweezers]) -> None:
        """Down to nothing and back."""
        with self.opened(factory) as (tweezers, _):
            tweezers.start()
            for depth, duration_s in ((0.5, self.ramp_s), (0.0, self.ramp_s), (1.0, self.ramp_s), (0.3, 0.0)):
                with doing(f"ramp({depth}, {duration_s})"):
                    tweezers.ramp(depth, duration_s)

    @promise("load() takes None, or one amplitude for each row and column, and leaves them untouched")
    def test_loads_amplitudes(self, factory: Factory[StaticTweezers]) -> None:
        """Calibrated ones, then given ones."""
        with self.opened(factory) as (tweezers, context):
            with doing("load(None)"):
                tweezers.load(None)
            amplitudes = amplitudes_of(context.grid)
            before = [values.copy() for values in amplitudes]
            with doing("load((rows, columns))"):
                tweezers.load(amplitudes)
            untouched = all(np.array_equal(a, b) for a, b in zip(before, amplitudes, strict=True))
            assert untouched, "load() changed the caller's arrays"


def _n_played(context: Context) -> int:
    """How often the array played something to the simulation; 0 for one that plays nothing to it."""
    simulation = context.simulation
    calls = simulation.calls if isinstance(simulation, RecordingSimulation) else ()
    return sum(call.method == "play" for call in calls)


def amplitudes_of(grid: SiteGrid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Equal amplitudes that together reach half of full scale: rows (n_rows,), columns (n_cols,)."""
    return np.full(grid.n_rows, 0.5 / grid.n_rows), np.full(grid.n_cols, 0.5 / grid.n_cols)
