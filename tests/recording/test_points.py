"""The points of a scan, read back."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from labseq.data.best import best_point
from labseq.data.points import scan_points
from labseq.data.reader import open_run
from labseq.errors import RecordingError
from labseq.model import ScanRange
from labseq.recording.writer import RunWriter

from .records import make_run, make_shot

SCAN: dict[str, Any] = {
    "addresses": ["shot.sort.window", "planner"],
    "points": [[0.06, {"use": "psca"}], [0.2, {"use": "lsap"}], [0.3, {"use": "psca"}]],
    "written": [["60 ms", "{'use': 'psca'}"], ["0.2 s", "{'use': 'lsap'}"], ["0.3 s", "{'use': 'psca'}"]],
    "repeats": 2,
    "order": "shuffled",
    "point_of_shot": [1, 0, 2, 0, 1, 2],
}


def write(folder: Path, **changes: Any) -> Path:
    writer = RunWriter.create(folder, make_run(n_shots=6, **changes))
    fillings = [0.5, 1.0, None, 0.75, math.nan]
    for index, filling in enumerate(fillings):
        if filling is not None:
            shot = make_shot(index, filling_fraction=filling, success=filling == 1.0)
            writer.write_shot(shot)
    writer.finish("stopped")
    return writer.run_dir


def test_a_point_knows_its_values_and_its_shots(tmp_path: Path) -> None:
    run = open_run(write(tmp_path, scan=SCAN))
    assert run.record["scan"] == SCAN
    first, second = scan_points(run)
    assert first.parameters == {"shot.sort.window": 0.06, "planner": {"use": "psca"}}
    assert first.written["shot.sort.window"] == "60 ms"
    assert [shot.index for shot in first.shots] == [1, 3]
    assert [shot.filling_fraction for shot in first.shots] == [1.0, 0.75]
    assert [shot.index for shot in second.shots] == [0, 4]


@pytest.mark.parametrize(("maximise", "window"), [(True, "30 ms"), (False, "10 ms")])
def test_the_best_point_has_the_highest_mean_or_the_lowest(
    tmp_path: Path, maximise: bool, window: str
) -> None:
    scan = {
        "scanner": {"use": "climb"},
        "addresses": ["shot.sort.window"],
        "written_units": ["ms"],
        "ranges": [asdict(ScanRange("shot.sort.window", 0.01, 0.05))],
        "figure": "filling_fraction",
        "maximise": maximise,
    }
    writer = RunWriter.create(tmp_path, make_run(n_shots=3, scan=scan))
    for index, (window_s, filling) in enumerate([(0.02, 0.5), (0.03, 0.9), (0.01, 0.2)]):
        parameters = {"shot.sort.window": window_s}
        writer.write_shot(make_shot(index, filling_fraction=filling, parameters=parameters))
    best = best_point(open_run(writer.run_dir))
    assert best is not None
    assert best.point.written == {"shot.sort.window": window}


def test_a_run_without_a_scan_has_no_points(tmp_path: Path) -> None:
    assert scan_points(open_run(write(tmp_path))) == []


@pytest.mark.parametrize("damaged", [{"points": []}, {"point_of_shot": None}, {"addresses": ["one"]}])
def test_a_damaged_scan_is_told(tmp_path: Path, damaged: dict[str, Any]) -> None:
    folder = write(tmp_path, scan=SCAN)
    record = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(record | {"scan": SCAN | damaged}))
    with pytest.raises(RecordingError, match="damaged scan"):
        scan_points(open_run(folder))
