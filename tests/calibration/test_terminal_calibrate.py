"""``labseq calibrate`` through the real command line."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest

from labseq.calibration_store import Store
from labseq.cli import main
from labseq.model import SiteGrid
from labseq.testing.fakes import fake_calibration

PROFILE = """labseq: 1
name: bench
grid: {rows: 6, cols: 6, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
detector: {use: threshold, frame: [160, 160], centre_px: [79.5, 79.5]}
simulation:
  use: virtual
  image: {frame: [160, 160], centre_px: [79.5, 79.5]}
"""
GRID = SiteGrid(6, 6)


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bench.yaml").write_text(PROFILE, "utf-8")


@pytest.fixture
def store() -> Store:
    return Store(Path("calibrations/bench"))


def call(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as leaving:
        main(["calibrate", *arguments, "--profile", "./bench.yaml", "--seed", "1", "--output", "data"])
    code = leaving.value.code
    assert isinstance(code, int)
    out, err = capsys.readouterr()
    return code, out, err


def test_what_was_found_is_reported_and_kept(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = call(capsys, "sites", "--shots", "10")
    stored = store.entry_in_use("sites")
    assert code == 0
    assert stored is not None
    lines = out.splitlines()
    assert lines[0] == f"sites {stored.entry.id}: in use from the next run on"
    assert re.match("36 of 36 sites .* 10 frames, ", lines[1])
    assert [line.split()[-1] for line in lines[-2:]] == [str(stored.path), str(stored.picture)]
    assert "10 shots, seed 1, profile bench, simulated" in err
    assert [line for line in err.splitlines() if line.endswith("of 10 shots")][-1] == "10 of 10 shots"
    (run,) = Path("data").glob("*/*_calibrate-sites")
    code, out, _ = call(capsys, "sites", "--from", str(run))
    assert code == 0
    assert f"compared with {stored.entry.id}, which was in use:" in out


def test_a_worse_one_is_kept_and_reported(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    better = store.add(fake_calibration("sites", GRID, quality={"n_sites_found": 40}))
    store.use(better, GRID)
    code, out, err = call(capsys, "sites", "--shots", "10")
    new = next(one for one in store.entries() if one.path != better.path)
    assert code == 2
    assert out.startswith(f"sites {new.path.stem[-12:]}: not in use")
    assert "it found 36 sites, but the calibration in use found 40" in err


def test_an_analysis_that_fails(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = call(capsys, "sites", "--shots", "5", "--set", "profile.simulation.loading=0 %")
    assert (code, out) == (3, "")
    (run,) = Path("data").glob("*/*_calibrate-sites")
    warning, error = err.splitlines()[-2:]
    assert warning.endswith(f"analyse the run again with --from {run.resolve()}")
    assert error.startswith("error: camera: no lattice found: ")
    assert store.entries() == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("site",),
            "'site' cannot be calibrated; expected one of sites, thresholds, ",
        ),
        (("sites", "--from", "nowhere"), "nowhere: no such file or folder, and no run of this name"),
        (("sites", "--shots", "0"), "--shots 0: shots is 0; expected at least 1"),
        (("sites", "--centre", "12"), "--centre: '12'; expected two numbers of pixels Y,X"),
        (
            ("overlay", "--centre", "1,2"),
            "--centre: a calibration of overlay takes no --centre; expected sites",
        ),
    ],
)
def test_wrong_usage(
    arguments: tuple[str, ...],
    message: str,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    code, out, err = call(capfd, *arguments)
    assert (code, out) == (2, "")
    assert message in err
    monkeypatch.setattr(sys, "stdout", sys.stdout)  # the command redirects it
    code, out, _ = call(capfd, *arguments, "--json")
    answer = json.loads(out)
    assert (code, answer["kind"], answer["in_use"]) == (2, arguments[0], False)
    assert message in answer["error"]


def test_the_outcome_as_json(
    store: Store, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdout", sys.stdout)  # the command redirects it
    code, out, _ = call(capfd, "sites", "--shots", "10", "--json")
    printed = json.loads(out)
    stored = store.entry_in_use("sites")
    assert stored is not None
    assert code == 0
    assert (printed["id"], printed["in_use"], printed["refused"]) == (stored.entry.id, True, None)
    assert printed["quality"]["n_sites_found"] == 36
    assert Path(printed["run_dir"]).is_dir()
