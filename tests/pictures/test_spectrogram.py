from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, strategies as st

from labseq.model import Plan, SegmentKind
from labseq.motion import Renderer, render, tone_program
from labseq.pictures.waveforms import WaveformPieces, envelope, spectrogram

RATE_HZ = 250e6
PLAN = Plan.from_batches([([(0, 0), (0, 5)], [(0, 3), (0, 7)]), ([(0, 3)], [(0, 1)])])
PROGRAM = tone_program(PLAN)
RENDERER = Renderer(PROGRAM, RATE_HZ)


def pieces() -> list[tuple[int, int]]:
    first = RENDERER.first_sample
    on = np.flatnonzero(PROGRAM.kind != SegmentKind.IDLE)
    return [(int(first[i]), int(first[i + 1])) for i in on]


@given(st.lists(st.tuples(st.integers(0, 50), st.integers(0, 50)), min_size=1, max_size=5))
def test_places_in_the_picture_count_the_samples_of_all_pieces(spans: list[tuple[int, int]]) -> None:
    ends = np.cumsum([gap + length for gap, length in spans]).tolist()
    bounds = [(end - length, end) for end, (_, length) in zip(ends, spans, strict=True)]
    stretches = WaveformPieces.of(bounds)
    expected = [n for first, stop in bounds for n in range(first, stop)]
    assert stretches.n_samples == len(expected)
    assert stretches.in_waveform(np.arange(len(expected))).tolist() == expected


@pytest.mark.parametrize("channel", [0, 1])
def test_the_strongest_frequency_is_the_strongest_tone(channel: int) -> None:
    stretches = WaveformPieces.of(pieces())
    level_db, (low_hz, high_hz) = spectrogram(RENDERER, channel, stretches, 60, (82e6, 118e6))
    bin_hz = (high_hz - low_hz) / len(level_db)
    centres = stretches.in_waveform(((np.arange(60) + 0.5) * stretches.n_samples / 60).astype(np.int64))
    for column, sample in enumerate(centres):
        at = PROGRAM.tones_at(float(sample) / RATE_HZ)
        tones = (at.row, at.column)[channel]
        found_hz = low_hz + (int(level_db[:, column].argmax()) + 0.5) * bin_hz
        assert np.abs(tones.frequency_hz - found_hz).min() < 2 * bin_hz + 0.1e6


def test_a_tone_has_the_level_of_its_amplitude() -> None:
    level_db, _ = spectrogram(RENDERER, 0, WaveformPieces.of(pieces()), 40, (82e6, 118e6))
    assert level_db.max(axis=0)[5:-5] == pytest.approx(20 * np.log10(1 / 20), abs=1.0)


def test_silence_is_no_level_and_no_envelope() -> None:
    pause = WaveformPieces.of([(0, int(RENDERER.first_sample[1]) - 2000)])
    level_db, _ = spectrogram(RENDERER, 1, pause, 20, (90e6, 110e6))
    assert level_db[:, :-1].max() == pytest.approx(-120)
    assert not envelope(RENDERER, 1, pause, 20).any()


@pytest.mark.parametrize("n_columns", [1, 7, 100, 3000])
@pytest.mark.parametrize("channel", [0, 1])
def test_the_envelope_looks_at_every_sample(channel: int, n_columns: int) -> None:
    stretches = WaveformPieces.of(pieces())
    found = envelope(RENDERER, channel, stretches, n_columns)
    samples = np.concatenate([render(PROGRAM, RATE_HZ).samples[channel, a:b] for a, b in pieces()])
    edges = np.rint(np.linspace(0, len(samples), n_columns + 1)).astype(int)
    expected = [np.abs(samples[a:b]).max() for a, b in pairwise(edges)]
    assert (found * 32767).tolist() == pytest.approx(expected)
