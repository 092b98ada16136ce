"""What a simulated card hands to a world that listens: each span once, at its time."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from labseq_spcm.world import CardOutputs

from labseq.model import RfSamples, RfSpan, RfTones
from labseq.testing.fakes import FakeClock


def values(spans: list[RfSpan]) -> np.ndarray[tuple[int], np.dtype[np.int16]]:
    """The samples of spans that follow one another without a gap."""
    sampled = [span for span in spans if isinstance(span, RfSamples)]
    assert len(sampled) == len(spans)
    for before, after in itertools.pairwise(sampled):
        assert after.start_s == pytest.approx(before.end_s, abs=1e-12)
    return np.concatenate([span.samples for span in sampled])


@pytest.mark.parametrize("mode", ["replay", "fifo"])
def test_samples_are_told_in_pieces_that_fit_together(driver: Any, mode: str) -> None:
    with driver(mode) as lab:
        lab.play(lab.program(1))
        expected = [lab.samples(channel) for channel in (0, 1)]
        start_s = lab.card.played(0)[0].start_s
        outputs = CardOutputs(lab.card, row_channel=0)
        told: tuple[list[RfSpan], list[RfSpan]] = ([], [])
        for until_s in (start_s - 1e-3, start_s + 0.61234567e-3, start_s + 0.7e-3, start_s + 1.0):
            for axis, spans in zip(told, outputs.played(until_s), strict=True):
                axis += spans
        for axis, samples in zip(told, expected, strict=True):
            np.testing.assert_array_equal(values(axis), samples)
        assert outputs.played(start_s + 2.0) == ([], [])
        assert lab.card.played(0) == []


def test_the_row_output_comes_first(driver: Any) -> None:
    with driver("replay", row_channel=1, column_channel=0) as lab:
        lab.play(lab.program(1))
        rows, columns = lab.samples(1), lab.samples(0)
        told = CardOutputs(lab.card, row_channel=1).played(lab.clock.now())
        np.testing.assert_array_equal(values(told[0]), rows)
        np.testing.assert_array_equal(values(told[1]), columns)


def test_tones_are_cosines_in_volts(driver: Any) -> None:
    with driver("dds") as lab:
        lab.play(lab.program(1))
        played = [span for span in lab.card.played(0) if span.tones]
        told = [
            span for span in CardOutputs(lab.card, 0).played(lab.clock.now())[0] if isinstance(span, RfTones)
        ]
        assert len(told) == len(played) > 5
        for span, heard in zip(played, told, strict=True):
            t_s = np.linspace(0, span.end_s - span.start_s, 50, endpoint=False)
            expected = sum(tone.values(t_s) for tone in span.tones) * span.amplitude_v
            turns = heard.frequency_hz[:, None] * t_s + heard.frequency_slope[:, None] * t_s**2 / 2
            volts = heard.amplitude_v[:, None] + heard.amplitude_slope[:, None] * t_s
            waves = volts * np.cos(2 * np.pi * turns + heard.phase_rad[:, None])
            np.testing.assert_allclose(waves.sum(axis=0), expected, atol=1e-7)


def test_a_card_that_plays_nothing_is_silent(driver: Any) -> None:
    with driver("replay") as lab:
        assert CardOutputs(lab.card, 0).played(FakeClock().now() + 1.0) == ([], [])
