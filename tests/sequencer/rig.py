"""A sequencer on a fake lab."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from labseq.builtin.steps import ImageStep, LoadStep
from labseq.model.policies import RunPolicy
from labseq.sequencer.run import Sequencer
from labseq.testing.fakes import ListSink, RecordingObserver, fake_lab


def given(**values: Any) -> Any:
    """Settings of a step, by keyword."""
    return SimpleNamespace(**values)


LOAD = ("load", LoadStep(given(duration=0.5)))
IMAGE = ("image", ImageStep(given(exposure=0.045)))
SAFE_ORDER = ["mobile_tweezers", "shutter", "camera", "static_tweezers"]
FULL, EMPTY = np.ones((2, 2), bool), np.zeros((2, 2), bool)


class Rig:
    """A sequencer on a fake lab."""

    def __init__(self, steps=(LOAD, IMAGE), attempts=3, sink=None, policy=None, **lab):
        self.lab = fake_lab(**lab)
        self.sink = sink or ListSink()
        self.observer = RecordingObserver()
        self.sequencer = Sequencer(
            *(self.lab, steps, self.lab.stop, self.sink, self.observer),
            seed=1,
            policy=policy or RunPolicy(attempts=attempts),
        )

    def run(self, n_shots=1):
        try:
            self.sequencer.open()
            self.given_up = {shot: why for shot in range(n_shots) if (why := self.sequencer.take(shot))}
        finally:
            self.unsafe = self.sequencer.shut_down()

    def made_safe(self):
        return [call.device for call in self.lab.calls if call.method == "safe_state"]

    def record(self):
        return self.sink.shots[-1]
