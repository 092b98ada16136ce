from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labseq.assembly.occupancies import Source, read_source
from labseq.assembly.planning import PlanInputs, PlanRequest, read_inputs
from labseq.errors import ConfigError

ROOT = Path(__file__).parents[2]
SEQUENCE = ROOT / "sequences" / "compact_225.yaml"
FULL = "random:20x20@1"


COMPACT = "{pattern: compact, rows: 15, cols: 15}"


def inputs(target: str | None = COMPACT, occupancy: str = FULL, **options: Any) -> PlanInputs:
    request = PlanRequest(occupancy, target, **options)
    return read_inputs(request, read_source(occupancy, 1))


def message(*arguments: Any, **options: Any) -> str:
    with pytest.raises(ConfigError) as caught:
        inputs(*arguments, **options)
    return str(caught.value)


def first_site(found: PlanInputs) -> tuple[int, int]:
    row, col = np.argwhere(found.target.fill)[0].tolist()
    return row, col


def test_a_target_is_centred_or_at_its_origin() -> None:
    assert first_site(inputs()) == (2, 2)
    assert first_site(inputs(origin="0,5")) == (0, 5)
    assert first_site(inputs(str(SEQUENCE), origin="4,1")) == (4, 1)
    assert inputs(str(SEQUENCE)).target.n_atoms == inputs("compact_225").target.n_atoms == 225
    assert first_site(inputs("{pattern: compact, rows: 15, cols: 15, origin: [5, 0]}")) == (5, 0)
    assert first_site(inputs("{pattern: compact, rows: 15, cols: 15, origin: [5, 0]}", origin=" 1 , 2 ")) == (
        1,
        2,
    )


@pytest.mark.parametrize(
    ("target", "options", "words"),
    [
        (None, {}, "--target is missing; expected a pattern as in a sequence file, '{pattern: kagome, "),
        ("", {}, "--target is empty; expected a pattern as in a sequence file"),
        (
            "compact:3x3",
            {},
            "--target compact:3x3: there is no sequence 'compact:3x3'; expected a pattern as in",
        ),
        ("compact_2255", {}, "did you mean 'compact_225'?"),
        ("{rows: 3}", {}, "--target {rows: 3}: 'pattern' is missing from 'target'"),
        (
            "{pattern: compact, rows: 3",
            {},
            "rows: 3: the '{' that opens here is not closed; expected ',' or '}'",
        ),
        ("{pattern: compakt, rows: 3, cols: 3}", {}, "cols: 3}: unknown pattern 'compakt'; expected one of"),
        (
            "{pattern: compact, rows: 0, cols: 3}",
            {},
            "--target {pattern: compact, rows: 0, cols: 3}: rows is 0; expected at least 1",
        ),
        (
            "{pattern: compact, rows: 21, cols: 20}",
            {},
            "21 rows x 20 columns; the limit is the grid of 20 rows x 20 columns",
        ),
        (COMPACT, {"origin": "6,0"}, "row 6, column 0; the limit is rows 0 to 5 and columns 0 to 5"),
        (COMPACT, {"origin": "1,x"}, "this is not a site"),
        ("nowhere.yaml", {}, "nowhere.yaml: there is no such file"),
        (
            COMPACT,
            {"planner": "pcsa"},
            "--planner pcsa: unknown planner 'pcsa'; expected",
        ),
        (COMPACT, {"planner": "a b"}, "this is not the name of a planner"),
        (
            COMPACT,
            {"degree_of_parallelism": 0},
            "--dop 0: degree_of_parallelism is 0; expected at least 1",
        ),
        (
            COMPACT,
            {"overrides": ["dop=3"]},
            "--set dop=3: 'dop' is not a setting of planner 'psca'",
        ),
        (
            COMPACT,
            {"overrides": ["profile.grid.rows=3"]},
            "--profile is missing",
        ),
        (COMPACT, {"profile": "virtul"}, "did you mean 'virtual'?"),
    ],
)
def test_what_cannot_be_planned_is_refused(target: Any, options: Any, words: str) -> None:
    assert words in message(target, **options)


