"""The paper's figures from runs of the sequences that come with labseq."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import labseq
from labseq.analysis.paper import figure_4, figure_5
from labseq.analysis.statistics import statistics_of
from labseq.errors import ConfigError, RecordingError
from labseq.recording import Run, open_run

ROOT = Path(__file__).parents[3]
PROFILE = str(ROOT / "hardware_profiles" / "virtual.yaml")


def take(root: Path, name: str, shots: int, *overrides: str) -> Run:
    path = ROOT / "sequences" / f"{name}.yaml"
    with labseq.Session.open(
        path, profile=PROFILE, shots=shots, seed=1, output=root, overrides=overrides
    ) as session:
        return session.run()


@pytest.fixture(scope="module")
def multicycle(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return take(tmp_path_factory.mktemp("five"), "figure5_multicycle", 5)


@pytest.fixture(scope="module")
def dop_scan(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return take(tmp_path_factory.mktemp("four"), "figure4_dop_scan", 28)


def changed(run: Run, folder: Path, **values: Any) -> Run:
    """A run with the same index, of which run.json says something else."""
    copy = folder / run.path.parent.name / run.path.name
    (copy / "shots").mkdir(parents=True)
    record = json.loads((run.path / "run.json").read_text("utf-8")) | values
    (copy / "run.json").write_text(json.dumps(record), "utf-8")
    for name in ("index.jsonl", "STATE"):
        (copy / name).write_bytes((run.path / name).read_bytes())
    return open_run(copy)


def test_figure_5_shows_what_each_cycle_came_to(multicycle: Run) -> None:
    drawing = figure_5(multicycle)
    (series,) = drawing.series
    cycles = statistics_of(multicycle.shots, multicycle.target).cycles
    assert series.x.tolist() == list(range(1, 11))
    assert series.y.tolist() == [cycle.defect_free.value for cycle in cycles]
    assert (series.low <= series.y).all()
    assert (series.y <= series.high).all()
    assert drawing.defects[0].sum() == 5
    assert "5 shots" in series.label


def test_the_ceiling_follows_the_times_that_were_recorded(multicycle: Run) -> None:
    max_defect_free = figure_5(multicycle).max_defect_free
    assert max_defect_free is not None
    assert max_defect_free.x.tolist() == list(range(1, 11))
    assert max_defect_free.y[0] == max_defect_free.y.min()  # the first cycle takes longest
    assert ((max_defect_free.y > 0.25) & (max_defect_free.y < 0.36)).all()


def test_real_hardware_has_no_ceiling(multicycle: Run, tmp_path: Path) -> None:
    assert figure_5(changed(multicycle, tmp_path, devices={})).max_defect_free is None


def test_the_papers_points_stand_beside_arrays_of_its_size_only(multicycle: Run, tmp_path: Path) -> None:
    quoted = figure_5(multicycle).quoted
    assert quoted is not None
    assert quoted.label == "Tian et al."
    assert [*zip(quoted.x, quoted.y, quoted.high - quoted.y, strict=True)] == [
        (1, pytest.approx(0.015), pytest.approx(0.003)),
        (2, pytest.approx(0.169), pytest.approx(0.008)),
        (10, pytest.approx(0.33), pytest.approx(0.01)),
    ]
    target = multicycle.record["target"]
    smaller = {**target, "fill": [row.replace("1", "0", 1) for row in target["fill"]]}
    assert figure_5(changed(multicycle, tmp_path, target=smaller)).quoted is None


def test_two_runs_are_told_apart(multicycle: Run) -> None:
    drawing = figure_5(multicycle, multicycle)
    assert len(drawing.series) == len(drawing.defects) == 2
    assert multicycle.path.name in drawing.series[0].label


def test_a_run_that_was_stopped_is_said_to_be(multicycle: Run, tmp_path: Path) -> None:
    run = changed(multicycle, tmp_path, n_shots=400)
    (run.path / "STATE").write_text('{"state": "stopped"}\n')
    assert "(stopped, 5 of 400 shots)" in figure_5(open_run(run.path)).note


def test_figure_4_has_a_series_with_one_window_and_one_with_their_own(dop_scan: Run) -> None:
    drawing = figure_4(dop_scan)
    (fixed,), (own,) = drawing.fixed, drawing.optimised
    assert fixed is not None
    assert own is not None
    assert fixed.x.tolist() == own.x.tolist() == list(range(2, 16))
    assert (fixed.label, own.label) == ("window 200 ms", "windows 60 ms to 94 ms")
    assert (fixed.y > 0.93).all()
    assert (own.y > 0.93).all()
    assert drawing.survival.y[[0, -1]] == pytest.approx(np.exp([-0.094 / 33, -0.06 / 33]))


def test_figure_4_compares_two_runs(dop_scan: Run) -> None:
    drawing = figure_4(dop_scan, dop_scan)
    labels = [one.label for one in (*drawing.fixed, *drawing.optimised) if one is not None]
    assert len(labels) == 4
    assert all(label.startswith(dop_scan.path.name) for label in labels)


def test_one_window_is_one_series(tmp_path: Path) -> None:
    sort = "shot.2.rearrange={cycles: 1, window: 100 ms, stop_when: never}"
    drawing = figure_4(take(tmp_path, "scan_dop", 4, sort))
    (fixed,) = drawing.fixed
    assert fixed is not None
    assert (fixed.label, fixed.x.tolist()) == ("window 100 ms", [3, 5, 7, 15])
    assert drawing.optimised == (None,)


@pytest.mark.parametrize(
    ("name", "shots", "overrides", "figure", "told"),
    [
        ("compact_225", 2, (), figure_5, r"2 of its shots make the first cycle.*'stop_when: never'"),
        ("compact_225", 1, ("shot=[{load: {}}, {image: {}}]",), figure_5, "no shot of it rearranges"),
        ("scan_dop", 4, (), figure_5, "it scans"),
        ("compact_225", 1, (), figure_4, "it does not scan planner.degree_of_parallelism"),
        ("scan_dop", 4, (), figure_4, "not all of its shots make one cycle"),
    ],
)
def test_a_run_of_another_kind_is_told_what_the_figure_needs(
    name: str, shots: int, overrides: tuple[str, ...], figure: Any, told: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=f"(?s)cannot be drawn from this run: .*{told}"):
        figure(take(tmp_path, name, shots, *overrides))


def test_a_scan_of_something_else_is_refused(dop_scan: Run, tmp_path: Path) -> None:
    scan = dop_scan.record["scan"]
    other = scan | {"addresses": [scan["addresses"][0], "profile.mobile_tweezers.speed"]}
    with pytest.raises(ConfigError, match=r"it also scans profile\.mobile_tweezers\.speed"):
        figure_4(changed(dop_scan, tmp_path, scan=other))


def test_more_than_two_windows_are_refused(dop_scan: Run, tmp_path: Path) -> None:
    scan = dop_scan.record["scan"]
    same = scan | {"points": [[7, window] for _, window in scan["points"]]}
    with pytest.raises(ConfigError, match="more than two windows"):
        figure_4(changed(dop_scan, tmp_path, scan=same))


def test_a_damaged_scan_is_told(dop_scan: Run, tmp_path: Path) -> None:
    scan = dop_scan.record["scan"] | {"points": []}
    with pytest.raises(RecordingError, match="damaged scan"):
        figure_4(changed(dop_scan, tmp_path, scan=scan))


def test_an_empty_run_has_no_figure(multicycle: Run, tmp_path: Path) -> None:
    run = changed(multicycle, tmp_path)
    (run.path / "index.jsonl").write_text("")
    with pytest.raises(ConfigError, match="cannot be drawn"):
        figure_5(open_run(run.path))
