"""The planner `auto`: the choice is the best of those that the machine allows, and is said."""

from __future__ import annotations

import re
from pathlib import Path

import labseq_auto
import labseq_grid
import labseq_psca
import numpy as np
import pytest
from labseq_auto.planner import PLANNERS, TWEEZERS, AutoPlanner, AutoSettings

from labseq import make_planner
from labseq.cli import main
from labseq.data.reader import open_run
from labseq.errors import PlanError
from labseq.model import LossSpec, MotionSpec
from labseq.plugin import Context, Registry, SiteGrid, TargetPattern
from labseq.plugin.planning import check_plan, expect, random_loadings

from .planning import COMPACT

GRID = SiteGrid()


def registry() -> Registry:
    made = Registry()
    for plugin in (labseq_psca, labseq_grid, labseq_auto):
        plugin.labseq_register(made)
    return made


def auto(motion: MotionSpec, loading: float | None = None) -> AutoPlanner:
    return AutoPlanner(AutoSettings(loading=loading), Context(grid=GRID, motion=motion), registry())


@pytest.mark.parametrize("losses", [LossSpec(), LossSpec(passing=0.3), LossSpec(move=0.1)])
def test_the_choice_leaves_fewest_defects_of_all(losses: LossSpec) -> None:
    motion = MotionSpec(losses=losses, max_tweezers=10)
    chosen = auto(motion)
    said = chosen.choose(COMPACT)
    loadings = random_loadings(GRID.shape, 0.75, 12)
    expected = {
        f"{name} with {n} tweezers": expect(
            make_planner(name, grid=GRID, motion=motion, degree_of_parallelism=n, **options).plan,
            loadings, COMPACT, n, GRID, motion,
        )
        for name, options in PLANNERS.items()
        for n in sorted({min(n, 10) for n in TWEEZERS})
    }  # fmt: skip
    best = min(expected, key=lambda name: expected[name].n_defects)
    assert said[0] == f"{best}: {expected[best]}"
    plan = chosen.plan(loadings[0], COMPACT)
    name, n = best.split()[0], int(best.split()[2])
    other = make_planner(name, grid=GRID, motion=motion, degree_of_parallelism=n, **PLANNERS[name])
    assert np.array_equal(plan.moves, other.plan(loadings[0], COMPACT).moves)


def test_passes_that_cost_much_and_lanes_that_are_missing_lead_to_psca() -> None:
    assert auto(MotionSpec()).choose(COMPACT)[0].startswith("grid with")
    assert auto(MotionSpec(losses=LossSpec(passing=0.3))).choose(COMPACT)[0].startswith("psca with")
    said = auto(MotionSpec(clearance_m=3e-6)).choose(COMPACT)
    assert said[0].startswith("psca with")
    assert said[-1].startswith("grid is left out: the clearance of moving tweezers")


def test_what_does_not_fit_into_the_window_does_not_count() -> None:
    """Few tweezers leave fewest defects if there is time, and many if there is not."""
    planner, window_s = auto(MotionSpec(overhead_per_batch_s=0.5e-3)), 24e-3
    at_leisure, in_haste = planner.choose(COMPACT)[0], planner.choose(COMPACT, window_s)[0]
    n_tweezers = [int(text.split()[2]) for text in (at_leisure, in_haste)]
    assert n_tweezers[0] < n_tweezers[1]
    loadings = random_loadings(GRID.shape, 0.75, 2)
    assert planner.plan(loadings[0], COMPACT).n_batches < 18  # as was chosen last; with 4 tweezers 20


def test_shallow_tweezers_whose_losses_are_not_known_are_left_to_psca() -> None:
    said = auto(MotionSpec(path_depth=0.5)).choose(COMPACT)
    assert said[0].startswith("psca with")
    assert said[-1].startswith("grid is left out: at a path_depth below 0.8")


def test_one_tweezer_and_few_atoms() -> None:
    planner = auto(MotionSpec(max_tweezers=1), loading=0.3)
    assert "with 1 tweezer:" in planner.choose(COMPACT)[0]
    atoms = random_loadings(GRID.shape, 0.3, 1)[0]
    plan = planner.plan(atoms, COMPACT)
    report = check_plan(plan, atoms, COMPACT, 1, GRID, MotionSpec(max_tweezers=1))
    assert report.n_defects == COMPACT.n_atoms - int(atoms.sum())


