"""Entries come back from their files bit by bit; a damaged file is reported and never used."""

from __future__ import annotations

import json
import math
from datetime import UTC, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from labseq.calibration_store import encode_entry, read_entry
from labseq.errors import ConfigError
from labseq.model import CALIBRATION_KINDS, CalibrationEntry, CalibrationKind, SiteGrid
from labseq.testing.fakes import fake_calibration

finite = st.floats(allow_nan=False, allow_infinity=False)
figures = st.dictionaries(st.text(max_size=5), st.floats(allow_infinity=False), max_size=3)
ZONES = [UTC, timezone(timedelta(hours=-9, minutes=-30))]
plain = st.dictionaries(st.text(max_size=5), st.none() | st.integers() | st.text(max_size=5), max_size=3)


@st.composite
def entries(draw: st.DrawFn) -> CalibrationEntry:
    grid = SiteGrid(draw(st.integers(1, 4)), draw(st.integers(1, 4)), spacing_m=draw(st.floats(1e-9, 1.0)))
    kind: Any = draw(st.sampled_from(["sites", "thresholds", "overlay"]))
    shapes: dict[str, tuple[int, ...]] = {
        "sites": (*grid.shape, 2),
        "thresholds": grid.shape,
        "overlay": (2,),
    }
    name = {"sites": "positions_px", "thresholds": "thresholds", "overlay": "offset_m"}[kind]
    values = {name: draw(hnp.arrays(np.float64, shapes[kind], elements=finite)), "beside_px": draw(finite)}
    taken = draw(st.datetimes(timezones=st.sampled_from(ZONES))).isoformat()
    return fake_calibration(
        kind, grid, values=values, quality=draw(figures), origin=draw(plain), taken_utc=taken
    )


@settings(max_examples=15, deadline=None)
@given(entries())
def test_an_entry_comes_back_bit_by_bit(
    tmp_path_factory: pytest.TempPathFactory, entry: CalibrationEntry
) -> None:
    path = tmp_path_factory.getbasetemp() / "entry.json"
    path.write_bytes(encode_entry(entry))
    read = read_entry(path)
    assert (read.kind, read.id, read.grid, read.origin) == (entry.kind, entry.id, entry.grid, entry.origin)
    assert read.taken_utc == entry.taken_utc
    assert {name: value.tobytes() for name, value in read.values.items()} == {
        name: value.tobytes() for name, value in entry.values.items()
    }
    assert read.quality.keys() == entry.quality.keys()
    for name, value in entry.quality.items():
        assert read.quality[name] == value or math.isnan(value)


@settings(max_examples=30, deadline=None)
@given(kind=st.sampled_from(CALIBRATION_KINDS), data=st.data())
def test_a_file_that_was_cut_or_overwritten_is_never_taken_for_another_calibration(
    tmp_path_factory: pytest.TempPathFactory, kind: CalibrationKind, data: st.DataObject
) -> None:
    entry = fake_calibration(kind, SiteGrid(2, 3))
    whole = encode_entry(entry)
    start = data.draw(st.integers(0, len(whole) - 1))
    end = data.draw(st.integers(start, len(whole)))
    path = tmp_path_factory.getbasetemp() / "damaged.json"
    path.write_bytes(whole[:start] + data.draw(st.binary(max_size=6)) + whole[end:])
    try:
        read = read_entry(path)
    except ConfigError as error:
        assert error.problems[0].source == str(path)
    else:
        assert (read.kind, read.id) == (entry.kind, entry.id)


def changed(tmp_path: Path, **changes: Any) -> Path:
    """The file of an overlay with some of its keys replaced."""
    content = json.loads(encode_entry(fake_calibration("overlay", SiteGrid(2, 3))))
    path = tmp_path / "overlay.json"
    path.write_text(json.dumps(content | changes), "utf-8")
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"values": {"offset_m": [1e-9, 0.0]}}, "the id of its content is"),
        ({"values": {"offset_m": [0.0, 0.0, 0.0]}}, r"'offset_m' has shape \(3,\); expected \(2,\)"),
        ({"values": {"offset_m": [[0.0], 0.0]}}, "damaged"),
        ({"values": {"offset_m": [math.nan, 0.0]}}, "not finite"),
        ({"values": {}}, "'offset_m' is missing"),
        ({"grid": {"rows": "x"}}, "damaged"),
        ({"quality": {"error_m": "good"}}, "damaged"),
        ({"format": "else"}, "its format is not 'labseq-calibration'"),
        ({"format_version": "x"}, "its format version is 'x'"),
    ],
)
def test_what_is_wrong_with_a_file_is_reported(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read_entry(changed(tmp_path, **changes))


def test_a_file_of_a_newer_labseq_is_refused_and_one_with_more_in_it_is_not(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"its format version is 3.0; expected 2.0; update labseq"):
        read_entry(changed(tmp_path, format_version="3.0"))
    with pytest.raises(
        ConfigError, match=r"is 1.7; expected 2.0; calibrate again; an earlier labseq wrote it"
    ):
        read_entry(changed(tmp_path, format_version="1.7"))
    assert read_entry(changed(tmp_path, format_version="2.7", new="x")).kind == "overlay"


@pytest.mark.parametrize("content", [b"", b"[]", b"[" * 100_000, b"\xff", b"1" * 5000])
def test_what_is_no_entry_at_all_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.json"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match="this file is damaged"):
        read_entry(path)
