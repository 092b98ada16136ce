from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from matplotlib.colors import to_rgb
from PIL import Image

from labseq.model import Batch, MotionSpec, Plan, SegmentKind
from labseq.model.motion import SpeedProfile
from labseq.motion import tone_program
from labseq.motion.rendering import Renderer, render
from labseq.plans.waveform_picture import (
    DPI,
    INTENDED,
    KINDS,
    SIZE_IN,
    WaveformDrawing,
    WaveformPieces,
    envelope,
    save_waveform,
    spectrogram,
    tone_lines,
)


def there_and_back(n_batches: int) -> Plan:
    batches = [([(0, 0), (0, 5)], [(0, 2), (0, 7)]), ([(0, 2), (0, 7)], [(0, 0), (0, 5)])]
    return Plan.from_batches([batches[i % 2] for i in range(n_batches)])


def drawing(plan: Plan, **motion: Any) -> WaveformDrawing:
    spec = MotionSpec(**motion)
    program = tone_program(plan, motion=spec)
    segments = range(program.n_segments)
    notes = "row axis: $x", "column axis: \\frac{"
    return WaveformDrawing(
        "a $title", "a $source", notes, program, Renderer(program, 250e6), segments, spec.rf
    )


def save(folder: Path, what: WaveformDrawing) -> np.ndarray[Any, Any]:
    path = folder / "waveform.png"
    save_waveform(path, what)
    with Image.open(path) as image:
        assert image.info["Title"] == what.title
        return np.asarray(image.convert("RGB")).astype(int)


def count(pixels: np.ndarray[Any, Any], colour: Any) -> int:
    """Pixels of about this colour."""
    wanted = np.round(255 * np.array(to_rgb(colour)))
    return int(np.count_nonzero(np.abs(pixels - wanted).max(axis=2) < 12))


def test_a_long_program_with_pauses_can_be_drawn(tmp_path: Path) -> None:
    pixels = save(tmp_path, drawing(there_and_back(16)))
    assert pixels.shape[:2] == (round(SIZE_IN[1] * DPI), round(SIZE_IN[0] * DPI))
    assert all(count(pixels, colour) > 500 for _, colour in KINDS.values())
    assert count(pixels, INTENDED) > 200


def test_one_of_several_linked_batches_without_pauses_or_ramps_can_be_drawn(tmp_path: Path) -> None:
    sites = [np.array([site], np.int16) for site in ([0, 0], [0, 3], [2, 3])]
    plan = Plan.from_batches([Batch(sites[0], sites[1]), Batch(sites[1], sites[2], linked=True)])
    what = drawing(plan, overhead_per_batch_s=0.0, pick_up_s=0.0, drop_off_s=0.0)
    second = np.flatnonzero(what.program.batch == 1)
    pixels = save(tmp_path, replace(what, segments=range(int(second[0]), int(second[-1]) + 1)))
    assert count(pixels, INTENDED) > 200


@pytest.mark.parametrize("profile", ["constant", "minimum_jerk", "constant_jerk"])
def test_the_lines_are_where_the_program_has_its_tones(profile: SpeedProfile) -> None:
    program = tone_program(there_and_back(2), motion=MotionSpec(speed_profile=profile))
    on = np.flatnonzero(program.kind != SegmentKind.IDLE).tolist()
    at_s = np.concatenate([[0.0], np.cumsum(program.duration_s[on])])
    lines = tone_lines(program, program.column, on, at_s)
    n = 0
    for k, i in enumerate(on):
        n_tones = int(program.column.offsets[i + 1] - program.column.offsets[i])
        its = np.stack(lines[n : n + n_tones])
        n += n_tones
        assert its[:, [0, -1], 0] == pytest.approx(np.tile(at_s[k : k + 2], (n_tones, 1)))
        for point in range(its.shape[1] - 1):
            t_s = its[0, point, 0] - at_s[k] + program.joint_s[i] + 1e-12
            assert its[:, point, 1] == pytest.approx(program.tones_at(t_s).column.frequency_hz, abs=10)
    assert n == len(lines)


RATE_HZ = 250e6
PLAN = Plan.from_batches([([(0, 0), (0, 5)], [(0, 3), (0, 7)]), ([(0, 3)], [(0, 1)])])
PROGRAM = tone_program(PLAN, motion=MotionSpec(overhead_per_batch_s=0.5e-3))
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
    found = np.sort(level_db.max(axis=0)[5:-5])[1:]  # but for the column in which one batch follows another
    assert found == pytest.approx(20 * np.log10(1 / 20), abs=1.0)


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
