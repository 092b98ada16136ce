"""Promises of a step of a shot."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from typing import Any, ClassVar, Final, TypeAlias

import numpy as np
import pytest

from labseq.errors import StopRequested
from labseq.guard import Guard
from labseq.model import ShotRecord, TimelineEntry
from labseq.roles import Step, StepContext
from labseq.sequencer.leader import LeaderAnswers
from labseq.sequencer.shot import Events, RunningShot, ShotSettings
from labseq.testing.contracts.promises import (
    ContractViolation,
    calls_of_sleep,
    doing,
    no_factory,
    promise,
    quietly,
    refusal,
)
from labseq.testing.fakes import FakeLab, RecordingObserver, fake_lab

Factory: TypeAlias = Callable[[], Step]

_BARS: Final = "return a list of TimelineEntry(label, min_duration_s, duration_s)"
TIMELINE: Final = "the timeline is known beforehand, as labelled bars with 0 <= min_duration_s <= duration_s"


RUNS: Final = "run(shot) works on the devices of a shot that has taken an image"
_MOVE_ATOMS: Final = frozenset(
    {"mobile_tweezers.play", "static_tweezers.load", "static_tweezers.ramp", "simulation.load"}
)
"""Calls that may move atoms, lose them or load more."""


class StepContract:
    """Promises of a step. Provide the fixture ``factory``, which has no arguments here.

    Devices are fakes. In every image the detector sees 4 x 4 sites full of atoms, except for one site that
    the target requires to be filled.
    """

    bases: ClassVar[tuple[str, ...]] = (RUNS,)

    @pytest.fixture
    def factory(self) -> Factory:
        """Constructs the step. Provided by the plugin's test."""
        no_factory(self, "nothing -> step")

    def lab(self) -> FakeLab:
        """The lab in which the step runs. Override it for devices or occupancies that the step needs."""
        seen = np.ones((4, 4), np.bool_)
        seen[1, 1] = False
        fill = np.zeros((4, 4), np.bool_)
        fill[1:3, 1:3] = True
        return fake_lab([seen], fill=fill, simulated=True)

    @promise(RUNS, "write it as 'def run(self, shot)', with durations in seconds and lengths in metres")
    def test_runs(self, factory: Factory) -> None:
        """Run the step once. Nothing else can be tested without it."""
        step = factory()
        with self.shot() as (shot, _):
            step.run(shot)

    @promise(TIMELINE, _BARS)
    def test_lays_out_its_timeline(self, factory: Factory) -> None:
        """``labseq check`` prints the timeline and adds it up."""
        for entry in self._timeline(factory()):
            assert entry.label, f"{entry} has no label"
            assert 0.0 <= entry.min_duration_s <= entry.duration_s < float("inf"), f"{entry}"
            assert entry.n_images >= 0, f"{entry}"

    @promise("constructor and timeline are pure, and the timeline is always the same")
    def test_timeline_is_pure(self, factory: Factory) -> None:
        """``labseq check`` opens nothing."""
        with quietly():
            step = factory()
            first = self._timeline(step)
        assert self._timeline(step) == first, "the second call gave a different timeline"

    @promise("needs_image and takes_image are known before the run")
    def test_declares_its_images(self, factory: Factory) -> None:
        """The order of the steps is checked with them."""
        step = factory()
        for name in ("needs_image", "takes_image"):
            value: Any = getattr(step, name)
            assert isinstance(value, bool), f"{name} is {value!r}"

    @promise(
        "it takes no longer, and no more images, than its timeline says",
        "plan_timeline() returns a TimelineEntry for each part of run(): duration in seconds, readout of the "
        "camera (context.camera.readout_s) included, and the number of images",
    )
    def test_keeps_its_timeline(self, factory: Factory) -> None:
        """Measured on the virtual clock. A timeline without lengths promises no limit."""
        step = factory()
        bars = self._timeline(step)
        with self.shot() as (shot, _):
            start_s, n_before = shot.elapsed_s, len(shot.record.images)
            with calls_of_sleep(type(step).__module__) as slept_s:
                step.run(shot)
            assert not slept_s, f"it called time.sleep({slept_s[0]:g}); wait with shot.clock.sleep"
            taken_s, n_taken = shot.elapsed_s - start_s, len(shot.record.images) - n_before
        planned_s, n_planned = sum(bar.duration_s for bar in bars), sum(bar.n_images for bar in bars)
        assert taken_s <= planned_s + 1e-6 or not planned_s, f"it took {taken_s} s, not {planned_s} s"
        assert n_taken <= n_planned, f"it took {n_taken} images, not {n_planned}"

    @promise("a `repeatable` step leaves the atoms alone, and can run again in the same shot")
    def test_runs_again(self, factory: Factory) -> None:
        """Run a repeatable step twice, as after a failure. By default a step is not repeatable."""
        step = factory()
        repeatable: Any = step.repeatable
        assert isinstance(repeatable, bool), f"repeatable is {repeatable!r}"
        if not repeatable:
            return
        with self.shot() as (shot, lab):
            before = len(lab.calls.names())
            for count in ("first", "second"):
                with doing(f"the {count} run"):
                    step.run(shot)
            done = [name for name in lab.calls.names()[before:] if name in _MOVE_ATOMS]
            assert not done, f"it is repeatable, but called {', '.join(dict.fromkeys(done))}"

    @promise(
        "a stop request ends it with StopRequested",
        "wait with shot.clock.sleep and call devices with shot.call (time.sleep ignores a stop request)",
    )
    def test_hears_a_stop_request(self, factory: Factory) -> None:
        """Ask it to stop. It waits and calls devices through the shot, which checks for stop requests."""
        step = factory()
        with self.shot() as (shot, lab):
            lab.stop.request()
            refusal(StopRequested, "a step that was asked to stop", step.run, shot)

    @contextmanager
    def shot(self) -> Generator[tuple[RunningShot, FakeLab]]:
        """A shot on open devices that has taken an image."""
        lab = self.lab()
        for _, device in lab.hardware():
            device.open()
        lab.static_tweezers.start()
        guard = Guard(lab.stop)
        events = Events(RecordingObserver(), guard)
        shot = RunningShot(ShotSettings(lab, (), (), {}), guard, ShotRecord(0, 0, 0, ""), events)
        shot.leaders = LeaderAnswers(shot, guard, events, {}, None)
        try:
            shot.take_image(0.045)
            yield shot, lab
        finally:
            events.release()
            guard.end()

    def _timeline(self, step: Step) -> list[TimelineEntry]:
        lab = self.lab()
        given: Any = step.plan_timeline(StepContext(lab.grid, lab.motion, lab.target))
        if not isinstance(given, Iterable):
            raise ContractViolation(TIMELINE, f"plan_timeline() gave a {type(given).__name__}", _BARS)
        entries: list[Any] = list(given)
        for entry in entries:
            if not isinstance(entry, TimelineEntry):
                raise ContractViolation(TIMELINE, f"plan_timeline() gave a {type(entry).__name__}", _BARS)
        return entries
