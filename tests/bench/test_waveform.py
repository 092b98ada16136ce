from __future__ import annotations

import json

import numpy as np
import pytest

from labseq.bench.rendering import bench_waveform, stored_waveforms, uniform_program
from labseq.model import SiteGrid
from labseq.motion import Renderer, RenderPath

GRID = SiteGrid()


def test_the_report_has_a_row_for_everything_and_each_goal() -> None:
    report = bench_waveform(1)
    rows = {row.name: row for row in report.rows}
    assert len(rows) == len(report.rows) == 9
    assert all(row.gigasamples_per_s > 0 and row.playing_over_rendering > 0 for row in report.rows)
    assert [row.goal for row in report.rows] == [3.0, 3.0, 2.0, 2.0, 1.0, 2.5, None, None, None]
    assert [(ratio.goal, ratio.at_most) for ratio in report.ratios] == [
        (1.3, True),
        (5.0, False),
        (100.0, False),
    ]
    slow, fast = rows["stored waveforms, 20 tones"], rows["1 group, 20 tones"]
    assert report.ratios[1].value == pytest.approx(fast.gigasamples_per_s / slow.gigasamples_per_s)
    values = json.loads(json.dumps(report.as_dict(), allow_nan=False))
    assert (values["sample_rate_hz"], values["repeats"], len(values["rows"])) == (624e6, 1, 9)


@pytest.mark.parametrize(("directions", "n_groups"), [((0,), 1), ((1,), 1), ((1, 0, -1), 3)])
def test_uniform_programs_are_what_they_are_called(directions: tuple[int, ...], n_groups: int) -> None:
    program = uniform_program(GRID, 7, directions)
    chirps = np.unique((program.column.end_hz - program.column.start_hz)[:7])
    assert len(chirps) == n_groups
    assert (Renderer(program, 624e6).path == RenderPath.COMB).all()


def test_stored_waveforms_are_those_of_the_tones() -> None:
    stored = stored_waveforms(GRID, 624e6)
    n = np.arange(1000)
    for tone in (0, 19):
        expected = 32767 / 20 * np.cos(2 * np.pi * GRID.column_frequency_hz[tone] / 624e6 * n)
        assert np.abs(stored[tone, :1000] - expected).max() <= 0.5001
