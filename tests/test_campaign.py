"""Campaigns: a run for each point, continued after a stop; mistakes of the file with their place."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from labseq.analysis.campaigns import campaign_picture, combined
from labseq.campaign import run_file
from labseq.cli import main
from labseq.errors import ConfigError, StopRequested
from labseq.session.campaign import Campaign, recorded_runs, run_campaign
from labseq.session.options import Options
from labseq.session.session import Session
from tests.session.small_runs import write

FILE = """labseq: 1
sequence: no_scan.yaml
axes:
  planner.degree_of_parallelism: [1, 4]
  profile.simulation.loading: [60 %, 80 %]
repeats: 2
seed: 3
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write(tmp_path)
    path = tmp_path / "campaign.yaml"
    path.write_text(FILE, encoding="utf-8")
    return path


def running(n_runs: int) -> Callable[[Any], None]:
    """Runs sessions, and is stopped in the last of them."""
    left = [n_runs]

    def run_session(opening: Callable[[Any], Session]) -> None:
        with opening(None) as session:
            left[0] -= 1
            if not left[0]:
                session.stop_flag.request()
            session.run()

    return run_session


def test_a_campaign_that_is_stopped_goes_on_and_its_results_are_combined(file: Path) -> None:
    campaign, folder = Campaign.read(file), file.parent / "out"
    with pytest.raises(StopRequested):
        run_campaign(running(2), campaign, folder, Options())
    half = combined(*recorded_runs(folder))
    assert half["n_shots"].values.tolist() == [[2, 0], [0, 0]]
    assert np.isfinite(half["filling"].values).tolist() == [[True, False], [False, False]]
    assert "0.8" in str(half["profile.simulation.loading"].values)  # of points without a run, too
    assert "1 of 4 points are complete" in campaign_picture(folder).note
    runs = run_campaign(running(9), campaign, folder, Options())
    assert [run.status for run in runs] == ["complete"] * 4
    assert len([*folder.glob("*/*/run.json")]) == 4
    file.unlink()  # the folder has a copy
    results = combined(*recorded_runs(folder))
    assert dict(results.sizes) == {
        "planner.degree_of_parallelism": 2,
        "profile.simulation.loading": 2,
        "repeat": 2,
    }
    assert results["profile.simulation.loading"].values.tolist() == [0.6, 0.8]
    point = results.sel({"planner.degree_of_parallelism": 4, "profile.simulation.loading": 0.6})
    [expected] = [
        run
        for run in runs
        if (run.changes["planner.degree_of_parallelism"], run.changes["profile.simulation.loading"])
        == ("4", "60 %")
    ]
    assert point["n_batches"].values.tolist() == [shot.row["n_batches"] for shot in expected.shots]
    assert float(point["filling"]) == expected.quantity("filling").over(expected.shots).value
    assert len(campaign_picture(folder).rows) == 2
    file.write_text(FILE.replace("seed: 3", "seed: 4"), encoding="utf-8")
    with pytest.raises(ConfigError, match="this run belongs to no point of the campaign"):
        run_campaign(running(9), Campaign.read(file), folder, Options())


def test_the_table_has_the_mean_filling_of_the_shots_that_have_one(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fillings = [[0.5, math.nan, 1.0], [0.9], [math.nan], []]
    runs = [
        SimpleNamespace(path=Path(f"day/{n}"), shots=[SimpleNamespace(filling_fraction=one) for one in own])
        for n, own in enumerate(fillings)
    ]
    monkeypatch.setattr("labseq.session.campaign.run_campaign", lambda *_: runs)
    run_file(lambda *_, **__: None, file, file.parent, None, Options())
    rows = [line for line in capsys.readouterr().out.splitlines() if "day/" in line]
    assert [row.split("%")[1].split()[-2:] for row in rows[:2]] == [["3", "75.00"], ["1", "90.00"]]
    assert all(" - " in row for row in rows[2:])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("labseq: 1\nsequence: x\naxes: {}\n", r"campaign.yaml:3:7: .*axes"),
        ("labseq: 1\nsequence: x\nrepeat: 2\naxes: {a: [1]}\n", r"campaign.yaml:3:1: .*'repeat'.*'repeats'"),
        ("labseq: 1\nsequence: x\naxes: {a: [1, 1]}\n", r"campaign.yaml:3:11: a value occurs twice"),
        (FILE.replace("[1, 4]", "[1, 0]"), r"campaign.yaml:4:38: degree_of_parallelism is 0"),
    ],
)
def test_mistakes_have_their_place(file: Path, text: str, message: str) -> None:
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        run_campaign(running(9), Campaign.read(file), file.parent / "out", Options())


def test_a_folder_without_a_campaign_and_what_a_campaign_cannot_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, message = str(tmp_path), "or a campaign's folder, which has a campaign.yaml"
    assert refusal(capsys, "export", folder) == refusal(capsys, "plot", folder)
    assert message in refusal(capsys, "export", folder)
    (tmp_path / "campaign.yaml").write_text(FILE, encoding="utf-8")
    assert "cannot be exported as 'csv'; expected netcdf" in refusal(capsys, "export", folder, "--to", "csv")
    assert "these options are for one of its runs" in refusal(capsys, "plot", folder, "--shot", "1")
    assert "the campaign has no runs yet" in refusal(capsys, "plot", folder)


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """What a command that the user got wrong prints."""
    with pytest.raises(SystemExit) as left:
        main(arguments)
    assert left.value.code == 2
    return capsys.readouterr().err
