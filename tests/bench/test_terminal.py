from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labseq.assembly.planning import PlanRequest, plan_moves
from labseq.cli import main

SMALL = (
    "--grid",
    "8x8",
    "--target",
    "{pattern: compact, rows: 5, cols: 5}",
    "--loadings",
    "20",
    "--workers",
    "1",
)

MOODY = """
import labseq

LABSEQ_API = 1


class Moody:
    degree_of_parallelism = 1

    def __init__(self, settings, context): ...

    def plan(self, occupancy, target):
        if occupancy[0, 0]:
            return labseq.Plan.from_batches([([(0, 0)], [(0, 0)])])
        return labseq.Plan.from_batches([])


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.planner("moody", Moody)
"""


def code_of(*arguments: str) -> Any:
    with pytest.raises(SystemExit) as leaving:
        main(["bench", "planners", *arguments])
    return leaving.value.code


def test_a_table_with_a_line_per_planner(capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(*SMALL, "--planners", "psca,psca:degree_of_parallelism=2", "--dop", "4") == 0
    out, err = capsys.readouterr()
    header, first, second, blank, extent = out.splitlines()
    assert header.split()[:4] == ["planner", "DOP", "batches", "atoms"]
    assert first.split()[:2] == ["psca", "4"]
    assert second.split()[:3] == ["psca", "degree_of_parallelism=2", "2"]
    assert blank == ""
    assert extent.startswith("20 loadings, bound ")
    assert "seed 1, " in extent
    progress = [line for line in err.splitlines() if not line.startswith("compiling")]
    assert progress == [f"{n} of 20 loadings" for n in (*range(5, 21, 5),)]


def test_files_hold_what_the_table_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = {kind: tmp_path / f"out.{kind}" for kind in ("json", "csv", "png")}
    options = [word for kind, path in paths.items() for word in (f"--{kind}", str(path))]
    assert code_of(*SMALL, "--seed", "3", *options) == 0
    values = json.loads(paths["json"].read_text("utf-8"))
    assert (values["complete"], values["seed"], values["n_loadings"]) == (True, 3, 20)
    (row,) = values["rows"]
    assert (row["planner"], row["n_target_atoms"], row["n_failed"]) == ("psca", 25, 0)
    assert len(paths["csv"].read_text("utf-8").splitlines()) == 2
    assert paths["png"].read_bytes().startswith(b"\x89PNG")
    assert "written: " in capsys.readouterr().out


def test_wrong_plans_are_reported_with_a_way_to_see_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "moody.py").write_text(MOODY, "utf-8")
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path))
    assert code_of(*SMALL, "--planners", "moody,psca", "--dop", "4") == 1
    out, err = capsys.readouterr()
    assert "of 20 plans are wrong" in out
    assert "breaks the rule 'straight'" in out
    assert err.splitlines()[-1].startswith("error: ")
    assert "plans of 'moody' are wrong" in err
    command = shlex.split(next(line for line in out.splitlines() if "see it with" in line))
    words = {key: command[command.index(key) + 1] for key in ("plan", "--seed", "--target", "--planner")}
    request = PlanRequest(words["plan"], words["--target"], words["--planner"], seed=int(words["--seed"]))
    with pytest.raises(Exception, match="breaks the rule 'straight'"):
        plan_moves(request)


def test_too_few_atoms_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(*SMALL, "--loading", "30 %") == 0
    assert "fewer atoms than compact 5 x 5" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--planners", "psac"], "--planners psac: unknown planner 'psac'"),
        (["--loadings", "0"], "--loadings"),
        (["--png", "figure.jpg"], "a file that ends in .png"),
        (["--csv", "nowhere/out.csv"], "it cannot be written"),
        (["--json", "."], "it cannot be written"),
    ],
)
def test_mistakes_are_reported_before_the_work(
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert code_of(*arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert words in err
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_was_there_is_not_lost_to_a_mistake(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("old.csv").write_text("old\n", "utf-8")
    assert code_of("--csv", "old.csv", "--png", "nowhere/x.png") == 2
    assert Path("old.csv").read_text("utf-8") == "old\n"


def test_the_same_seed_gives_the_same_numbers(tmp_path: Path) -> None:
    found: list[Any] = []
    for name, seed in (("a", "7"), ("b", "7"), ("c", "8")):
        assert code_of(*SMALL, "--seed", seed, "--json", str(tmp_path / name)) == 0
        (row,) = json.loads((tmp_path / name).read_text("utf-8"))["rows"]
        found.append(np.array([row["n_batches"]["mean"], row["distance_m"]["mean"], row["bound"]["mean"]]))
    assert np.array_equal(found[0], found[1])
    assert not np.array_equal(found[0], found[2])