def test_all_that_is_wrong_with_a_target_is_reported_at_once() -> None:
    text = message("{pattern: compact, rows: 0, cols: 0, width: 3}")
    assert text.count("\n") == 2
    assert all(word in text for word in ("rows is 0", "cols is 0", "'width' is not a setting"))


def test_settings_of_the_planner() -> None:
    def dop(**options: Any) -> int:
        return inputs(**options).planner.dump()["degree_of_parallelism"]

    assert dop() == 7
    assert dop(degree_of_parallelism=3) == 3
    assert dop(overrides=["degree_of_parallelism=4"]) == 4
    assert dop(overrides=["planner.degree_of_parallelism=5"], degree_of_parallelism=3) == 5
    assert inputs(overrides=["max_tones.row=3"]).planner.dump()["max_tones"]["row"] == 3


def test_a_profile_gives_grid_and_motion() -> None:
    found = inputs(profile="virtual", overrides=["profile.mobile_tweezers.speed=75 um/ms"])
    assert found.machine.grid.shape == (20, 20)
    assert found.machine.motion.speed_m_s == pytest.approx(0.075)
    assert inputs().machine.motion.speed_m_s == pytest.approx(0.13)


def test_a_profile_of_another_grid_is_refused() -> None:
    text = message("{pattern: compact, rows: 3, cols: 3}", "random:5x6@1", profile="virtual")
    assert "random:5x6@1, seed 1: the occupancy has 5 x 6 sites; expected 20 x 20, as in" in text


def test_a_shot_brings_its_target_and_its_machine() -> None:
    target = inputs("{pattern: compact, rows: 2, cols: 2}", "random:4x5@1").target
    machine = {
        "grid": {"rows": 4, "cols": 5, "spacing": 3e-6, "lattice": "square"},
        "mobile_tweezers": inputs_motion(speed=0.2),
    }
    source = Source(np.ones((4, 5), np.bool_), "a shot", target=target, machine=machine)
    found = read_inputs(PlanRequest("a shot"), source)
    assert found.target is target
    assert (found.machine.grid.lattice, found.machine.grid.spacing_m) == ("square", 3e-6)
    assert found.machine.motion.speed_m_s == pytest.approx(0.2)
    other = read_inputs(PlanRequest("a shot", "{pattern: compact, rows: 4, cols: 4}"), source)
    assert other.target.n_atoms == 16
    with pytest.raises(ConfigError, match="--origin needs --target"):
        read_inputs(PlanRequest("a shot", origin="1,1"), source)


def inputs_motion(**changes: Any) -> dict[str, Any]:
    from labseq.config.profile import MobileTweezersChoice

    return MobileTweezersChoice(use="virtual").model_dump(mode="json", exclude={"use"}) | changes


@pytest.mark.parametrize("machine", [{}, {"grid": {"rows": 0, "cols": 5}}])
def test_a_damaged_profile_in_a_shot_is_refused(machine: Any) -> None:
    source = Source(np.ones((4, 5), np.bool_), "a shot", machine=machine)
    with pytest.raises(ConfigError, match="the profile in the shot's file"):
        read_inputs(PlanRequest("a shot", "{pattern: compact, rows: 2, cols: 2}"), source)


@settings(max_examples=12)
@given(st.integers(1, 6), st.integers(1, 6), st.integers(0, 6), st.integers(0, 6))
def test_a_target_is_at_its_origin_or_refused(rows: int, cols: int, row: int, col: int) -> None:
    fits = row + rows <= 6 and col + cols <= 6
    try:
        found = inputs(
            f"{{pattern: compact, rows: {rows}, cols: {cols}}}", "random:6x6@1", origin=f"{row},{col}"
        )
    except ConfigError:
        assert not fits
    else:
        assert fits
        assert first_site(found) == (row, col)
        assert found.target.n_atoms == rows * cols
