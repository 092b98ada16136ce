"""Every pattern through ``labseq plan``, and its plans through a replay that uses nothing of labseq.

A few plans in the suite; LABSEQ_PLANS=200 makes 200 for each pattern.
"""

from __future__ import annotations

import json
import os
import re
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import pytest
import yaml

from labseq.assembly.plugin_choice import load_plugins
from labseq.cli import main

assert numba  # loaded already, so that the command does not turn compiling off for the tests after it

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]
N_PLANS = int(os.environ.get("LABSEQ_PLANS", "1"))
TARGETS = (
    "{pattern: compact, rows: 15, cols: 15}",
    "{pattern: kagome, rows: 15, cols: 15}",
    "{pattern: honeycomb, rows: 15, cols: 15}",
    "{pattern: link_kagome, rows: 15, cols: 15}",
    "{pattern: checkerboard, rows: 15, cols: 15}",
    "{pattern: sierpinski, rows: 15, cols: 15}",
    "{pattern: ring, rows: 15, cols: 15}",
    "{pattern: interleaved, rows: 8, cols: 15}",
    "sequences/lion_head.yaml",
)

REPLAY = runpy.run_path(str(Path(__file__).parent / "replay.py"))
replay: Callable[[dict[str, Any]], None] = REPLAY["replay"]
Broken: type[Exception] = REPLAY["Broken"]
Planning = Callable[..., dict[str, Any]]


@pytest.fixture
def plan(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Planning:
    """The document that ``labseq plan`` prints; tests/system/test_plan.py asks processes for the same."""
    monkeypatch.chdir(ROOT)

    def plan(target: str, *arguments: str, occupancy: str = "random:20x20@0.75") -> dict[str, Any]:
        with pytest.raises(SystemExit) as leaving:
            main(["plan", occupancy, "--target", target, *arguments, "--json", "-"])
        out, err = capfd.readouterr()
        assert leaving.value.code == 0, err
        return json.loads(out)

    return plan


@pytest.mark.parametrize("seed", range(N_PLANS))
@pytest.mark.parametrize("target", TARGETS)
def test_every_pattern_ends_full_and_clear(plan: Planning, target: str, seed: int) -> None:
    document = plan(target, "--seed", str(seed))
    assert sum(map(sum, document["occupancy"])) >= sum(map(sum, document["target"]["fill"]))
    replay(document)


def test_no_pattern_is_left_out() -> None:
    named = {yaml.safe_load(target)["pattern"] for target in TARGETS if target.startswith("{")}
    entries = load_plugins().registry.entries()
    shipped = {e.name for e in entries if e.kind == "pattern" and e.origin.startswith("labseq")}
    assert named | {"bitmap"} == shipped


@pytest.mark.parametrize("dop", ["1", "20"])
def test_a_full_array_ends_full_and_clear(plan: Planning, dop: str) -> None:
    replay(plan("{pattern: sierpinski, rows: 16, cols: 16}", "--dop", dop, occupancy="random:20x20@1"))


def a_document(**changes: Any) -> dict[str, Any]:
    """A plan of two batches that is right: (0, 0) leaves, then (0, 1) and (0, 2) move up by a site."""
    return {
        "planner": "by hand",
        "grid": {"n_rows": 2, "n_cols": 4},
        "degree_of_parallelism": 2,
        "seed": None,
        "occupancy": [[1, 1, 1, 0], [0, 0, 1, 0]],
        "target": {"fill": [[0, 0, 1, 1], [0, 0, 0, 0]], "clear": [[1, 1, 0, 0], [0, 0, 0, 0]]},
        "n_batches": 2,
        "n_atom_moves": 3,
        "batches": [
            {"from": [[0, 0]], "to": [[0, -1]], "linked": False},
            {"from": [[0, 1], [0, 2]], "to": [[0, 2], [0, 3]], "linked": False},
        ],
        "predicted": [[0, 0, 1, 1], [0, 0, 1, 0]],
        **changes,
    }


def batches(*moves: list[tuple[tuple[int, int], tuple[int, int]]], linked: bool = False) -> dict[str, Any]:
    made = [
        {"from": [[*a] for a, _ in batch], "to": [[*b] for _, b in batch], "linked": linked and i > 0}
        for i, batch in enumerate(moves)
    ]
    return {"batches": made, "n_batches": len(made), "n_atom_moves": sum(map(len, moves))}


def test_the_replay_lets_a_right_plan_pass() -> None:
    replay(a_document())


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        (batches(), "1 of 2 fill sites are empty"),
        (batches([((0, 1), (0, 2)), ((0, 2), (0, 3))]), "1 clear sites hold an atom"),
        (batches([((1, 3), (0, 3))]), "an atom is picked up where there is none"),
        (batches([((0, 0), (0, 1))]), "a tweezer meets an atom"),
        (batches([((0, 0), (0, 3))]), "a tweezer meets an atom"),
        (batches([((0, 1), (0, -1))]), "a tweezer meets an atom"),
        (batches([((0, 0), (0, -2))]), "an atom from (0, 0) is ejected to (0, -2)"),
        (batches([((0, 0), (0, -1)), ((0, 1), (0, -1))]), "a site is named twice"),
        (batches([((0, 0), (1, 1))]), "tones of both axes move"),
        (batches([((0, 0), (1, 0)), ((0, 2), (0, 3))]), "a tone would have to go two ways"),
        (batches([((0, 0), (0, 1)), ((0, 1), (0, 2)), ((0, 2), (0, 3))]), "3 tweezers are on"),
        (batches([((0, 1), (0, 3)), ((0, 2), (0, 1))]), "two tones come closer than a site"),
        (batches([((0, 2), (0, 3))], [((0, 1), (0, 2))], linked=True), "goes on from other sites"),
        (batches([((0, 0), (0, -1))], [((0, -1), (0, 3))], linked=True), "is moved on"),
        (batches([]), "a batch without moves"),
        ({"predicted": [[0, 0, 1, 1], [1, 0, 0, 0]]}, "another array was predicted"),
        ({"n_batches": 3}, "the number of batches is another"),
        ({"n_atom_moves": 2}, "the number of atom moves is another"),
        ({"degree_of_parallelism": 1}, "2 tweezers are on"),
    ],
)
def test_the_replay_finds_what_is_wrong(changes: dict[str, Any], verdict: str) -> None:
    with pytest.raises(Broken, match=re.escape(verdict)):
        replay(a_document(**changes))


def test_a_crossing_that_is_not_named_may_not_pick_up_an_atom() -> None:
    occupancy = [[1, 0, 1, 0], [1, 0, 1, 0]]
    moves = batches([((0, 0), (0, 1)), ((1, 2), (1, 3))])
    document = a_document(occupancy=occupancy, degree_of_parallelism=4, **moves)
    with pytest.raises(Broken, match="a tweezer meets an atom"):
        replay(document)


def test_the_replay_reads_plans_from_a_pipe() -> None:
    wrong = a_document(n_batches=7)
    lines = "".join(json.dumps(document) + "\n" for document in (a_document(), wrong))
    command = [sys.executable, "-S", str(Path(__file__).parent / "replay.py")]
    done = subprocess.run(command, input=lines, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    first, last = done.stdout.splitlines()
    assert first.startswith("plan 2, ")
    assert last == "2 plans, 1 broken"
