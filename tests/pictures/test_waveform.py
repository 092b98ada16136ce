from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labseq.errors import ConfigError
from labseq.model import Batch, MotionSpec, Plan, SegmentKind
from labseq.model.motion import SpeedProfile
from labseq.motion import Renderer, tone_program
from labseq.pictures.waveforms import (
    DPI,
    INTENDED,
    KINDS,
    SIZE_IN,
    WaveformDrawing,
    save_waveform,
    tone_lines,
)

MATPLOTLIB = pytest.importorskip("matplotlib")
PIL = pytest.importorskip("PIL.Image")


def there_and_back(n_batches: int) -> Plan:
    batches = [([(0, 0), (0, 5)], [(0, 2), (0, 7)]), ([(0, 2), (0, 7)], [(0, 0), (0, 5)])]
    return Plan.from_batches([batches[i % 2] for i in range(n_batches)])


def drawing(plan: Plan, segments: range | None = None, **motion: Any) -> WaveformDrawing:
    spec = MotionSpec(**motion)
    program = tone_program(plan, motion=spec)
    segments = segments or range(program.n_segments)
    notes = "row axis: $x", "column axis: \\frac{"
    return WaveformDrawing(
        "a $title", "a $source", notes, program, Renderer(program, 250e6), segments, spec.rf
    )


def save(folder: Path, what: WaveformDrawing) -> np.ndarray[Any, Any]:
    path = folder / "waveform.png"
    save_waveform(path, what)
    with PIL.open(path) as image:
        assert image.info["Title"] == what.title
        return np.asarray(image.convert("RGB")).astype(int)


def count(pixels: np.ndarray[Any, Any], colour: Any) -> int:
    """Pixels of about this colour."""
    wanted = np.round(255 * np.array(MATPLOTLIB.colors.to_rgb(colour)))
    return int(np.count_nonzero(np.abs(pixels - wanted).max(axis=2) < 12))


@pytest.mark.parametrize("n_batches", [1, 40, 150])
def test_programs_of_all_lengths_can_be_drawn(tmp_path: Path, n_batches: int) -> None:
    pixels = save(tmp_path, drawing(there_and_back(n_batches)))
    assert pixels.shape[:2] == (round(SIZE_IN[1] * DPI), round(SIZE_IN[0] * DPI))
    assert all(count(pixels, colour) > 500 for _, colour in KINDS.values())
    assert count(pixels, INTENDED) > 200


def test_a_few_batches_can_be_drawn_alone(tmp_path: Path) -> None:
    what = drawing(there_and_back(5))
    second = np.flatnonzero(what.program.batch == 1)
    part = range(int(second[0]), int(second[-1]) + 1)
    assert count(save(tmp_path, drawing(there_and_back(5), part)), INTENDED) > 200


def test_linked_batches_and_no_pauses_can_be_drawn(tmp_path: Path) -> None:
    sites = [np.array([site], np.int16) for site in ([0, 0], [0, 3], [2, 3])]
    plan = Plan.from_batches([Batch(sites[0], sites[1]), Batch(sites[1], sites[2], linked=True)])
    save(tmp_path, drawing(plan))
    save(tmp_path, drawing(plan, overhead_per_batch_s=0.0, pick_up_s=0.0, drop_off_s=0.0))


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


def test_the_same_waveform_gives_the_same_bytes_whatever_the_users_style(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    what = drawing(there_and_back(2))
    save_waveform(tmp_path / "a.png", what)
    monkeypatch.setitem(MATPLOTLIB.rcParams, "savefig.facecolor", "black")
    monkeypatch.setitem(MATPLOTLIB.rcParams, "image.cmap", "hot")
    save_waveform(tmp_path / "b.png", what)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_picture_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the picture cannot be written"):
        save_waveform(tmp_path / "gone" / "a.png", drawing(there_and_back(1)))


def test_a_picture_that_cannot_be_written_leaves_the_older_one(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"an older one")
    (tmp_path / "a.png.part").mkdir()
    with pytest.raises(ConfigError, match="the picture cannot be written"):
        save_waveform(tmp_path / "a.png", drawing(there_and_back(1)))
    assert (tmp_path / "a.png").read_bytes() == b"an older one"
