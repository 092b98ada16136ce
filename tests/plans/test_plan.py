from __future__ import annotations

import io
import json
import re
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from PIL import Image
from rich.text import Text

from labseq.assembly.planning import PlannedMoves, PlanRequest, plan_moves
from labseq.model import Batch
from labseq.plans.plan import PlanOutput, PlanReport, moves_text, plan_once, print_plan, warnings

assert numba  # loaded already, so that the command does not turn compiling off for the tests after it

REQUEST = PlanRequest("random:6x6@0.7", "{pattern: checkerboard, rows: 4, cols: 4}", seed=3)


class Terminal(io.StringIO):
    """A text stream that says it is a terminal."""

    encoding = "utf-8"  # pyright: ignore[reportAssignmentType,reportIncompatibleVariableOverride]

    def isatty(self) -> bool:
        return True


@pytest.fixture(scope="module")
def moves() -> PlannedMoves:
    return plan_moves(REQUEST)


def printed(moves: PlannedMoves, stream: io.StringIO | None = None, *, step: bool = False) -> str:
    stream = stream or io.StringIO()
    print_plan(moves, stream, step=step)
    return stream.getvalue()


def test_a_plan_without_a_terminal_is_plain_text(moves: PlannedMoves) -> None:
    text = printed(moves)
    assert "\x1b" not in text
    lines = text.splitlines()
    for line, facts in enumerate(
        ("random:6x6@0.7, seed 3: 27 atoms", "8 atoms, 8 sites", "psca", "", "before")
    ):
        assert facts in lines[line]
    assert "after" in lines[4]
    assert f"atom moves  {moves.plan.n_atom_moves}" in lines
    assert f"ejected     {moves.n_ejected} atoms" in lines
    assert "8 of 8 (100.0 %)" in lines[-1]
    assert all(line == line.rstrip() for line in lines)


def test_each_batch_is_reported_on_request(moves: PlannedMoves) -> None:
    text = printed(moves, step=True)
    n = moves.plan.n_batches
    assert [f"batch {i}  " in text for i in range(n)] == [True] * n
    assert text.count("before") == n + 1
    assert "ejected" in text
    assert "Enter" not in text


@pytest.mark.parametrize(("keys", "n_shown"), [("\n\nq\n", 3), ("", 1), ("\n" * 99, 99)])
def test_in_a_terminal_each_batch_waits_for_enter(
    moves: PlannedMoves, monkeypatch: pytest.MonkeyPatch, keys: str, n_shown: int
) -> None:
    monkeypatch.setattr("sys.stdin", Terminal(keys))
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    text = printed(moves, Terminal(), step=True)
    assert text.count(", done at ") == min(n_shown, moves.plan.n_batches)
    assert text.count("Enter: next batch, q: skip the rest") == min(n_shown, moves.plan.n_batches)
    assert "filled" in text


@pytest.mark.parametrize("width", ["16", "80", "200"])
def test_a_plan_fits_the_terminal(moves: PlannedMoves, monkeypatch: pytest.MonkeyPatch, width: str) -> None:
    monkeypatch.setenv("COLUMNS", width)
    monkeypatch.setenv("TERM", "xterm")
    lines = [Text.from_ansi(line).plain for line in printed(moves, Terminal()).splitlines()]
    rows = [line for line in lines if line.lstrip()[:1].isdigit()]
    assert len(rows) == (14 if width == "16" else 7)
    assert all(len(line) <= int(width) for line in rows)


def test_move_words_name_every_line() -> None:
    batch = Batch(
        np.array([(0, 1), (0, 4), (3, 1), (3, 4)], np.int16),
        np.array([(0, 2), (0, 5), (3, 2), (3, 5)], np.int16),
    )
    assert moves_text(batch, (4, 5), "to") == [
        "row 0: columns 1to2, 4toejected",
        "row 3: columns 1to2, 4toejected",
    ]
    column = Batch(np.array([(2, 1)], np.int16), np.array([(-1, 1)], np.int16))
    assert moves_text(column, (4, 5)) == ["column 1: row 2->ejected"]


def test_what_falls_short_is_reported() -> None:
    short = PlanRequest(
        "random:6x6@0.2", "{pattern: compact, rows: 4, cols: 4}", seed=3, degree_of_parallelism=30
    )
    moves = plan_moves(short)
    n_atoms = int(moves.occupancy.sum())
    too_parallel, too_few = warnings(moves, short)
    assert too_parallel.startswith("--dop 30: planned with 20")
    assert all(f"{n} " in f"{too_few} " for n in (f"{n_atoms} atoms", 16 - n_atoms, f"fills {n_atoms}"))
    assert warnings(plan_moves(REQUEST), REQUEST) == []


LAZY = """
import labseq

LABSEQ_API = 1


class Lazy:
    def __init__(self, settings, context): ...
    def plan(self, occupancy, target):
        return labseq.Plan.from_batches([])


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.planner("lazy", Lazy)
"""


def test_a_planner_that_leaves_defects_and_surplus_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "lazy.py").write_text(LAZY, "utf-8")
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path))
    request = PlanRequest("random:6x6@0.7", "{pattern: checkerboard, rows: 4, cols: 4}", "lazy", seed=3)
    moves = plan_moves(request)
    defects, surplus = warnings(moves, request)
    assert f"{moves.report.n_defects} target sites empty" in defects
    assert f"{moves.report.n_surplus} atoms on sites that must be empty" in surplus
    assert dict(PlanReport.of(moves).totals())["surplus"].startswith(f"{moves.report.n_surplus} atoms")


