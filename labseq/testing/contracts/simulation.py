"""What a simulated world promises."""

from __future__ import annotations

import json
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, ClassVar, Final, TypeAlias

import numpy as np
import pytest

from labseq.errors import LabseqError, LimitError
from labseq.model import DepthRamp, Frame, RandomStream, SiteGrid
from labseq.roles import Context, Simulation, offers
from labseq.testing.contracts.process import quietly
from labseq.testing.contracts.promises import doing, no_factory, promise, promised, refusal
from labseq.testing.fakes import FakeClock

Factory: TypeAlias = Callable[[Context], Simulation]

LOADING_S: Final = 2.0
BETWEEN_S: Final = 0.01
SAME_SEED: Final = "the same seed gives the same frames, and another seed others"


class SimulationContract:
    """Promises of a simulated world; provide the fixture ``factory``.

    Attributes:
        exposure_s: Exposure of the test frames, in seconds.
    """

    exposure_s: ClassVar[float] = 0.045

    @pytest.fixture
    def factory(self) -> Factory:
        """Constructs the world, given a context; provided by the plugin's test."""
        no_factory(self, "context -> simulation")

    def context(self, seed: int = 1) -> Context:
        """What the world is constructed with; override it for another grid."""
        return Context("simulation", SiteGrid(6, 7), clock=FakeClock(), random=RandomStream(seed))

    @contextmanager
    def opened(self, factory: Factory, seed: int = 1) -> Generator[tuple[Simulation, Context]]:
        """A new world, open, with its context; closed at the end."""
        context = self.context(seed)
        world = factory(context)
        world.open()
        try:
            yield world, context
        finally:
            with suppress(Exception):  # what close() promises has a test of its own
                world.close()

    def shot(self, world: Simulation, context: Context, index: int, *, lines_on: bool = True) -> list[Frame]:
        """One shot, as devices play it: the static tweezers on, loading, two frames.

        Args:
            world: The world, open.
            context: Its context; its random numbers are those of the shot.
            index: Index of the shot.
            lit: Whether the static tweezers are on.
        """
        clock = context.clock
        context.random.begin_shot(index, 0)
        world.begin_shot()
        depth = 1.0 if lines_on else 0.0
        world.play("static_tweezers", DepthRamp(depth, depth), clock.now())
        world.load(clock.now(), LOADING_S)
        clock.sleep(LOADING_S)
        frames: list[Frame] = []
        for _ in range(2):
            clock.sleep(BETWEEN_S)
            frames.append(world.expose(clock.now(), self.exposure_s))
            clock.sleep(self.exposure_s)
        return frames

    @promise("the constructor does no I/O, and changes nothing that all code shares")
    def test_constructor_does_no_io(self, factory: Factory) -> None:
        """``labseq check`` constructs it."""
        context = self.context()
        with quietly():
            factory(context)

    @promise("open() and close() twice do no harm, close() is legal before open(), and it opens again")
    def test_opens_and_closes_twice(self, factory: Factory) -> None:
        """A scan of its settings opens one after the other."""
        world = factory(self.context())
        for method in (world.close, world.open, world.open, world.close, world.close, world.open):
            with doing(f"{method.__name__}()"):
                method()
        world.close()

    @promise("expose() gives a Frame: uint16 (height, width), with the exposure and the start asked for")
    def test_gives_frames(self, factory: Factory) -> None:
        """All of the same shape; a frame does not change when the next one is taken."""
        with self.opened(factory) as (world, context):
            frames: list[Any] = [*self.shot(world, context, 0)]
            kept = [np.array(getattr(frame, "image", 0)) for frame in frames]
            for frame in frames:
                assert isinstance(frame, Frame), f"expose() gave a {type(frame).__name__}"
                told = f"the frame is {frame.image.dtype} {frame.image.shape}"
                assert frame.image.dtype == np.uint16, told
                assert frame.image.ndim == 2, told
                assert frame.image.size > 0, told
                assert frame.exposure_s == self.exposure_s, f"it tells an exposure of {frame.exposure_s} s"
            starts = [frame.t_start_s for frame in frames]
            now_s = context.clock.now()
            apart_s = self.exposure_s + BETWEEN_S
            wanted = [now_s - 2 * apart_s + BETWEEN_S, now_s - apart_s + BETWEEN_S]
            assert np.allclose(starts, wanted), f"frames tell that they start at {starts} s, not {wanted} s"
            more = self.shot(world, context, 1)
            shapes = {frame.image.shape for frame in [*frames, *more]}
            assert len(shapes) == 1, f"frames have the shapes {sorted(shapes)}"
            same = all(np.array_equal(was, frame.image) for was, frame in zip(kept, frames, strict=True))
            assert same, "the next exposures overwrote a frame"

    @promise(SAME_SEED)
    def test_same_seed_same_frames(self, factory: Factory) -> None:
        """So a run can be taken again."""
        made = {name: self._shots(factory, (0, 1), seed) for name, seed in (("1", 1), ("again", 1), ("2", 2))}
        assert _equal(made["1"], made["again"]), "the second world with seed 1 shows other frames"
        assert not _equal(made["1"], made["2"]), "worlds with the seeds 1 and 2 show the same frames"

    @promise("a shot does not depend on those before it")
    def test_shots_are_independent(self, factory: Factory) -> None:
        """So a run that is resumed goes on as if nothing had happened; no atom outlives a shot."""
        after_others = self._shots(factory, (0, 1, 2), 1)[-2:]
        alone = self._shots(factory, (2,), 1)
        with promised(SAME_SEED):
            assert _equal(alone, self._shots(factory, (2,), 1)), "the second world shows other frames"
        assert _equal(after_others, alone), "shot 2 shows other frames after the shots 0 and 1"

    @promise("atoms are loaded where static tweezers are on, and begin_shot() removes them")
    def test_loads_atoms(self, factory: Factory) -> None:
        """Of a world that tells the truth."""
        with self.opened(factory) as (world, context):
            if not offers(world, "truth"):
                return
            shape = context.grid.shape
            self.shot(world, context, 0)
            truth: Any = world.truth()
            assert isinstance(truth, np.ndarray), f"truth() gave a {type(truth).__name__}"
            told = f"truth() is {truth.dtype} {truth.shape}; expected bool {shape}"
            assert truth.dtype == np.bool_, told
            assert truth.shape == shape, told
            assert truth.any(), f"no atom after {LOADING_S:g} s of loading"
            context.random.begin_shot(1, 0)
            world.begin_shot()
            truth = world.truth()
            assert not truth.any(), "atoms outlive begin_shot()"
            self.shot(world, context, 2, lines_on=False)
            truth = world.truth()
            assert not truth.any(), "atoms were loaded while the static tweezers were off"

    @promise("an exposure that is not longer than 0 is refused with LimitError")
    def test_refuses_impossible_exposures(self, factory: Factory) -> None:
        """And the shot goes on."""
        with self.opened(factory) as (world, context):
            self.shot(world, context, 0)
            for exposure_s in (0.0, -1.0, float("nan")):
                what = f"an exposure of {exposure_s} s"
                refusal(LimitError, what, world.expose, context.clock.now(), exposure_s)
            with doing("the next shot"):
                self.shot(world, context, 1)

    @promise("a signal that no device of the role can play raises LabseqError")
    def test_refuses_wrong_signals(self, factory: Factory) -> None:
        """Else a driver's mistake would look like a lab without atoms."""
        ramp: Any = DepthRamp(1.0, 1.0)
        wrong: Any = "full power"
        with self.opened(factory) as (world, context):
            context.random.begin_shot(0, 0)
            world.begin_shot()
            for role, signal in (("mobile_tweezers", ramp), ("laser_9", ramp), ("static_tweezers", wrong)):
                what = f"a {type(signal).__name__} of '{role}'"
                refusal(LabseqError, what, world.play, role, signal, context.clock.now())

    @promise("describe() gives values that JSON can hold")
    def test_describes_itself(self, factory: Factory) -> None:
        """Every constant of the model is written into every run."""
        with self.opened(factory) as (world, _):
            described: Any = world.describe()
            assert isinstance(described, Mapping), f"it gave a {type(described).__name__}"
            json.dumps(dict(described), allow_nan=False)

    @promise("it draws from the context's random numbers alone, and changes nothing that all code shares")
    def test_is_pure(self, factory: Factory) -> None:
        """Other plugins draw from the global random numbers too."""
        with self.opened(factory) as (world, context):
            self.shot(world, context, 0)  # may compile
            with quietly():
                self.shot(world, context, 1)

    def _shots(self, factory: Factory, indices: tuple[int, ...], seed: int) -> list[np.ndarray[Any, Any]]:
        with self.opened(factory, seed) as (world, context):
            return [frame.image for index in indices for frame in self.shot(world, context, index)]


def _equal(some: list[np.ndarray[Any, Any]], others: list[np.ndarray[Any, Any]]) -> bool:
    return all(np.array_equal(one, other) for one, other in zip(some, others, strict=True))
