from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from labseq.errors import ConfigError
from labseq.plans.plan_file import MAX_BYTES, parse_plan


def document() -> dict[str, Any]:
    """A plan for 2 x 3 sites: one atom goes right, then another is ejected."""
    return {
        "planner": "mine",
        "grid": {"n_rows": 2, "n_cols": 3, "spacing_m": 4.49e-6, "lattice": "square", "shear": 1},
        "degree_of_parallelism": 4,
        "seed": None,
        "occupancy": [[1, 0, 0], [0, 0, 1]],
        "target": {"fill": [[0, 1, 0], [0, 0, 0]], "clear": [[0, 0, 0], [0, 0, 1]]},
        "n_batches": 2,
        "batches": [
            {"from": [[0, 0]], "to": [[0, 1]], "linked": False},
            {"from": [[1, 2]], "to": [[1, 3]], "linked": False},
        ],
    }


def parse(change: Callable[[dict[str, Any]], object]) -> None:
    values = document()
    change(values)
    parse_plan(json.dumps(values).encode(), "plan.json")


def test_a_plan_is_read_as_it_was_written() -> None:
    file = parse_plan(json.dumps(document()).encode(), "plan.json")
    assert (file.planner, file.degree_of_parallelism, file.seed) == ("mine", 4, None)
    assert (file.grid.shape, file.grid.lattice, file.grid.spacing_m) == ((2, 3), "square", 4.49e-6)
    assert file.occupancy.tolist() == [[True, False, False], [False, False, True]]
    assert np.argwhere(file.target.fill).tolist() == [[0, 1]]
    assert np.argwhere(file.target.clear).tolist() == [[1, 2]]
    assert file.plan.moves.tolist() == [[0, 0, 0, 1], [1, 2, 1, 3]]
    assert file.plan.batch_offsets.tolist() == [0, 1, 2]


BAD: list[tuple[Callable[[dict[str, Any]], object], str]] = [
    (lambda v: v.pop("batches"), "plan.json: 'batches' is missing"),
    (lambda v: v.pop("grid"), "plan.json: 'grid' is missing (the sites that the plan is for)"),
    (lambda v: v.update(batches=7), "batches is 7; expected a list"),
    (lambda v: v["batches"].append(7), "batches.2 is 7; expected a mapping"),
    (lambda v: v["batches"][1]["to"].append([0, 0]), "'from' has 1 sites, but 'to' has 2"),
    (lambda v: v["batches"][0].update(to=[[0, 1.5]]), "to.0.1 is 1.5; expected a whole number"),
    (lambda v: v["batches"][0].update(to=[[0, 99999]]), "to.0.1 is 99999; expected at most 2000"),
    (lambda v: v["batches"][0].update(form=[]), "'form' is not a setting of"),
    (
        lambda v: v["grid"].update(n_rows=3),
        "'occupancy' does not have the grid's shape; expected 3 rows of 3",
    ),
    (
        lambda v: v["target"].update(fill=[[0, 1], [0]]),
        "'fill' does not have the grid's shape; expected 2 rows",
    ),
    (lambda v: v["target"].update(clear=v["target"]["fill"]), "a site cannot be in both fill and clear"),
    (lambda v: v["occupancy"][0].__setitem__(0, 2), "occupancy.0.0 is 2; expected at most 1"),
    (lambda v: v["grid"].update(spacing_m=float("nan")), "spacing_m is nan; expected a finite number"),
    (lambda v: v["grid"].update(spacing_m=4.49), "spacing_m is 4.49; expected at most 0.001"),
    (lambda v: v.update(planner="\x1b[31mred"), "name is '\\x1b[31mred', with '\\x1b' in it"),
    (lambda v: v.update(degree_of_parallelism=0), "degree_of_parallelism is 0; expected at least 1"),
]


@pytest.mark.parametrize(("change", "words"), BAD, ids=[words for _, words in BAD])
def test_a_wrong_plan_is_refused_with_its_batch(
    change: Callable[[dict[str, Any]], object], words: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(change)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "plan.json:1:1: this is not JSON: expecting value"),
        (b'{\n"batches": [1,\n', "plan.json:3:1: this is not JSON: expecting value"),
        (b"[]", "plan.json: this is not a plan; expected what 'labseq plan --json' writes"),
        (b'{"batches": ' + b"9" * 5000 + b"}", "this is not a plan: Exceeds the limit"),
        (b"[" * 100_000, "this is not a plan: it is nested too deep"),
        (b"\xff", "byte 0xFF at offset 0 is not UTF-8"),
        (b" " * (MAX_BYTES + 1), "it is larger than 4 MiB"),
        (json.dumps(document()).replace("4.49e-06", "1e999").encode(), "expected a finite number"),
    ],
)
def test_a_file_without_a_plan_is_refused(data: bytes, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_plan(data, "plan.json")
    assert words in str(caught.value)


SCALARS = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.sampled_from(["", "a", "1", "\u00b5m", "\x1b[31m", "\ud800"])
)
VALUES = st.recursive(SCALARS, lambda inner: st.lists(inner, max_size=3), max_leaves=5)


@given(st.sampled_from([*document()]), VALUES)
def test_any_value_is_read_or_refused(key: str, value: object) -> None:
    values = document() | {key: value}
    try:
        parse_plan(json.dumps(values).encode("utf-8", "backslashreplace"), "plan.json")
    except ConfigError as error:
        assert str(error)
