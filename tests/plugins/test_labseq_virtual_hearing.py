"""What is heard is parted at the silences, and told once."""

from __future__ import annotations

import numpy as np
from labseq_virtual.rf_analysis import PulseReceiver, RfPulse

from labseq.model import RfSamples, RfSpan, RfTones


class Outputs:
    """An ``RfSource`` that says when it was asked, and answers what is put into it."""

    def __init__(self) -> None:
        self.rows: list[RfSpan] = []
        self.columns: list[RfSpan] = []
        self.asked: list[float] = []

    def played(self, until_s: float) -> tuple[list[RfSpan], list[RfSpan]]:
        self.asked.append(until_s)
        told = self.rows, self.columns
        self.rows, self.columns = [], []
        return told


def tone(start_s: float, end_s: float) -> RfTones:
    one = np.ones(1)
    return RfTones(start_s, end_s, 1e8 * one, 0 * one, one, 0 * one, 0 * one)


def times(found: list[RfPulse]) -> list[tuple[float, float]]:
    return [(pulse.start_s, pulse.end_s) for pulse in found]


def test_a_long_silence_parts_and_a_short_one_does_not() -> None:
    outputs = Outputs()
    outputs.rows = [tone(1.0, 1.1), tone(1.15, 1.2), tone(2.0, 2.1)]
    found = list(PulseReceiver(outputs, 0.1).receive_until(3.0))
    assert times(found) == [(1.0, 1.2), (2.0, 2.1)]
    assert [len(pulse.rows) for pulse in found] == [2, 1]
    assert outputs.asked == [3.0]


def test_an_episode_lasts_while_either_output_sounds() -> None:
    outputs = Outputs()
    outputs.rows, outputs.columns = [tone(1.0, 1.5)], [tone(0.8, 1.2), tone(4.0, 4.1)]
    first, second = PulseReceiver(outputs, 0.1).receive_until(5.0)
    assert times([first, second]) == [(0.8, 1.5), (4.0, 4.1)]
    assert (len(first.rows), len(first.columns), len(second.rows)) == (1, 1, 0)


def test_silent_samples_are_no_episode() -> None:
    outputs = Outputs()
    outputs.rows = [RfSamples(1.0, 1e6, np.zeros(1000, np.int16), 1e-5)]
    assert list(PulseReceiver(outputs, 0.1).receive_until(2.0)) == []


def test_light_that_was_cut_off_and_goes_on_says_so() -> None:
    outputs = Outputs()
    ear = PulseReceiver(outputs, 0.1)
    outputs.rows = [tone(1.0, 2.0)]
    (before,) = ear.receive_until(2.0)
    outputs.rows = [tone(2.0, 2.5)]
    (after,) = ear.receive_until(3.0)
    outputs.rows = [tone(3.5, 3.6)]
    (later,) = ear.receive_until(4.0)
    assert [pulse.continued for pulse in (before, after, later)] == [False, True, False]
