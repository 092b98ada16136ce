"""Rows of the index: written, read back, and refused where a line is damaged."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import pytest

from labseq.errors import RecordingError
from labseq.plain import dumps
from labseq.recording.index import IndexRow, row_of_line, row_of_record
from labseq.recording.schema import IN_INDEX

from .records import make_run, make_shot

FILE = "shots/shot_000000.h5"


def row(measured: Sequence[str] = (), **changes: Any) -> IndexRow:
    shot, target = make_shot(**changes), make_run().target
    return row_of_record(shot, target, file=FILE, sha256="ab", n_bytes=7, measured=measured)


def test_a_row_has_the_values_of_the_schema() -> None:
    names = [field.name for field in fields(IndexRow)]
    assert names[: len(IN_INDEX)] == [field.name for field in IN_INDEX]


def test_a_row_that_is_read_back_is_the_same() -> None:
    """Also where JSON has null: a scanner must not see whether a run was resumed."""
    written = row(filling_fraction=math.nan, readings={"simulation.lost.vacuum": math.inf})
    read = row_of_line(json.loads(dumps(written)))
    assert read is not None
    assert dumps(read) == dumps(written)
    assert read.success is None
    assert math.isnan(read.filling_fraction)
    assert math.isnan(read.simulation["lost.vacuum"])
    assert math.isnan(written.simulation["lost.vacuum"])


@pytest.mark.parametrize(
    "damage",
    [
        {"images": None},
        {"cycles": {"n_batches": [1], "n_batches_played": [], "n_atom_moves": []}},
        {"cycles": {"n_batches": ["1"], "n_batches_played": [1], "n_atom_moves": [1]}},
        {"cycles": {"n_batches": [2**63], "n_batches_played": [1], "n_atom_moves": [1]}},
        {"stage_s": {"plan": "1"}},
        {"stage_s": [1]},
        {"shot": 2**63},
        {"shot": True},
        {"success": 1},
        {"file": "../secret"},
        {"file": 1},
        {"filling_fraction": 10**400},
    ],
)
def test_a_damaged_line_is_no_row(damage: dict[str, Any]) -> None:
    values: dict[str, Any] = json.loads(dumps(row()))
    assert row_of_line(values) is not None
    assert row_of_line(values | damage) is None


@pytest.mark.parametrize("name", [field.name for field in fields(IndexRow) if field.name != "measured"])
def test_every_value_is_needed(name: str) -> None:
    values: dict[str, Any] = json.loads(dumps(row()))
    del values[name]
    assert row_of_line(values) is None


def test_a_line_of_an_earlier_version_measures_nothing() -> None:
    values: dict[str, Any] = json.loads(dumps(row(measured=["loading"])))
    read = row_of_line(values)
    assert read is not None
    assert read.measured.keys() == {"loading"}
    del values["measured"]
    read = row_of_line(values)
    assert read is not None
    assert read.measured == {}


def test_a_shot_that_no_line_can_tell_is_refused() -> None:
    with pytest.raises(RecordingError, match=r"cannot be listed in index\.jsonl"):
        row(shot_index=2**63)
