from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from labseq.cli.show import Tables, show_run
from labseq.recording import RunWriter

SCAN = {
    "addresses": ["planner.degree_of_parallelism"],
    "points": [[1], [4]],
    "written": [["1"], ["4"]],
    "repeats": 4,
    "order": "sequential",
    "point_of_shot": [0, 0, 0, 0, 1, 1, 1, 1],
}


@pytest.fixture
def folder(fake: Any, tmp_path: Path) -> Path:
    """A run of eight shots that were all skipped, for two reasons."""
    writer = RunWriter.create(tmp_path, replace(fake.run(n_shots=8), scan=SCAN))
    writer.skip([0, 1, 2, 3, 4, 5], "DeviceError: laser: went out of lock")
    writer.skip([6], "filling\nfraction")
    writer.skip([7], "filling\nfraction")
    writer.finish("complete")
    return writer.run_dir


def test_what_was_skipped_is_told_with_the_reasons(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    show_run(folder, as_json=False)
    lines = capsys.readouterr().out.splitlines()
    assert "shots             0 of 8, 8 skipped" in lines
    assert "skipped           shots 1, 2, 3, 4, 5, ...: DeviceError: laser: went out of lock" in lines
    assert r"skipped           shots 7, 8: filling\nfraction" in lines
    show_run(folder, as_json=True)
    assert json.loads(capsys.readouterr().out)["skipped_shots"] == [
        {"shots": [0, 1, 2, 3, 4, 5], "why": "DeviceError: laser: went out of lock"},
        {"shots": [6, 7], "why": "filling\nfraction"},
    ]


def test_a_scan_whose_points_were_all_skipped_is_no_mistake(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    show_run(folder, as_json=False, tables=Tables(scan=True))
    assert capsys.readouterr().out == "no point of the scan has a shot: 8 of 8 were skipped\n"
    show_run(folder, as_json=True, tables=Tables(scan=True))
    assert json.loads(capsys.readouterr().out)["points"] == []
