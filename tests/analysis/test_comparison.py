"""Runs beside one another, and a number over many runs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from labseq.analysis.comparison import Compared
from labseq.data.reader import Run, open_run
from labseq.files import write_file

DAYS = ("2026-11-20", "2026-11-21", "2026-11-28")


@pytest.fixture
def data(lifetime: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same scan on three days, on the last one with another setting."""
    monkeypatch.setenv("LABSEQ_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("LABSEQ_CACHE", str(tmp_path / "cache"))
    for day in DAYS:
        folder = tmp_path / "data" / day / "0007_lifetime"
        shutil.copytree(lifetime.path, folder)
        record = json.loads((folder / "run.json").read_text("utf-8"))
        measure = {"value": "survival:before,after", "fit": "exponential", "report": "decay"}
        record["resolved"]["measure"] = [measure]
        record |= {"t_start_utc": f"{day}T12:00:00+00:00", "calibrations": {"sites": "old"}}
        if day == DAYS[-1]:
            record["overrides"]["planner.use"] = {"value": "grid", "unit": "", "written": "grid"}
        (folder / "run.json").write_text(json.dumps(record), "utf-8")
    return tmp_path


def test_runs_are_compared_by_their_fits(data: Path, call: Any) -> None:
    picture = data / "both.png"
    code, out, err = call("compare", f"{DAYS[0]}/7", f"{DAYS[2]}/7", "-o", str(picture))
    head, *rows = [line.split() for line in out.splitlines()]
    assert (code, err) == (0, f"written: {picture}\n")
    assert head == ["run", "survival:before,after", "amplitude", "decay", "chi-square", "shots", "settings"]
    assert rows[0][-4:] == ["33(1)", "s", "0.61", "12"]
    assert rows[1][-5:] == ["33(1)", "s", "0.61", "12", "planner.use=grid"]
    assert picture.stat().st_size > 10_000
    code, _, err = call("compare", "7", "--scan", "survival:before,afer")
    assert (code, "there is no image 'afer'" in err) == (2, True)


def test_points_are_in_the_order_of_their_values(data: Path) -> None:
    file = data / "data" / DAYS[0] / "0007_lifetime" / "run.json"
    rising = Compared.of(open_run(file), "loading")
    record = json.loads(file.read_text("utf-8"))
    scan = record["scan"]
    last = len(scan["points"]) - 1
    scan |= {"points": scan["points"][::-1], "written": scan["written"][::-1]}
    scan["point_of_shot"] = [last - point for point in scan["point_of_shot"]]
    file.write_text(json.dumps(record), "utf-8")
    falling = Compared.of(open_run(file), "loading")
    assert falling.x == rising.x == sorted(rising.x)
    assert falling.means == rising.means


def test_runs_with_different_scans_are_not_overlaid(data: Path, call: Any, compact: Run) -> None:
    code, _, err = call("compare", "7", str(compact.path), "--scan", "filling", "-o", str(data / "x.png"))
    assert (code, err.split(";")[0]) == (2, "error: the runs have not scanned the same value")


def test_a_number_over_the_days_with_its_calibrations(data: Path, call: Any) -> None:
    picture = data / "trend.svg"
    code, out, err = call("trend", "decay", "--since", DAYS[1], "-o", str(picture))
    assert (code, err) == (0, f"written: {picture}\n")
    assert [line.split()[0] for line in out.splitlines()[1:]] == [f"{day}/7" for day in DAYS[1:]]
    code, out, _ = call("trend", "loading", "--json")
    points = json.loads(out)["points"]
    assert [point["new_calibrations"] for point in points] == [[], [], []]
    assert points[0]["value"] == pytest.approx(0.75, abs=0.02)
    file = data / "data" / DAYS[2] / "0007_lifetime" / "run.json"
    record = json.loads(file.read_text("utf-8"))
    write_file(file, json.dumps({**record, "calibrations": {"sites": "new"}}).encode())
    out = call("trend", "decay")[1]
    assert [line.split()[-1] for line in out.splitlines()] == ["calibrations", "s", "s", "sites"]
    assert "sites" not in picture.read_text("utf-8")
    code, _, err = call("trend", "tau")
    assert (code, err) == (2, "error: no run has a value 'tau'; expected one of decay\n")


def test_a_setting_over_the_days_has_its_unit_and_several_are_not_drawn(data: Path, call: Any) -> None:
    for day, value, text in ((DAYS[0], 5e-3, "5 ms"), (DAYS[1], 7e-3, "7 ms"), (DAYS[2], 2e6, "2 MHz")):
        file = data / "data" / day / "0007_lifetime" / "run.json"
        record = json.loads(file.read_text("utf-8"))
        record["overrides"]["variables.x"] = {"value": value, "unit": "", "written": text}
        file.write_text(json.dumps(record), "utf-8")
    out = call("trend", "variables.x")[1]
    assert [line.split()[3:5] for line in out.splitlines()[1:]] == [["5", "ms"], ["7", "ms"], ["2", "MHz"]]
    code, _, err = call("trend", "variables.x", "-o", str(data / "x.png"))
    assert (code, err.split(";")[0]) == (2, "error: 'variables.x' has several units: s and Hz")
    assert call("trend", "variables.x", "--until", DAYS[1], "-o", str(data / "x.png"))[0] == 0
