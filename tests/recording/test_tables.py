"""A run as tables: every number is that of the shots' files, read here by h5py alone."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labseq.data.columns import columns_of
from labseq.data.reader import Run, open_run
from labseq.errors import ConfigError, RecordingError
from labseq.messages import install_hint
from labseq.recording.writer import RunWriter

from .records import make_run, make_shot, write
from .scanned import ADDRESSES, DEGREES, N_REPEATS, WINDOWS_S, write_scan


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return open_run(write_scan(tmp_path_factory.mktemp("scan")))


def entries(run: Run) -> list[Any]:
    """The shots' files, read by h5py alone."""
    found: list[Any] = []
    for path in sorted((run.path / "shots").glob("*.h5")):
        with h5py.File(path) as file:
            entry: Any = file["entry"]
            found.append(
                {
                    **entry.attrs,
                    "status": entry.attrs["status"].decode(),
                    "parameters": {name: value[()] for name, value in entry["parameters"].items()},
                    "readings": json.loads(entry["readings"][()]),
                    "occupancy": entry["detection/occupancy"][()],
                    "cycles": entry["rearrangement/cycles"][()],
                    "moves": entry["rearrangement/moves"][()],
                    "timing": entry["timing"][()],
                    "fill": entry["target/fill"][()],
                }
            )
    return found


def test_a_table_agrees_with_the_files(run: Run) -> None:
    table = run.to_dataframe()
    found = entries(run)
    assert table.index.tolist() == [one["shot"] for one in found] == list(range(24))
    for name in ("attempt", "status", "success", "filling_fraction", "n_images", "n_missing_atoms"):
        assert table[name].tolist() == [one[name] for one in found], name
    for address in ADDRESSES:
        assert table[address].tolist() == [one["parameters"][address] for one in found]
    assert table["reading.laser.power_w"].tolist() == [one["readings"]["laser"]["power_w"] for one in found]
    truth = [one["readings"]["simulation.n_defects_true"] for one in found]
    assert table["reading.simulation.n_defects_true"].tolist() == truth
    assert table["n_atom_moves"].tolist() == [one["moves"]["played"].sum() for one in found]
    last = [(one["fill"] & ~one["occupancy"][-1] & 1).sum() for one in found]
    assert table["n_defects"].tolist() == last
    plan_s = [one["timing"]["duration_s"][one["timing"]["stage"] == b"plan"].sum() for one in found]
    np.testing.assert_allclose(table["stage.plan_s"], plan_s)
    assert set(table["calibration.sites"]) == {"f102b3cd999c"}


def test_every_column_has_a_unit_and_a_description(run: Run) -> None:
    table = run.to_dataframe()
    units, texts = table.attrs["units"], table.attrs["descriptions"]
    assert {*units} == {*texts} == {"shot", *table.columns}
    assert all(texts.values())
    assert units["shot.2.rearrange.window"] == "s"  # written as "60 ms"
    assert units["planner.degree_of_parallelism"] == ""
    assert (units["reading.laser.power_w"], units["stage.plan_s"], units["duration_s"]) == ("W", "s", "s")
    assert table.attrs["status"] == "complete"
    assert json.dumps(table.attrs)


def test_what_is_not_known_is_nan(tmp_path: Path) -> None:
    table = write(
        tmp_path,
        make_shot(0, filling_fraction=float("nan"), n_images=0, readings={"a": 1, "b": "on"}),
        make_shot(1, readings={"c": True}, parameters={"x": [1, 2]}, calibrations={}),
    ).to_dataframe()
    for name in ("filling_fraction", "n_defects", "reading.c", "duration_s"):
        assert np.isnan(table[name][0]), name
    assert np.isnan(table["reading.a"][1])
    assert table["reading.b"].tolist() == ["on", ""]
    assert table["x"].tolist() == ["", "[1, 2]"]
    assert table["calibration.sites"].tolist() == ["f102b3cd999c", ""]


def test_texts_that_have_no_utf8_are_escaped(tmp_path: Path) -> None:
    run = write(tmp_path, make_shot(0, parameters={"a \ud800": "\ud800"}))
    assert run.to_dataframe()["a_\\ud800"].tolist() == ["\\ud800"]


def test_attempts_have_rows_where_they_are_asked_for(tmp_path: Path) -> None:
    writer = RunWriter.create(tmp_path, make_run())
    for shot in (make_shot(0, status="failed"), make_shot(0, attempt=1), make_shot(1)):
        writer.write_shot(shot)
    run = open_run(writer.run_dir)
    assert run.to_dataframe()["attempt"].tolist() == [1, 0]
    table = run.to_dataframe(attempts=True)
    assert list(zip(table.index, table["status"], strict=True)) == [
        (0, "failed"), (0, "complete"), (1, "complete")
    ]  # fmt: skip


def test_the_index_is_enough_for_a_table(run: Run, tmp_path: Path) -> None:
    for name in ("run.json", "STATE", "index.jsonl"):
        (tmp_path / name).write_bytes((run.path / name).read_bytes())
    copy = open_run(tmp_path)
    assert copy.to_dataframe().equals(run.to_dataframe())
    assert "filling_fraction" in copy.to_xarray(occupancies=False)
    with pytest.raises(RecordingError, match="is missing"):
        copy.to_xarray()


