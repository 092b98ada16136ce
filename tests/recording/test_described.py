"""Whoever opens a shot's file finds at every number what it is, and finds the same in the reference."""

from __future__ import annotations

import dataclasses
import io
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from labseq.model import RunRecord, ShotRecord
from labseq.recording.run_file import index_row
from labseq.recording.schema import (
    ATTRIBUTES,
    COLUMNS,
    DATASETS,
    EVERYWHERE,
    FORMAT_VERSION,
    RUN_FORMAT_VERSION,
    TABLES,
    UNDOCUMENTED,
)
from labseq.recording.shot_file import ShotEncoder

MakeRun = Callable[..., RunRecord]
MakeShot = Callable[..., ShotRecord]


@pytest.fixture
def file(make_run: MakeRun, make_shot: MakeShot) -> Iterator[Any]:
    """A shot's file with everything that one can hold."""
    columns = {"descriptions": {"t_s": "when it jumped"}}
    jumps = np.zeros(2, np.dtype([("t_s", "f8"), ("row", "f4")], metadata=columns))
    run = make_run(sequence_text="x" * 300, profile_text="y\n")
    data = ShotEncoder(run, "day/run").encode(make_shot(atom_events={"jumps": jumps}))
    with h5py.File(io.BytesIO(data)) as opened:
        yield opened


def nodes(file: Any, kind: type) -> dict[str, Any]:
    found: dict[str, Any] = {}
    file.visititems(lambda name, node: found.update({f"/{name}": node} if isinstance(node, kind) else {}))
    return found


def known_as(name: str) -> str:
    """The path in DATASETS of a dataset in a file."""
    path = re.sub(r"^/entry/(camera)/[^/]+", r"/entry/\1/<name>", name).removeprefix("/entry/")
    group, _, last = path.rpartition("/")
    return path if path in DATASETS or last == "<name>" else f"{group}/<name>"


def test_every_dataset_says_what_it_is_and_in_what_unit(file: Any) -> None:
    for name, dataset in nodes(file, h5py.Dataset).items():
        what = DATASETS[known_as(name)]
        assert dataset.attrs["description"] == what.meaning, name
        if dataset.dtype.names:
            units, texts = list(dataset.attrs["units"]), list(dataset.attrs["descriptions"])
            assert len(units) == len(texts) == len(dataset.dtype.names), name
            assert all(texts), name
            assert all(units[i] == "s" for i, one in enumerate(dataset.dtype.names) if one.endswith("_s")), (
                name
            )
        else:
            assert dataset.attrs["units"] == what.units, name
            assert what.units == "s" or not name.endswith("_s"), name


def test_every_dataset_is_as_the_table_of_them_has_it(file: Any) -> None:
    found = nodes(file, h5py.Dataset)
    assert {known_as(name) for name in found} == {*DATASETS}
    for name, dataset in found.items():
        what = DATASETS[known_as(name)]
        n_axes = len(what.shape.split(", ")) if what.shape else 0
        assert dataset.ndim == n_axes, name
        if what.dtype == "table":
            assert dataset.dtype.names, name
        elif "text" in what.dtype:
            assert h5py.check_string_dtype(dataset.dtype), name
        elif what.dtype.startswith("ascii"):
            assert dataset.dtype == "S16", name
        else:
            assert dataset.dtype == what.dtype, name


def test_every_column_is_described(file: Any) -> None:
    for path, columns in COLUMNS.items():
        assert TABLES[path].names == tuple(columns) == file["entry"][path].dtype.names
        assert list(file["entry"][path].attrs["descriptions"]) == list(columns.values())


def test_a_simulation_may_describe_the_columns_of_its_story(file: Any) -> None:
    jumps = file["entry/story/jumps"]
    assert list(jumps.attrs["descriptions"]) == ["when it jumped", UNDOCUMENTED]
    assert list(jumps.attrs["units"]) == ["s", ""]


def test_every_attribute_is_described(file: Any) -> None:
    every = {"/": file, **nodes(file, h5py.Group), **nodes(file, h5py.Dataset)}
    for name, node in every.items():
        place = re.sub(r"^/entry/(camera)/[^/]+", r"/entry/\1/<name>", name)
        known = {*ATTRIBUTES.get(place, {})}
        own = {*node.attrs} - ({*EVERYWHERE} if isinstance(node, h5py.Dataset) else set[str]())
        free = {"<name>", "<kind>"} & known
        assert own <= known or free, (name, own - known)
        assert known - {"<name>", "<kind>"} <= own, name


def test_a_camera_of_another_name_is_described_alike(make_run: MakeRun, make_shot: MakeShot) -> None:
    shot = make_shot(n_images=1)
    frame = dataclasses.replace(shot.images[0].frame, camera="日/1")  # pyright: ignore[reportArgumentType, reportCallIssue]
    shot.images = [dataclasses.replace(shot.images[0], frame=frame)]
    with h5py.File(io.BytesIO(ShotEncoder(make_run(), "day/run").encode(shot))) as file:
        group: Any = file["entry/camera/日_1"]
        assert group["number"].attrs["description"] == DATASETS["camera/<name>/number"].meaning


def test_every_key_of_the_index_and_every_version_is_in_the_reference(
    make_run: MakeRun, make_shot: MakeShot
) -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "hdf5.md").read_text("utf-8")
    index = page[page.index("## Index") : page.index("## Archives")]
    row = index_row(make_shot(), make_run().target, file="", sha256="", n_bytes=0)
    known = {
        name for line in index.splitlines() if line.startswith("|") for name in re.findall(r"`(\w+)`", line)
    }
    assert {*row} <= known
    assert f"| {FORMAT_VERSION} |" in page
    assert f"| {RUN_FORMAT_VERSION} |" in page
    assert {what.since_version for what in DATASETS.values()} <= {
        *re.findall(r"^\| (\d\.\d) \|", page, re.MULTILINE)
    }