def test_another_target_is_another_choice() -> None:
    planner = auto(MotionSpec())
    first = planner.choose(COMPACT)
    fill = np.zeros(GRID.shape, np.bool_)
    fill[9, 9] = True
    small = TargetPattern(fill, fill & False)
    assert planner.choose(small) != first
    assert planner.choose(COMPACT) == first
    with pytest.raises(PlanError, match="auto"):
        planner.plan(np.zeros((3, 3)), small)


def run_main(*arguments: str) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 0


SEQUENCE = """
labseq: 1
name: chosen
profile: virtual
shots: 1
target: {{pattern: compact, rows: 15, cols: 15}}
planner: {planner}
shot:
  - load: {{duration: 500 ms}}
  - image: {{exposure: 45 ms}}
  - rearrange: {{cycles: 1, window: 60 ms}}
  - image: {{exposure: 45 ms}}
"""


def test_check_and_record_say_what_was_chosen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequence = tmp_path / "chosen.yaml"
    sequence.write_text(SEQUENCE.format(planner="{use: auto}"))
    run_main("check", str(sequence))
    out = capsys.readouterr().out
    assert "chosen    grid with" in out
    assert "or        psca with" in out
    assert "losses    move, tone," in out  # the profile has none of its own
    assert "better" not in out
    run_main("run", str(sequence), f"--output={tmp_path}", "--json")
    assert "planner: grid with" in capsys.readouterr().err
    run = open_run(next(tmp_path.glob("*/*/run.json")))
    (event,) = (event for event in run.events if event["event"] == "planner_chosen")
    assert event["values"]["chosen"][0].startswith("grid with")
    assert {"psca", "grid", "auto"} <= {
        plugin["name"].removeprefix("labseq_") for plugin in run.record["plugins"]
    }


def test_every_command_chooses_for_the_loading_at_hand(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """That of the simulation, or that which planners are compared on; not always 75 %."""
    sequence = tmp_path / "chosen.yaml"

    def said(heading: str, *arguments: str) -> str:
        run_main(*arguments)
        (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith(heading))
        return line

    def checked(heading: str, planner: str) -> str:
        sequence.write_text(SEQUENCE.format(planner=planner))
        line = said(heading, "check", str(sequence), "--set=profile.simulation.loading=90%")
        return re.findall(r"(grid with \d+ tweezers).*?(filling [\d.]+ %)", line)[0]

    assert checked("chosen ", "{use: auto}") == checked("better ", "{use: psca}")
    options = "bench", "planners", "--planners=auto", "--loadings=1"
    assert said("auto chose ", *options, "--loading=90%") != said("auto chose ", *options)


def test_plan_says_what_was_chosen(capsys: pytest.CaptureFixture[str]) -> None:
    target = "{pattern: compact, rows: 15, cols: 15}"
    run_main("plan", "random:20x20@0.75", "--seed=1", "--target", target, "--planner=auto")
    assert "chosen     grid with" in capsys.readouterr().out


def test_each_point_of_a_scan_has_its_choice_before_its_shot(tmp_path: Path) -> None:
    sequence = tmp_path / "chosen.yaml"
    scan = "scan:\n  profile.mobile_tweezers.path_depth: [1, 0.5]\n"
    sequence.write_text(SEQUENCE.format(planner="{use: auto}").replace("shots: 1\n", scan))
    run_main("run", str(sequence), f"--output={tmp_path}", "--json")
    run = open_run(next(tmp_path.glob("*/*/run.json")))
    events = [event for event in run.events if event["event"] in ("planner_chosen", "shot_started")]
    assert [event["event"] for event in events] == ["planner_chosen", "shot_started"] * 2
    chosen = [event["values"]["chosen"][0].split()[0] for event in events[::2]]
    assert chosen == ["grid", "psca"]


def test_check_names_a_choice_that_is_clearly_better(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sequence = tmp_path / "chosen.yaml"
    for planner, is_named in (
        ("{use: psca, degree_of_parallelism: 7}", True),
        ("{use: grid, degree_of_parallelism: 7, lanes: weaving}", False),
    ):
        sequence.write_text(SEQUENCE.format(planner=planner))
        run_main("check", str(sequence))
        out = capsys.readouterr().out
        assert ("better     `auto`, which is grid with " in out) == is_named
        assert (" defects after one cycle, filling 98." in out) == is_named
