"""Static and mobile tweezers that break one promise each."""

from typing import Any

import numpy as np

from labseq.errors import LimitError
from labseq.model import ToneProgram, TweezersFacts
from labseq.testing import MobileTweezersContract, StaticTweezersContract
from labseq.testing.fakes import RecordingMobileTweezers, RecordingStaticTweezers

from .planted import Planted


class StartsAgain(RecordingStaticTweezers):
    def start(self) -> None:
        self.depth = 0.0
        super().start()


class StaysShallow(RecordingStaticTweezers):
    def start(self) -> None:
        if self.depth == 0.0:
            super().start()


class NeverTurnsOff(RecordingStaticTweezers):
    def ramp(self, depth: float, duration_s: float) -> None:
        if depth == 0.0:
            raise LimitError("the depth", depth, "more than 0")
        super().ramp(depth, duration_s)


class ReleasesLater(RecordingStaticTweezers):
    def release(self, duration_s: float) -> float:
        self.use("release", duration_s)
        return duration_s


class NormalizesInPlace(RecordingStaticTweezers):
    def load(self, amplitudes: Any) -> None:
        super().load(amplitudes)
        if amplitudes is not None:
            amplitudes[0][...] /= amplitudes[0].sum()


class RampsBeforeItLooks(RecordingStaticTweezers):
    def ramp(self, depth: float, duration_s: float) -> None:
        if depth > 1:
            super().ramp(1.0, duration_s)
        super().ramp(depth, duration_s)


class LoadsAnything(RecordingStaticTweezers):
    def load(self, amplitudes: Any) -> None:
        super().load(None)


class TakesAnyWeights(RecordingStaticTweezers):
    @property
    def facts(self) -> TweezersFacts:
        return TweezersFacts(shortest_release_s=0.0, control="sites")

    def load(self, amplitudes: Any) -> None:
        if amplitudes is not None:
            raise LimitError("amplitudes of tones", "given", "None")
        super().load(None)

    def load_weights(self, weights: Any) -> None:
        self.use("load_weights", weights)


class RampsAnyway(RecordingStaticTweezers):
    @property
    def facts(self) -> TweezersFacts:
        return TweezersFacts(shortest_release_s=0.0, ramps=False)


STATIC = Planted(
    StaticTweezersContract(),
    RecordingStaticTweezers,
    (
        (StartsAgain, "test_starts_twice"),
        (StaysShallow, "test_starts_after_a_ramp"),
        (NeverTurnsOff, "test_ramps"),
        (ReleasesLater, "test_releases"),
        (NormalizesInPlace, "test_loads_amplitudes"),
        (RampsBeforeItLooks, "test_refuses_what_exceeds_limits"),
        (LoadsAnything, "test_refuses_what_exceeds_limits"),
        (TakesAnyWeights, "test_loads_weights"),
        (RampsAnyway, "test_ramps"),
    ),
)


class LeavesOutThePauses(RecordingMobileTweezers):
    def prepare(self, program: ToneProgram) -> float:
        return 0.5 * super().prepare(program)


class RunsOutOfMemory(RecordingMobileTweezers):
    n_held = 0

    def prepare(self, program: ToneProgram) -> float:
        if self.n_held == 2:
            raise MemoryError
        self.n_held, n_held = 0, self.n_held  # what is refused frees the memory
        duration_s = super().prepare(program)
        self.n_held = n_held + 1
        return duration_s

    def safe_state(self) -> None:
        self.n_held = 0
        super().safe_state()


class PlaysToTheEnd(RecordingMobileTweezers):
    def play(self) -> None:
        super().play()
        self.clock.sleep(0.6 * self.programs[-1].total_duration_s)


class PlaysAtOnce(RecordingMobileTweezers):
    """After ``open`` it plays silence."""

    is_new = True

    def play(self) -> None:
        if not self.is_new or not self.is_open:
            super().play()

    def prepare(self, program: ToneProgram) -> float:
        self.is_new = False
        return super().prepare(program)

    def safe_state(self) -> None:
        self.is_new = False
        super().safe_state()


class StaysPrepared(RecordingMobileTweezers):
    def safe_state(self) -> None:
        prepared = self._prepared
        super().safe_state()
        self._prepared = prepared


class WaitsForItsTrigger(RecordingMobileTweezers):
    """Right: with a line, ``play`` only arms them."""

    @property
    def waits_for_trigger(self) -> bool:
        return True

    armed: ToneProgram | None = None

    def open(self) -> None:
        super().open()
        assert self.simulation is not None
        self.simulation.wire("mobile_tweezers", lambda t_s, _width_s: self.start(t_s))

    def play(self) -> None:
        self.armed = self._prepared
        super().play()

    def start(self, t_s: float) -> None:
        if self.armed is not None and self.simulation is not None:
            self.simulation.play(self.name, self.armed, t_s)

    def safe_state(self) -> None:
        self.armed = None
        super().safe_state()


class StaysArmed(WaitsForItsTrigger):
    def safe_state(self) -> None:
        armed = self.armed
        super().safe_state()
        self.armed = armed


class FailsOnNothing(RecordingMobileTweezers):
    def prepare(self, program: ToneProgram) -> float:
        duration_s = super().prepare(program)
        np.max(program.row.start_hz)
        return duration_s


class LooksWhenItPlays(RecordingMobileTweezers):
    def prepare(self, program: ToneProgram) -> float:
        try:
            return super().prepare(program)
        except LimitError:
            return program.total_duration_s


class WaitsToTheEnd(RecordingMobileTweezers):
    def wait(self, timeout_s: float) -> None:
        super().wait(3600.0)


class TellsItsTimings(RecordingMobileTweezers):
    """Right: tells how long it took."""

    def timings(self) -> Any:
        return {"render": 0.0, "upload": 1e-9}


class TellsMilliseconds(TellsItsTimings):
    def timings(self) -> Any:
        return {"render": 1e3}


MOBILE = Planted(
    MobileTweezersContract(),
    RecordingMobileTweezers,
    (
        (LeavesOutThePauses, "test_tells_the_playing_time"),
        (RunsOutOfMemory, "test_plays_programs"),
        (PlaysToTheEnd, "test_play_returns_at_once"),
        (PlaysAtOnce, "test_refuses_play_without_prepare"),
        (StaysPrepared, "test_drops_its_program"),
        (StaysArmed, "test_drops_its_program"),
        (FailsOnNothing, "test_takes_an_empty_program"),
        (LooksWhenItPlays, "test_refuses_what_exceeds_limits"),
        (TellsMilliseconds, "test_tells_its_timings"),
        (WaitsToTheEnd, "test_keeps_timeouts"),
    ),
)