BROKEN = """
import labseq
from labseq.plugin import Planner, Settings, hookimpl

LABSEQ_API = 1
SECOND = {
    "diagonal": ([(0, 0)], [(2, 1)]),
    "outside": ([(1, 1)], [(1, 3000)]),
    "waits": ([(0, 0)], [(0, 0)]),
    "empty": ([], []),
    "over": ([(0, 2)], [(0, -1)]),
}


class BrokenSettings(Settings):
    kind: str = "raises"


class Broken(Planner):
    def __init__(self, settings, context):
        self.degree_of_parallelism = 4
        self.kind = settings.kind

    def plan(self, occupancy, target):
        batches = [([(1, 1)], [(1, 0)]), SECOND[self.kind], ([(1, 0)], [(1, 1)])]
        return labseq.Plan.from_batches(batches)


@hookimpl
def labseq_register(registry):
    registry.planner("broken", Broken, BrokenSettings)
"""


@pytest.mark.parametrize(
    ("kind", "move", "why", "way"),
    [
        ("diagonal", 0, "(0, 0) -> (2, 1) changes row and column", "(0, 0)->(2, 1)"),
        ("outside", 0, "the goal (1, 3000) is neither on the grid", "(1, 1)->(1, 3000)"),
        ("waits", 0, "(0, 0) -> (0, 0) goes nowhere", "(0, 0)->(0, 0)"),
        ("empty", -1, "it has no atom moves; leave it out", "refused"),
        ("over", -1, "an atom would be ejected over the one on (0, 0)", "(0, 2)->(0, -1)"),
    ],
)
def test_a_refused_plan_is_shown_up_to_its_mistake(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Any, kind: str, move: int, why: str, way: str
) -> None:
    (tmp_path / "broken.py").write_text(BROKEN, "utf-8")
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path))
    png, saved, page = (tmp_path / name for name in ("a.png", "a.json", "a.html"))
    command = [
        "plan",
        "random:6x6@0.6",
        "--seed=1",
        "--target={pattern: compact, rows: 3, cols: 3}",
        "--planner=broken",
    ]
    outputs = f"--json={saved}", f"--png={png}", f"--animate={page}"
    code, out, err = call(*command, f"--set=kind={kind}", *outputs)
    assert code == 1
    assert why in err
    document = json.loads(saved.read_text("utf-8"))
    assert len(document["batches"]) == 3
    assert document["refused"].items() >= {"batch": 1, "move": move}.items()
    assert why in document["refused"]["why"]
    assert document["predicted"][1][:2] == [1, 0]
    assert re.search(r'"batches":\[\[[\d.,]+\]\]', page.read_text("utf-8"))  # the one that is valid
    text = out.replace("→", "->")
    assert "batch 1  refused" in text
    assert why in text
    assert way in text
    pixels = np.asarray(Image.open(png).convert("RGB")).astype(int)
    assert np.count_nonzero(np.abs(pixels - (0xC8, 0x10, 0x2E)).max(axis=2) < 12) > 500


def test_a_planner_that_fails_or_hangs_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Any
) -> None:
    path = tmp_path / "broken.py"
    path.write_text(BROKEN, "utf-8")
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path))
    command = ["plan", "random:6x6@0.6", "--target={pattern: compact, rows: 3, cols: 3}", "--planner=broken"]
    code, _, err = call(*command)
    line = BROKEN.splitlines().index(
        "        batches = [([(1, 1)], [(1, 0)]), SECOND[self.kind], ([(1, 0)], [(1, 1)])]"
    )
    assert (code, err.count("\n")) == (1, 1)
    assert all(fact in err for fact in ("'broken'", "KeyError: 'raises'", f"({path}:{line + 1})"))
    path.write_text(
        BROKEN.replace("        batches = ", "        import time; time.sleep(1)\n        batches = "),
        "utf-8",
    )
    monkeypatch.setattr("labseq.assembly.planning.MAX_PLAN_S", 0.01)
    code, _, err = call(*command)
    assert code == 1
    assert all(fact in err for fact in ("'broken'", "0.01 s", "'timeouts: {plan: "))


def test_json_in_a_file_is_printed_with_the_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "plan.json"
    plan_once(REQUEST, PlanOutput(json=str(path)))
    out, err = capsys.readouterr()
    assert "atom moves" in out
    assert err == ""
    assert json.loads(path.read_text("utf-8"))["seed"] == 3
    assert path.read_text("utf-8").count("\n") == 1


def test_the_command_passes_every_option_on(monkeypatch: pytest.MonkeyPatch, call: Any) -> None:
    got: list[Any] = []
    monkeypatch.setattr("labseq.plans.plan.plan_once", lambda *arguments: got.extend(arguments))
    target = ["--target", "{pattern: a, rows: 3, cols: 3}", "--origin", "-1,2"]
    planner = ["--planner", "p", "--dop", "4", "--set", "a=1", "--set", "b=2"]
    output = ["--step", "--json", "-", "--png", "x.png", "--animate", "y.gif"]
    assert call("plan", "-", *target, *planner, "--seed", "5", "-p", "lab", *output)[0] == 0
    request = PlanRequest("-", "{pattern: a, rows: 3, cols: 3}", "p", 4, ("a=1", "b=2"), 5, "-1,2", "lab")
    assert got == [request, PlanOutput(True, "-", Path("x.png"), Path("y.gif"))]