def test_a_dataset_has_the_axes_of_the_scan(run: Run) -> None:
    data = run.to_xarray()
    assert dict(data.sizes) == {
        ADDRESSES[0]: 3, ADDRESSES[1]: 4, "repeat": N_REPEATS, "image": 3, "row": 4, "col": 5
    }  # fmt: skip
    assert data[ADDRESSES[0]].values.tolist() == DEGREES
    assert data[ADDRESSES[1]].values.tolist() == WINDOWS_S
    assert data[ADDRESSES[1]].attrs["units"] == "s"
    for one in entries(run):
        at = data.sel({address: one["parameters"][address] for address in ADDRESSES})
        at = at.isel(repeat=at["shot"].values.tolist().index(one["shot"]))
        assert float(at["filling_fraction"]) == one["filling_fraction"]
        assert bool(at["success"]) == one["success"]
        n = one["n_images"]
        np.testing.assert_array_equal(at["occupancy"].values[:n], one["occupancy"])
        assert (at["occupancy"].values[n:] == -1).all()
    assert data["occupancy"].attrs["description"]


def test_shots_that_are_missing_leave_gaps(tmp_path: Path) -> None:
    run = open_run(write_scan(tmp_path, n_repeats=1, n_missing=7))
    data = run.to_xarray()
    for name in ("filling_fraction", "n_images", "success"):
        assert int(np.isnan(data[name]).sum()) == 7
    assert int((data["status"] == "").sum()) == 7
    assert int((data["occupancy"] == -1).all(("image", "row", "col")).sum()) == 7


def test_a_scan_that_is_no_product_has_an_axis_of_points(tmp_path: Path) -> None:
    points = [[1, 0.12], [5, 0.06], [15, 0.03]]
    data = open_run(write_scan(tmp_path, points=points)).to_xarray()
    assert data["filling_fraction"].dims == ("point", "repeat")
    assert data[ADDRESSES[0]].values.tolist() == [1, 5, 15]
    assert data[ADDRESSES[1]].dims == ("point",)


def test_without_a_scan_the_axis_is_that_of_the_shots(tmp_path: Path) -> None:
    writer = RunWriter.create(tmp_path, make_run())
    for index in (0, 2):
        shot = make_shot(index)
        del shot.images[1 : 1 if index else 2]  # the first needs one cycle less
        writer.write_shot(shot)
    run = open_run(writer.run_dir)
    data = run.to_xarray()
    assert data["shot"].values.tolist() == [0, 2]
    assert data["occupancy"].dims == ("shot", "image", "row", "col")
    assert data["image"].values.tolist() == ["image_0", "image_1", "image_2"]
    assert (data["occupancy"].isel(shot=0).sel(image="image_1") == -1).all()
    for at, shot in zip((0, 1), run.shots, strict=True):
        last = data["occupancy"].isel(shot=at).sel(image="image_2")
        np.testing.assert_array_equal(last, shot.occupancies[-1])
    assert data["target_fill"].values.sum() == 6


@pytest.mark.parametrize("package", ["pandas", "xarray"])
def test_a_missing_package_is_explained(run: Run, monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    def without(name: str) -> Any:
        return None if name == package else found(name)

    found = importlib.util.find_spec
    monkeypatch.setattr("labseq.data.tables.find_spec", without)
    with pytest.raises(
        ConfigError, match=re.escape(f"{package}, which is not installed; {install_hint('analysis')}")
    ):
        run.to_dataframe() if package == "pandas" else run.to_xarray()


plain = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3) | st.just([1])
lines = st.fixed_dictionaries(
    {},
    optional={
        "stage_s": plain | st.dictionaries(st.text(max_size=6), plain, max_size=2),
        "parameters": plain | st.dictionaries(st.text(max_size=6), plain, max_size=2),
        "readings": plain | st.dictionaries(st.text(max_size=6), plain, max_size=2),
        "images": plain | st.fixed_dictionaries({"n_defects": plain | st.lists(plain, max_size=2)}),
        "calibrations": plain,
        "simulation": plain,
        "n_cycles": plain,
        "file": st.text(max_size=3),
    },
)


@settings(max_examples=25)
@given(st.lists(lines, min_size=1, max_size=3))
def test_any_index_makes_columns_of_equal_length(run: Run, changes: list[dict[str, Any]]) -> None:
    index = run.path / "index.jsonl"
    before = index.read_text("utf-8")
    rows = [json.loads(line) for line in before.splitlines()]
    try:
        changed = [row | change for row, change in zip(rows, changes, strict=False)]
        index.write_text("".join(f"{json.dumps(row)}\n" for row in changed), "utf-8")
        read = open_run(run.path)
    finally:
        index.write_text(before, "utf-8")
    columns = columns_of(read)
    assert {len(column.values) for column in columns} == {len(read.shots)}
    assert len({column.name for column in columns}) == len(columns)
    assert all(column.description for column in columns)
