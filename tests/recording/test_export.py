"""What is exported says the same as the shots' files, read by other programs' packages alone."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
import xarray

from labseq.data.export import ENDINGS, check_export, export_run
from labseq.data.reader import Run, open_run
from labseq.errors import ConfigError
from labseq.recording.writer import RunWriter

from .records import make_run, make_shot, write
from .scanned import ADDRESSES, POINTS, write_scan

KINDS = ["netcdf", pytest.param("parquet", marks=pytest.mark.needs("pyarrow")), "csv", "archive"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = write_scan(tmp_path_factory.mktemp("scan"), points=POINTS[:4], n_repeats=1)
    (folder / "calibration_sites.json").write_text('{"kind": "sites", "µ": 1}\n', "utf-8")
    (folder / "odd.bin").write_bytes(b"\xff\0")
    (folder / "analysis").mkdir()
    (folder / "analysis" / "fits.jsonl").write_text('{"shot": 0}\n')
    return open_run(folder)


def exported(run: Run, kind: str, folder: Path, **options: Any) -> Path:
    path = folder / f"run{ENDINGS[kind]}"
    check_export(kind, path, **options)
    assert export_run(run, kind, path, **options) == []
    return path


def test_csv_is_a_table_with_a_line_of_names_and_a_table_of_units(run: Run, tmp_path: Path) -> None:
    path = exported(run, "csv", tmp_path)
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    with path.with_name("run.units.csv").open(encoding="utf-8", newline="") as file:
        about = {row["column"]: row for row in csv.DictReader(file)}
    assert len(rows) == len(run.shots) == 4
    assert list(rows[0]) == list(about)
    assert about["shot.2.rearrange.window"]["units"] == "s"
    for shot, row in zip(run.shots, rows, strict=True):
        with h5py.File(run.path / row["file"]) as file:
            entry: Any = file["entry"]
            assert int(row["shot"]) == entry.attrs["shot"] == shot.index
            assert float(row["filling_fraction"]) == entry.attrs["filling_fraction"]
            assert row["success"] == ("true" if entry.attrs["success"] else "false")
            assert float(row[ADDRESSES[1]]) == entry["parameters"][ADDRESSES[1]][()]


def test_csv_has_nothing_where_nothing_is_known(tmp_path: Path) -> None:
    with exported(
        write(tmp_path, make_shot(filling_fraction=math.nan, readings={"a,b\n": 'say "µ"'})), "csv", tmp_path
    ).open(encoding="utf-8", newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["filling_fraction"] == ""
    assert row["reading.a,b"] == 'say "µ"'


def test_readings_have_the_units_that_their_devices_name(tmp_path: Path) -> None:
    devices = {"laser": {"units": {"power": "W", "mode": 3}}, "odd": {"units": "W"}, "older": None}
    shot = make_shot(readings={"laser.power": 0.1, "laser.current_a": 1.0, "odd.x": 2.0})
    units = write(tmp_path, shot, devices=devices).to_dataframe().attrs["units"]
    assert [units[f"reading.{name}"] for name in ("laser.power", "laser.current_a", "odd.x")] == [
        "W",
        "A",
        "",
    ]


@pytest.mark.needs("pyarrow")
def test_parquet_reads_back_with_its_units(run: Run, tmp_path: Path) -> None:
    from pyarrow import parquet

    path = exported(run, "parquet", tmp_path)
    assert pd.read_parquet(path).equals(run.to_dataframe())
    schema = parquet.read_schema(path)
    assert schema.field("shot.2.rearrange.window").metadata[b"units"] == b"s"
    assert all(field.metadata[b"description"] for field in schema)
    assert json.loads(schema.metadata[b"labseq"])["name"] == run.name


def test_netcdf_reads_back_as_it_was(run: Run, tmp_path: Path) -> None:
    with xarray.open_dataset(exported(run, "netcdf", tmp_path), engine="h5netcdf") as data:
        expected = run.to_xarray()
        assert dict(data.sizes) == dict(expected.sizes)
        np.testing.assert_array_equal(data["occupancy"].values, expected["occupancy"].values)
        np.testing.assert_array_equal(data["filling_fraction"].values, expected["filling_fraction"].values)
        assert data["status"].values.tolist() == expected["status"].values.tolist()
        assert data[ADDRESSES[1]].attrs["units"] == "s"
        assert data.attrs["name"] == run.name


def test_names_that_netcdf_does_not_take_are_changed(tmp_path: Path) -> None:
    with xarray.open_dataset(
        exported(write(tmp_path, make_shot(readings={"laser/780": 1.5})), "netcdf", tmp_path)
    ) as data:
        assert data["reading.laser_780"].values.tolist() == [1.5]


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_without_shots_is_exported(kind: str, tmp_path: Path) -> None:
    run = open_run(RunWriter.create(tmp_path, make_run()).run_dir)
    assert exported(run, kind, tmp_path).stat().st_size


def everything(group: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    group.visititems(lambda name, node: found.update({name: node} if isinstance(node, h5py.Dataset) else {}))
    return found


def values_in(dataset: Any) -> str:
    """All values, nan like nan."""
    return repr((dataset.dtype, np.asarray(dataset).tolist()))


OF_SCALES = {"CLASS", "NAME", "REFERENCE_LIST", "DIMENSION_LIST"}


def test_xarray_takes_the_names_of_the_axes_from_an_archive(run: Run, tmp_path: Path) -> None:
    path = exported(run, "archive", tmp_path, frames=True)

    def sizes(group: str) -> dict[str, dict[str, int]]:
        with xarray.open_dataset(path, group=group, engine="h5netcdf") as data:
            return {
                str(name): {str(axis): n for axis, n in array.sizes.items()} for name, array in data.items()
            }

    record = run.shots[0].record()
    rows, cols = record.images[0].occupancy.shape
    image = {"image": len(record.images)}
    found = sizes("shots/shot_000000/detection")
    assert found["occupancy"] == found["confidence"] == image | {"row": rows, "col": cols}
    assert found["t_s"] == image
    assert {*sizes("shots/shot_000001/target")["fill"]} == {"row", "col"}
    assert {*sizes("shots/shot_000000/camera/camera")["frames"]} == {"frame", "y", "x"}
    assert {*sizes("shots/shot_000000/images_view")["frames"]} == {"frame", "y", "x"}
    assert {*sizes("shots/shot_000000/rearrangement")["predicted"]} == {"cycle", "row", "col"}
    assert sizes("table")["filling_fraction"] == {"shot": len(run.shots)}


@pytest.mark.parametrize("frames", [False, True])
def test_an_archive_holds_what_the_files_hold(run: Run, tmp_path: Path, frames: bool) -> None:
    with h5py.File(exported(run, "archive", tmp_path, frames=frames)) as archive:
        assert list(archive["shots"]) == [f"shot_{index:06d}" for index in range(4)]  # pyright: ignore[reportArgumentType]
        for shot in run.shots:
            copy: Any = archive["shots"][shot.file.stem]  # pyright: ignore[reportIndexIssue]
            with h5py.File(shot.file) as file:
                entry: Any = file["entry"]
                expected, found = everything(entry), everything(copy)
                left_out = set[str]() if frames else {"camera/camera/frames"}
                scales = {name for name in found if name not in expected}
                assert {*found} - scales == {*expected} - left_out
                assert all(found[name].is_scale for name in scales)
                for name in {*found} - scales:
                    assert values_in(found[name]) == values_in(expected[name]), name
                    assert {*found[name].attrs} - OF_SCALES == {*expected[name].attrs}, name
                assert copy.attrs["shot"] == entry.attrs["shot"]
                if frames:
                    np.testing.assert_array_equal(copy["images_view/frames"], entry["images_view/frames"])
                else:
                    assert "images_view" not in copy
                    assert copy.attrs["default"] == b"detection"


def test_an_archive_needs_nothing_else(run: Run, tmp_path: Path) -> None:
    """It stands alone: no links to other files, no virtual datasets, no filters but those of every HDF5."""
    path = exported(run, "archive", tmp_path, frames=True)
    with h5py.File(path) as archive:
        for name, dataset in everything(archive).items():
            assert not dataset.is_virtual, name
            assert not dataset.external, name
            assert dataset.compression in (None, "gzip"), name
            assert dataset.attrs["description"], name
            assert "units" in dataset.attrs, name

        def check(name: str) -> None:
            assert not isinstance(archive.get(name, getlink=True), h5py.ExternalLink)

        archive.visit(check)
    assert path.read_bytes()[8] == 0  # superblock version 0: any HDF5 from 1.8 on


def test_an_archive_holds_the_files_of_the_run(run: Run, tmp_path: Path) -> None:
    with h5py.File(exported(run, "archive", tmp_path)) as archive:
        files: Any = archive["run"]
        assert json.loads(files["run.json"][()])["name"] == run.name
        assert files["sequence.yaml"][()] == (run.path / "sequence.yaml").read_bytes()
        assert files["calibration_sites.json"][()].decode() == '{"kind": "sites", "µ": 1}\n'
        assert files["odd.bin"][()].tobytes() == b"\xff\0"
        assert files["analysis/fits.jsonl"][()] == b'{"shot": 0}\n'
        assert archive.attrs["format"] == b"labseq-archive"


def test_what_is_the_same_in_all_shots_stands_in_an_archive_once(run: Run, tmp_path: Path) -> None:
    with h5py.File(exported(run, "archive", tmp_path)) as archive:
        first, last = (archive[f"shots/shot_{i:06d}/run"] for i in (0, 3))
        assert first == last


def test_large_arrays_of_an_archive_are_compressed(tmp_path: Path) -> None:
    large = write(tmp_path / "data", make_shot(frame_shape=(32, 32)))
    with h5py.File(exported(large, "archive", tmp_path, frames=True)) as archive:
        frames = everything(archive)["shots/shot_000000/camera/camera/frames"]
        assert (frames.compression, frames.chunks) == ("gzip", (1, 32, 32))


def test_an_archive_keeps_what_differs_after_a_resume(tmp_path: Path) -> None:
    run_dir = (writer := RunWriter.create(tmp_path, make_run())).run_dir
    writer.write_shot(make_shot(0))
    later = RunWriter.reopen(run_dir, make_run(provenance={"labseq": "later"}), n_written=1)
    later.write_shot(make_shot(1))
    with h5py.File(exported(open_run(run_dir), "archive", tmp_path)) as archive:
        texts: list[Any] = [archive[f"shots/shot_{i:06d}/run/provenance"] for i in (0, 1)]
        assert [json.loads(text[()])["labseq"] for text in texts] == ["0.1.0", "later"]


def test_damaged_shots_are_left_out_of_an_archive_and_told(tmp_path: Path) -> None:
    writer = RunWriter.create(tmp_path, make_run())
    paths = [writer.run_dir / writer.write_shot(make_shot(index)).file for index in range(3)]
    writer.write_shot(make_shot(3, status="failed"))
    paths[0].unlink()
    text = make_run().sequence_text.encode()
    whole = paths[1].read_bytes()
    paths[1].write_bytes(whole.replace(text, text.swapcase()))  # only the checksum shows it
    assert paths[1].read_bytes() != whole
    left_out = export_run(open_run(writer.run_dir), "archive", tmp_path / "a.h5")
    assert [line.partition(": ")[0] for line in left_out] == [str(path) for path in paths[:2]]
    with h5py.File(tmp_path / "a.h5") as archive:
        assert list(archive["shots"]) == ["shot_000002", "shot_000003.attempt_0"]  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("kind", "name", "options", "message"),
    [
        ("xls", "a.xls", {}, "--to: a run cannot be exported as 'xls'; expected .*archive"),
        (
            "csv",
            "a.txt",
            {},
            r"a\.txt: this is not the name of a csv file; expected a file that ends in \.csv",
        ),
        (
            "csv",
            "there.csv",
            {},
            "this file already exists; choose another name, or replace it with --force",
        ),
        ("csv", "x" * 300 + ".csv", {}, "not the name of a file: File name too long"),
        ("netcdf", "a.nc", {"frames": True}, "--frames: a netcdf file holds no frames; use --to archive"),
        ("archive", "folder.h5", {"replace": True}, "folder.h5: this is a folder"),
    ],
)
def test_what_cannot_be_exported_is_told_before(
    tmp_path: Path, kind: str, name: str, options: dict[str, Any], message: str
) -> None:
    (tmp_path / "there.csv").write_text("old")
    (tmp_path / "folder.h5").mkdir()
    with pytest.raises(ConfigError, match=message):
        check_export(kind, tmp_path / name, **options)


@pytest.mark.parametrize("kind", KINDS)
def test_an_older_file_is_replaced_whole_or_not_at_all(
    kind: str, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"a{ENDINGS[kind]}"
    path.write_bytes(b"old")
    check_export(kind, path, replace=True)
    with monkeypatch.context() as patch:
        patch.setattr("labseq.files.os.fsync", full)
        with pytest.raises(ConfigError, match=r"it cannot be written: No space left on device"):
            export_run(run, kind, path)
    assert path.read_bytes() == b"old"
    assert not list(tmp_path.glob("*.part"))
    export_run(run, kind, path)
    assert path.stat().st_size > 3


def full(_: int) -> None:
    raise OSError(28, "No space left on device")
