"""Promises of a simulation."""

from __future__ import annotations

import json
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, ClassVar, Final, TypeAlias

import numpy as np
import pytest

from labseq.errors import LabseqError, LimitError
from labseq.model import DepthRamp, Frame, RandomStream, SiteGrid
from labseq.roles import Context, Simulation
from labseq.testing.contracts.promises import doing, no_factory, promise, promised, quietly, refusal
from labseq.testing.fakes import FakeClock

Factory: TypeAlias = Callable[[Context], Simulation]

LOADING_S: Final = 2.0
BETWEEN_S: Final = 0.01
SAME_SEED: Final = "the same seed gives the same frames, and another seed gives other frames"


class SimulationContract:
    """Promises of a simulation. Provide the fixture ``factory``.

    Attributes:
        exposure_s: Exposure of the test frames, in seconds.
    """

    exposure_s: ClassVar[float] = 0.045

    @pytest.fixture
    def factory(self) -> Factory:
        """Constructs the simulation from a context. Provided by the plugin's test."""
        no_factory(self, "context -> simulation")

    def context(self, seed: int = 1) -> Context:
        """Context of the simulation. Override it for another grid."""
        return Context("simulation", SiteGrid(6, 7), clock=FakeClock(), random=RandomStream(seed))

    @contextmanager
    def opened(self, factory: Factory, seed: int = 1) -> Generator[tuple[Simulation, Context]]:
        """A new simulation, open, with its context. Closed at the end."""
        context = self.context(seed)
        simulation = factory(context)
        simulation.open()
        try:
            yield simulation, context
        finally:
            with suppress(Exception):  # close() has its own test
                simulation.close()

    def shot(
        self, simulation: Simulation, context: Context, index: int, *, lines_on: bool = True
    ) -> list[Frame]:
        """Take one shot as devices play it, with static tweezers on, loading and two frames.

        Args:
            simulation: The simulation, open.
            context: Its context, with the random numbers of the shot.
            index: Index of the shot.
            lines_on: Whether the static tweezers are on.
        """
        clock = context.clock
        context.random.begin_shot(index, 0)
        simulation.begin_shot()
        depth = 1.0 if lines_on else 0.0
        simulation.play("static_tweezers", DepthRamp(depth, depth), clock.now())
        simulation.load(clock.now(), LOADING_S)
        clock.sleep(LOADING_S)
        frames: list[Frame] = []
        for _ in range(2):
            clock.sleep(BETWEEN_S)
            frames.append(simulation.expose(clock.now(), self.exposure_s))
            clock.sleep(self.exposure_s)
        return frames

    @promise("the constructor does no I/O and changes no shared state")
    def test_constructor_does_no_io(self, factory: Factory) -> None:
        """``labseq check`` constructs it."""
        context = self.context()
        with quietly():
            factory(context)

    @promise("open() and close() twice do no harm, close() is legal before open(), and it opens again")
    def test_opens_and_closes_twice(self, factory: Factory) -> None:
        """A scan of its settings opens one simulation after another."""
        simulation = factory(self.context())
        for method in (
            simulation.close,
            simulation.open,
            simulation.open,
            simulation.close,
            simulation.close,
            simulation.open,
        ):
            with doing(f"{method.__name__}()"):
                method()
        simulation.close()

    @promise("expose() gives a Frame: uint16 (height, width), with the requested exposure and start")
    def test_gives_frames(self, factory: Factory) -> None:
        """Take frames of the same shape. A frame does not change when the next one is taken."""
        with self.opened(factory) as (simulation, context):
            frames: list[Any] = [*self.shot(simulation, context, 0)]
            copies = [np.array(getattr(frame, "image", 0)) for frame in frames]
            for frame in frames:
                assert isinstance(frame, Frame), f"expose() gave a {type(frame).__name__}"
                text = f"the frame is {frame.image.dtype} {frame.image.shape}"
                assert frame.image.dtype == np.uint16, text
                assert frame.image.ndim == 2, text
                assert frame.image.size > 0, text
                assert frame.exposure_s == self.exposure_s, f"its exposure is {frame.exposure_s} s"
            starts = [frame.t_start_s for frame in frames]
            now_s = context.clock.now()
            apart_s = self.exposure_s + BETWEEN_S
            wanted = [now_s - 2 * apart_s + BETWEEN_S, now_s - apart_s + BETWEEN_S]
            assert np.allclose(starts, wanted), f"the frames start at {starts} s, not at {wanted} s"
            more = self.shot(simulation, context, 1)
            shapes = {frame.image.shape for frame in [*frames, *more]}
            assert len(shapes) == 1, f"frames have the shapes {sorted(shapes)}"
            same = all(np.array_equal(was, frame.image) for was, frame in zip(copies, frames, strict=True))
            assert same, "the next exposures overwrote a frame"

    @promise(SAME_SEED)
    def test_same_seed_same_frames(self, factory: Factory) -> None:
        """Compare simulations with equal and different seeds, so that a run can be repeated."""
        frames = {
            name: self._shots(factory, (0, 1), seed) for name, seed in (("1", 1), ("again", 1), ("2", 2))
        }
        assert _equal(frames["1"], frames["again"]), "the second simulation with seed 1 shows other frames"
        assert not _equal(frames["1"], frames["2"]), "simulations with the seeds 1 and 2 show the same frames"

    @promise("a shot does not depend on earlier shots")
    def test_shots_are_independent(self, factory: Factory) -> None:
        """Take a shot with and without earlier ones. A resumed run gives the same data."""
        after_others = self._shots(factory, (0, 1, 2), 1)[-2:]
        alone = self._shots(factory, (2,), 1)
        with promised(SAME_SEED):
            assert _equal(alone, self._shots(factory, (2,), 1)), "the second simulation shows other frames"
        assert _equal(after_others, alone), "shot 2 shows other frames after the shots 0 and 1"

    @promise("atoms are loaded where static tweezers are on, and begin_shot() removes them")
    def test_loads_atoms(self, factory: Factory) -> None:
        """Load atoms, if the simulation reports the true occupancy."""
        with self.opened(factory) as (simulation, context):
            if simulation.truth() is None:
                return
            shape = context.grid.shape
            self.shot(simulation, context, 0)
            truth: Any = simulation.truth()
            assert isinstance(truth, np.ndarray), f"truth() gave a {type(truth).__name__}"
            text = f"truth() is {truth.dtype} {truth.shape}; expected bool {shape}"
            assert truth.dtype == np.bool_, text
            assert truth.shape == shape, text
            assert truth.any(), f"no atom after {LOADING_S:g} s of loading"
            context.random.begin_shot(1, 0)
            simulation.begin_shot()
            truth = simulation.truth()
            assert not truth.any(), "atoms outlive begin_shot()"
            self.shot(simulation, context, 2, lines_on=False)
            truth = simulation.truth()
            assert not truth.any(), "atoms were loaded while the static tweezers were off"

    @promise("an exposure that is not longer than 0 is refused with LimitError")
    def test_refuses_impossible_exposures(self, factory: Factory) -> None:
        """Try wrong exposures, after each of which the next shot works."""
        with self.opened(factory) as (simulation, context):
            self.shot(simulation, context, 0)
            for exposure_s in (0.0, -1.0, float("nan")):
                what = f"an exposure of {exposure_s} s"
                refusal(LimitError, what, simulation.expose, context.clock.now(), exposure_s)
            with doing("the next shot"):
                self.shot(simulation, context, 1)

    @promise("a signal that no device of the role can play raises LabseqError")
    def test_refuses_wrong_signals(self, factory: Factory) -> None:
        """Otherwise a driver's mistake would look like a lab without atoms."""
        ramp: Any = DepthRamp(1.0, 1.0)
        wrong: Any = "full power"
        with self.opened(factory) as (simulation, context):
            context.random.begin_shot(0, 0)
            simulation.begin_shot()
            for role, signal in (("mobile_tweezers", ramp), ("laser_9", ramp), ("static_tweezers", wrong)):
                what = f"a {type(signal).__name__} of '{role}'"
                refusal(LabseqError, what, simulation.play, role, signal, context.clock.now())

    @promise("describe() gives values that JSON can hold")
    def test_describes_itself(self, factory: Factory) -> None:
        """Every constant of the model is recorded in every run."""
        with self.opened(factory) as (simulation, _):
            described: Any = simulation.describe()
            assert isinstance(described, Mapping), f"it gave a {type(described).__name__}"
            json.dumps(dict(described), allow_nan=False)

    @promise("it draws from the context's random numbers alone and changes no shared state")
    def test_is_pure(self, factory: Factory) -> None:
        """Other plugins also draw from the global random numbers."""
        with self.opened(factory) as (simulation, context):
            self.shot(simulation, context, 0)  # the first call may compile
            with quietly():
                self.shot(simulation, context, 1)

    def _shots(self, factory: Factory, indices: tuple[int, ...], seed: int) -> list[np.ndarray[Any, Any]]:
        with self.opened(factory, seed) as (simulation, context):
            return [frame.image for index in indices for frame in self.shot(simulation, context, index)]


def _equal(some: list[np.ndarray[Any, Any]], others: list[np.ndarray[Any, Any]]) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(some, others, strict=True))
