"""Timing boxes that break one promise each."""

from dataclasses import replace

import numpy as np

from labseq.model import LineProgram
from labseq.testing import LinesContract
from labseq.testing.fakes import RecordingLines

from .planted import Planted


class LeavesALineOn(RecordingLines):
    def compile(self, program: LineProgram) -> None:
        on = np.array(program.on)
        on[-1] = True
        super().compile(replace(program, on=on))


class RunsSlow(RecordingLines):
    def compile(self, program: LineProgram) -> None:
        super().compile(replace(program, t_s=np.array(program.t_s) * 1.01))


class ComesBackAtOnce(RecordingLines):
    def wait(self, timeout_s: float) -> None:
        if self._over_s - self.clock.now() > 10.0:  # a timeout is kept
            super().wait(timeout_s)
        self.use("wait", timeout_s)


class WaitsInFire(RecordingLines):
    def fire(self) -> None:
        super().fire()
        if self.programs[-1].duration_s < 1.0:
            self.clock.sleep(self.programs[-1].duration_s)


class StaysArmed(RecordingLines):
    def fire(self) -> None:
        super().fire()
        self._is_armed = True


class OpensWithLightOn(RecordingLines):
    def open(self) -> None:
        super().open()
        self.idle()


class LeavesLightOn(RecordingLines):
    def safe_state(self) -> None:
        self.note("safe_state")
        self.reset()


class KeepsItsProgram(RecordingLines):
    def safe_state(self) -> None:
        compiled = self._compiled
        super().safe_state()
        self._compiled = compiled


PLANTED = Planted(
    LinesContract(),
    RecordingLines,
    (
        (LeavesALineOn, "test_does_what_was_compiled"),
        (RunsSlow, "test_does_what_was_compiled"),
        (ComesBackAtOnce, "test_waits_for_the_end"),
        (WaitsInFire, "test_waits_for_the_end"),
        (StaysArmed, "test_refuses_fire_without_arm"),
        (KeepsItsProgram, "test_drops_its_program"),
        (OpensWithLightOn, "test_rests"),
        (LeavesLightOn, "test_rests"),
    ),
)
