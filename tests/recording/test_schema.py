"""Every value in a shot's file says what it is, and the reference says the same."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np
import pytest

from labseq.recording import contents, schema
from labseq.recording.shot_encoder import ShotEncoder

from .records import make_run, make_shot


@pytest.fixture
def file() -> Iterator[Any]:
    """A shot's file with everything that one can hold."""
    columns = {"descriptions": {"t_s": "when it jumped"}}
    jumps = np.zeros(2, np.dtype([("t_s", "f8"), ("row", "f4")], metadata=columns))
    events = {"plain": jumps.view(np.dtype([("t_s", "f8"), ("row", "f4")])), "jumps": jumps}
    data = ShotEncoder(make_run(), "day/run").encode(make_shot(atom_events=events))
    with h5py.File(io.BytesIO(data)) as opened:
        yield opened


def in_schema(path: str) -> str:
    """The path of the schema for a path in a file."""
    path = re.sub(r"^/entry/parameters/[^/]+", "/entry/parameters/<address>", path)
    return re.sub(r"^/entry/(camera|atom_events)/[^/]+", r"/entry/\1/<name>", path)


def test_the_file_holds_the_datasets_of_the_schema_with_type_unit_and_description(file: Any) -> None:
    found: dict[str, Any] = {}
    file.visititems(
        lambda name, node: found.update({f"/{name}": node} if isinstance(node, h5py.Dataset) else {})
    )
    known = {f"/entry/{one.path}": one for one in contents.datasets_of_file()}
    assert {in_schema(name) for name in found} == {*known}
    for name, dataset in found.items():
        what = known[in_schema(name)]
        assert dataset.attrs["description"].decode() == what.description, name
        assert dataset.ndim == (len(what.axes.split(", ")) if what.axes else 0), name
        if what is schema.PARAMETER:
            assert dataset.attrs["units"] == (b"s" if dataset.attrs["address"].endswith(b"window") else b"")
            continue
        if what.dtype == "table":
            continue
        units = "counts" if what.units == schema.OF_DETECTOR else what.units
        assert dataset.attrs["units"].decode() == units, name
        assert dataset.attrs.get("dimensions", b"").decode() == what.axes * ("text" not in what.dtype), name
        assert what.units == "s" or not name.endswith("_s"), name
        if "text" in what.dtype:
            text: Any = h5py.check_string_dtype(dataset.dtype)
            assert (text.encoding, text.length is None) == ("utf-8", False), name
        else:
            assert dataset.dtype == what.dtype, name


def test_every_column_says_what_it_is_and_in_what_unit(file: Any) -> None:
    for table in schema.TABLES:
        dataset = file["entry"][table.path.replace("<name>", "camera")]
        assert dataset.dtype.names == tuple(column.name for column in table.columns)
        assert list(dataset.attrs["descriptions"]) == [
            column.description.encode() for column in table.columns
        ]
        units = [b"s" if name.endswith("_s") else b"" for name in dataset.dtype.names]
        assert list(dataset.attrs["units"]) == units


def test_a_simulation_may_describe_its_columns(file: Any) -> None:
    jumps = file["entry/atom_events/jumps"]
    assert list(jumps.attrs["descriptions"]) == [
        b"when it jumped",
        b"as the simulation's plugin describes it",
    ]
    assert list(jumps.attrs["units"]) == [b"s", b""]
    assert (
        list(file["entry/atom_events/plain"].attrs["descriptions"])
        == [b"as the simulation's plugin describes it"] * 2
    )


def test_the_file_holds_the_attributes_of_the_schema(file: Any) -> None:
    every: dict[str, Any] = {"/": file}
    file.visititems(lambda name, node: every.update({f"/{name}": node}))
    for name, node in every.items():
        own = {*node.attrs} - ({*contents.EVERYWHERE} if isinstance(node, h5py.Dataset) else set[str]())
        assert own == {*contents.attributes().get(in_schema(name), {})}, name
