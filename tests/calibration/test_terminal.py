"""``labseq calibration`` through the real command line."""

from __future__ import annotations

import json
import re
import time
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from labseq.calibration_store import Store, Stored
from labseq.cli import main
from labseq.cli.check import check_sequence
from labseq.model import CalibrationKind, SiteGrid
from labseq.testing.fakes import fake_calibration

PROFILE = """labseq: 1
name: bench
grid: {rows: 4, cols: 5, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
detector: {use: threshold}
simulation: {use: virtual}
"""
GRID = SiteGrid(4, 5)
SEQUENCE = """labseq: 1
name: look
profile: bench
shots: 1
target: {pattern: compact, rows: 2, cols: 2}
shot: [{load: {}}, {image: {}}]
"""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bench.yaml").write_text(PROFILE, "utf-8")


@pytest.fixture
def store() -> Store:
    return Store(Path("calibrations/bench"))


def add(store: Store, kind: CalibrationKind = "overlay", minute: int = 0, **given: Any) -> Stored:
    taken = f"2026-11-20T08:{minute:02}:00+00:00"
    return store.add(fake_calibration(kind, GRID, taken_utc=taken, **given), b"png")


def call(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as leaving:
        main(["calibration", *arguments, "--profile", "./bench.yaml"])
    code = leaving.value.code
    assert isinstance(code, int)
    out, err = capsys.readouterr()
    return code, out, err


def test_an_empty_store(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = call(capsys, "list")
    assert code == 0
    assert "calibrations/bench" in out
    assert not Path("calibrations").exists()


def test_a_row_for_each_calibration_with_a_mark_at_those_in_use(
    store: Store, capsys: pytest.CaptureFixture[str]
) -> None:
    one = add(store, origin={"run": "data/2026-11-20/0001_calibrate-overlay"})
    other = add(store, values={"offset_m": [1e-7, 0.0]}, minute=5)
    store.use(one, GRID)
    other.path.write_text("{", "utf-8")
    code, out, _ = call(capsys, "list")
    lines = out.splitlines()
    assert code == 0
    assert lines[0].split() == ["kind", "id", "taken", "age", "quality", "from"]
    assert lines[1].startswith(f"overlay  {one.entry.id}  2026-11-20 08:00 UTC  ")
    assert lines[1].split("  ")[-3:] == ["error 20 nm", "in use", "data/2026-11-20/0001_calibrate-overlay"]
    assert lines[2].split()[:5] == ["overlay", other.entry.id, "-", "-", "damaged"]
    assert f"{other.path}: this file is damaged: it is not a JSON object" in lines[4]


def test_a_damaged_note_of_what_is_in_use_does_not_hide_the_list(
    store: Store, capsys: pytest.CaptureFixture[str]
) -> None:
    add(store)
    Path("calibrations/bench/active.json").write_text("{", "utf-8")
    code, out, _ = call(capsys, "list")
    assert code == 0
    assert "active.json: this file is damaged" in out
    assert out.startswith("kind")


def test_the_list_as_json(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    one, other = add(store), add(store, "tweezers", quality={"separable_spread": float("nan")}, minute=5)
    store.use(one, GRID)
    other_bad = add(store, values={"offset_m": [1e-7, 0.0]}, minute=7)
    other_bad.path.write_text("{", "utf-8")
    _, out, _ = call(capsys, "list", "--json")
    listed = json.loads(out)["calibrations"]
    assert [row["id"] for row in listed] == [one.entry.id, other.entry.id, other_bad.entry.id]
    assert [row["in_use"] for row in listed] == [True, False, False]
    assert listed[0]["quality"] == {"error_m": 2e-8}
    assert listed[1]["quality"] == {"separable_spread": None}
    assert "damaged" in listed[2]["error"]


def test_one_that_the_profile_chooses_is_marked(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    chosen, active = add(store), add(store, values={"offset_m": [1e-7, 0.0]}, minute=5)
    store.use(active, GRID)
    Path("bench.yaml").write_text(
        PROFILE + f"calibrations: {{use: {{overlay: {chosen.entry.id}}}}}\n", "utf-8"
    )
    _, out, _ = call(capsys, "list")
    assert ["in use" in line for line in out.splitlines()[1:]] == [True, False]
    _, out, _ = call(capsys, "use", active.entry.id)
    assert f"the profile has 'calibrations.use.overlay: {chosen.entry.id}', which takes precedence" in out
    Path("bench.yaml").write_text(PROFILE + "calibrations: {use: {overlay: off}}\n", "utf-8")
    _, out, _ = call(capsys, "list")
    assert "in use" not in out


def test_one_in_detail(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    origin = {"command": "labseq calibrate overlay", "calibrations": {"frequencies": "abc"}}
    stored = add(store, values={"offset_m": [1.5e-7, -2e-8]}, origin=origin)
    code, out, _ = call(capsys, "show", stored.entry.id[:4])
    printed = {line.split()[0]: line.split(maxsplit=1)[1] for line in out.splitlines()}
    assert code == 0
    assert printed["calibration"] == f"overlay {stored.entry.id}"
    assert printed["offset_m"] == "150 nm, -20 nm"
    assert printed["quality.error_m"] == "20 nm"
    assert printed["origin.calibrations"] == "frequencies abc"
    assert printed["picture"] == str(stored.picture)
    assert printed["grid"] == "4 x 5 sites, triangular, 4.49 um, shear +1"


def test_many_numbers_are_summed_up(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    stored = add(store, "frequencies")
    _, out, _ = call(capsys, "show", stored.entry.id)
    assert "row_hz           97.6 MHz, 99.2 MHz, 100.8 MHz, 102.4 MHz" in out
    assert "column_hz        5 numbers, 96.8 MHz to 103.2 MHz, mean 100 MHz" in out
    _, out, _ = call(capsys, "show", stored.entry.id, "--json")
    assert json.loads(out)["kind"] == "frequencies"


def test_an_id_that_does_not_exist(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    stored = add(store)
    code, out, err = call(capsys, "show", "77")
    assert (code, out) == (2, "")
    assert re.fullmatch(rf"error: .*'77' in calibrations/bench; expected {stored.entry.id}\n", err)


def test_a_calibration_is_put_to_use_and_none(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    good = add(store)
    worse = add(store, values={"offset_m": [1e-7, 0.0]}, quality={"error_m": 1e-6}, minute=5)
    assert call(capsys, "use", good.entry.id)[:2] == (
        0,
        f"overlay {good.entry.id} is in use from the next run on\n",
    )
    code, _, err = call(capsys, "use", worse.entry.id)
    assert code == 2
    assert "its error_m is 1e-06, but 2e-08 for the calibration in use; use it anyway with --force" in err
    assert call(capsys, "use", worse.entry.id, "--force")[0] == 0
    assert call(capsys, "use", "overlay=off")[:2] == (
        0,
        "no calibration of overlay is in use from the next run on\n",
    )
    assert [one.id for one in store.history()] == [good.entry.id, worse.entry.id, ""]


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        (
            "overly=off",
            "'overly' is not a kind of calibration; expected one of sites, .*; did you mean 'overlay'",
        ),
        ("overlay=on", "overlay is 'on'; expected 'off', or just an id"),
    ],
)
def test_a_choice_with_an_error(choice: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = call(capsys, "use", choice)
    assert code == 2
    assert re.search(message, err)


def test_what_changed(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    one = add(store)
    other = add(store, values={"offset_m": [3e-8, -4e-8]}, quality={"error_m": 1e-8}, minute=5)
    code, out, _ = call(capsys, "diff", one.entry.id, other.entry.id)
    lines = [line.split() for line in out.splitlines()]
    assert code == 0
    assert lines[3] == ["offset_m", "40", "nm", "35.4", "nm", "30", "nm,", "-40", "nm"]
    assert lines[6] == ["error_m", "20", "nm", "10", "nm"]
    _, out, _ = call(capsys, "diff", one.entry.id, other.entry.id, "--json")
    printed = json.loads(out)
    assert printed["values"][0]["mean"] == pytest.approx([3e-8, -4e-8])
    assert printed["quality"][0]["after"] == 1e-8


def test_check_lists_what_is_in_use(store: Store, capfd: pytest.CaptureFixture[str]) -> None:
    stored = add(store)
    store.use(stored, GRID)
    Path("look.yaml").write_text(SEQUENCE, "utf-8")
    check_sequence(Path("look.yaml"), None, (), "off", as_json=False)
    printed = capfd.readouterr().out
    (line,) = (line for line in printed.splitlines() if line.startswith("calibration "))
    assert re.fullmatch(rf"calibration  overlay {stored.entry.id}, \d+ \w+ old, error 20 nm", line)
    check_sequence(Path("look.yaml"), None, (), "off", as_json=True)
    (entry,) = json.loads(capfd.readouterr().out)["calibrations"]
    assert (entry["kind"], entry["id"]) == ("overlay", stored.entry.id)


@pytest.mark.parametrize(
    ("taken_s_ago", "age", "check", "age_s"),
    [
        (3 * 86400.5, "3 days ago", "3 days old", 3 * 86400.5),
        (-5.0, "0 seconds ago", "0 seconds old", 0.0),  # the clock of another computer
        (-86400.0, *["ahead of this computer's clock"] * 2, None),
    ],
)
def test_ages_by_a_clock_that_may_be_behind(
    store: Store, capfd: Any, monkeypatch: Any, taken_s_ago: float, age: str, check: str, age_s: float | None
) -> None:
    stored = add(store)
    store.use(stored, GRID)
    now_s = datetime.fromisoformat(stored.entry.taken_utc).timestamp() + taken_s_ago
    monkeypatch.setattr(time, "time", lambda: now_s)
    assert f"2026-11-20 08:00 UTC, {age}\n" in call(capfd, "show", stored.entry.id)[1]
    (listed,) = json.loads(call(capfd, "list", "--json")[1])["calibrations"]
    assert listed["age_s"] == age_s
    Path("look.yaml").write_text(SEQUENCE, "utf-8")
    check_sequence(Path("look.yaml"), None, (), "off", as_json=False)
    assert f"overlay {stored.entry.id}, {check}, error 20 nm\n" in capfd.readouterr().out
