"""Files that were made to do harm: the reader, the export and the doctor refuse them, and name the file."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from labseq.data.columns import columns_of
from labseq.data.export import export_run
from labseq.data.follower import Follower
from labseq.data.reader import open_run
from labseq.errors import RecordingError
from labseq.recording.doctor import examine
from labseq.recording.shot_file import read_content, read_frames, read_occupancies
from labseq.watchdog import WATCHDOG_LOG, watchdog_lines

from .damages import N_SHOTS, edit_index

on_posix = pytest.mark.skipif(os.name != "posix", reason="pipes and devices")
SECRET = b"root:x:0:0"


def huge(file: Any, secret: Path) -> None:
    del file["entry/detection/occupancy"]
    file["entry/detection"].create_dataset("occupancy", (2**40, 4, 4), np.uint8, chunks=(1, 4, 4))


def compressed_huge(file: Any, secret: Path) -> None:
    del file["entry/camera/camera/frames"]
    options: Any = {"chunks": (1, 1024, 1024), "compression": "gzip"}
    file["entry/camera/camera"].create_dataset("frames", (2**20, 1024, 1024), np.uint16, **options)


def external_link(file: Any, secret: Path) -> None:
    del file["entry/target"]
    file["entry/target"] = h5py.ExternalLink(str(secret), "/entry/target")


def soft_link(file: Any, secret: Path) -> None:
    del file["entry/target"]
    file["entry/target"] = h5py.SoftLink("/entry")


def external_storage(file: Any, secret: Path) -> None:
    del file["entry/target/fill"]
    storage: Any = [(str(secret), 0, 10)]
    file["entry/target"].create_dataset("fill", (10,), np.uint8, external=storage)


def frames_elsewhere(file: Any, secret: Path) -> None:
    shape = file["entry/camera/camera/frames"].shape
    del file["entry/camera/camera/frames"]
    storage: Any = [(str(secret), 0, 2 * math.prod(shape))]
    file["entry/camera/camera"].create_dataset("frames", shape, np.uint16, external=storage)


def virtual_dataset(file: Any, secret: Path) -> None:
    layout: Any = h5py.VirtualLayout((4, 4), np.uint8)
    layout[:] = h5py.VirtualSource(str(secret), "x", (4, 4))
    del file["entry/target/fill"]
    file["entry/target"].create_virtual_dataset("fill", layout)


def filtered(file: Any, secret: Path) -> None:
    del file["entry/target/fill"]
    plist: Any = h5py.h5p.create(h5py.h5p.DATASET_CREATE)  # pyright: ignore[reportAttributeAccessIssue]
    plist.set_chunk((4, 4))
    plist.set_filter(512, h5py.h5z.FLAG_OPTIONAL, (1,))  # pyright: ignore[reportAttributeAccessIssue]
    space = h5py.h5s.create_simple((4, 4))  # pyright: ignore[reportAttributeAccessIssue]
    kind = h5py.h5t.NATIVE_UINT8  # pyright: ignore[reportAttributeAccessIssue]
    h5py.h5d.create(file["entry/target"].id, b"fill", kind, space, plist)  # pyright: ignore[reportAttributeAccessIssue]


def cycle(file: Any, secret: Path) -> None:
    file["entry/target/entry"] = file["entry"]


def wrong_kind(file: Any, secret: Path) -> None:
    file["entry"].attrs["status"] = 5


def text_of_any_length(file: Any, secret: Path) -> None:
    del file["entry/readings"]
    file["entry/readings"] = "{}"


def attribute_of_any_length(file: Any, secret: Path) -> None:
    file["entry"].attrs["status"] = "complete"


def more_batches_than_planned(file: Any, secret: Path) -> None:
    cycles = file["entry/rearrangement/cycles"][()]
    cycles["n_batches_played"] = 2**25
    file["entry/rearrangement/cycles"][...] = cycles


def other_json(file: Any, secret: Path) -> None:
    del file["entry/run/provenance"]
    file["entry/run"].create_dataset("provenance", data=np.bytes_(b"[1]"))


def no_settings(file: Any, secret: Path) -> None:
    del file["entry/run/overrides"]


def many_attributes(file: Any, secret: Path) -> None:
    for number in range(200):
        file["entry/detection/occupancy"].attrs[f"a{number}"] = number


def resized(path: str, change: Callable[[Any], Any]) -> Callable[[Any, Path], None]:
    """An array or table in place of the one at a path."""

    def plant(file: Any, secret: Path) -> None:
        data, attributes = file[path][()], dict(file[path].attrs)
        del file[path]
        file.create_dataset(path, data=change(data)).attrs.update(attributes)

    return plant


def retyped(table: Any) -> Any:
    columns = [(name, "f8" if name == "step" else table.dtype[name]) for name in table.dtype.names]
    return table.astype(columns)


def deep_json(file: Any, secret: Path) -> None:
    del file["entry/readings"]
    file["entry"].create_dataset("readings", data=np.bytes_(b"[" * 500 + b"]" * 500))


def many_parts(file: Any, secret: Path) -> None:
    del file["entry/readings"]
    file["entry"].create_dataset("readings", data=np.bytes_(b"[" + b"[]," * 500_000 + b"1]"))


@pytest.mark.parametrize(
    ("plant", "what"),
    [
        (huge, "/entry/detection/occupancy declares 17592186044416 bytes, but the file has "),
        (compressed_huge, "/entry/camera/camera/frames declares 2199023255552 bytes, but the file has "),
        (external_link, "/entry/target is a link that leads elsewhere"),
        (soft_link, "/entry/target is a link that leads elsewhere"),
        (external_storage, "/entry/target/fill keeps its data in another file"),
        (frames_elsewhere, "/entry/camera/camera/frames keeps its data in another file"),
        (virtual_dataset, "/entry/target/fill keeps its data in another file"),
        (filtered, "/entry/target/fill has the filter 512, which labseq does not use"),
        (cycle, "is in the file twice"),
        (wrong_kind, "'status' is int; expected text"),
        (text_of_any_length, "/entry/readings is a text of variable length, which labseq does not use"),
        (attribute_of_any_length, "the attribute 'status' is a text of variable length"),
        (more_batches_than_planned, "33554432 of 3 batches were played"),
        (other_json, "'provenance' is list; expected dict"),
        (no_settings, "/entry/run/overrides is missing"),
        (many_attributes, "/entry/detection/occupancy has more than 100 attributes"),
        (resized("entry/detection/confidence", lambda a: a[:1]), " along 'image'; expected "),
        (
            resized("entry/target/clear", lambda a: a[0]),
            "/entry/target/clear has the shape (5,); expected (row",
        ),
        (resized("entry/detection/images", retyped), "'step' of /entry/detection/images is of another type"),
        (deep_json, "it is nested too deep"),
        (many_parts, "it has more than 500,000 lists and objects"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_shot_file_that_leads_elsewhere_is_refused_by_reader_doctor_and_export(
    run_dir: Path, tmp_path: Path, plant: Callable[[Any, Path], None], what: str
) -> None:
    secret, path = tmp_path / "secret", run_dir / "shots" / "shot_000001.h5"
    secret.write_bytes(SECRET)
    seen, frames = read_occupancies(path)[1], images(path)
    with h5py.File(path, "r+", libver=("earliest", "v110")) as file:
        plant(file, secret)
    with pytest.raises(RecordingError) as caught:
        read_content(path)
    assert str(caught.value).startswith(f"{path}: is damaged: ")
    assert str(caught.value).endswith("; restore it from a backup")
    assert what in str(caught.value)
    with suppress(RecordingError):  # unless what it reads is as it was
        np.testing.assert_array_equal(read_occupancies(path)[1], seen)
    with suppress(RecordingError):
        np.testing.assert_equal(images(path), frames)
    believe(run_dir, path)  # as if labseq had written it
    left_out = export_run(open_run(run_dir), "archive", tmp_path / "run.h5", frames=True)
    assert [what in reason for reason in left_out] == [True]
    assert SECRET not in (tmp_path / "run.h5").read_bytes()
    edit_index(run_dir, lambda lines: [lines[0], *lines[2:]])
    (finding,) = examine(run_dir).findings
    assert finding.what.startswith("no line in the index, and is damaged: ")
    assert (run_dir / "quarantine" / path.name).exists()


def test_the_export_reads_no_attribute_that_labseq_does_not_write(run_dir: Path, tmp_path: Path) -> None:
    path = run_dir / "shots" / "shot_000001.h5"
    with h5py.File(path, "r+", libver=("earliest", "v110")) as file:
        file["entry/detection/occupancy"].attrs["mine"] = ["{}"]
    believe(run_dir, path)
    (left_out,) = export_run(open_run(run_dir), "archive", tmp_path / "run.h5", frames=True)
    assert left_out.startswith(f"{path}: is damaged: the attribute 'mine' ")


def images(path: Path) -> dict[int, Any]:
    return {index: frame.image for index, frame in read_frames(path).items()}


def believe(run_dir: Path, path: Path) -> None:
    """Give the file's checksum and size to its line in the index."""
    import hashlib

    def change(lines: list[bytes]) -> list[bytes]:
        row = {**json.loads(lines[1]), "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
        return [lines[0], json.dumps(row | {"bytes": path.stat().st_size}).encode(), *lines[2:]]

    edit_index(run_dir, change)


@pytest.mark.parametrize(
    "changes",
    [
        {"file": "../../../etc/passwd"},
        {"file": "/etc/passwd"},
        {"file": "shots/../../x/shot_000001.h5"},
        {"file": "shots/\0.h5"},
        {"shot": 10**4000},
        {"n_images": "five"},
        {"images": {"cycle": [1e999]}},
        {"readings": [[[]]]},
        {"filling_fraction": {}},
    ],
    ids=str,
)
def test_a_line_of_the_index_that_leads_elsewhere_is_no_shot(run_dir: Path, changes: dict[str, Any]) -> None:
    edit_index(run_dir, lambda lines: [*lines[:4], json.dumps({**json.loads(lines[4]), **changes}).encode()])
    run = open_run(run_dir)
    assert (len(run.shots), run.n_damaged_lines) == (N_SHOTS - 1, 1)
    assert "a line of the index describes no shot" in {
        one.what for one in examine(run_dir, dry_run=True).findings
    }


def pipe(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


@on_posix
@pytest.mark.parametrize(
    "name",
    [
        *("run.json", "index.jsonl", "STATE", "events.jsonl", "skipped.jsonl"),
        *("shots/shot_000001.h5", "analysis/fits.jsonl"),
    ],
)
@pytest.mark.parametrize("make", [pipe, device])
def test_pipes_and_devices_are_refused_without_waiting(
    run_dir: Path, name: str, make: Callable[[Path], None]
) -> None:
    path = run_dir / name
    path.parent.mkdir(exist_ok=True)
    path.unlink(missing_ok=True)
    make(path)
    make(run_dir / WATCHDOG_LOG)
    assert watchdog_lines(run_dir) == []
    findings = examine(run_dir, dry_run=True).findings
    assert any(one.where in (path, run_dir) for one in findings), findings
    try:
        run = open_run(run_dir)
        for shot in run.shots:
            _ = shot.occupancies
        _ = run.events, columns_of(run), Follower(run_dir).shots()
    except RecordingError as error:
        assert str(run_dir) in str(error)
        what = "run.json is gone" if name == "run.json" else "this is not an ordinary file"
        assert what in str(error)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"n_shots": -1}, "it has no valid 'n_shots'"),
        ({"n_shots": 10**30}, "it has no valid 'n_shots'"),
        ({"overrides": [1]}, "it has no valid 'overrides'"),
        ({"scan": "x"}, "it has no valid 'scan'"),
        ({"format": []}, "is damaged, or was not written by labseq"),
    ],
)
def test_wrong_types_in_run_json_are_damage(run_dir: Path, changes: dict[str, Any], what: str) -> None:
    path = run_dir / "run.json"
    path.write_text(json.dumps({**json.loads(path.read_text("utf-8")), **changes}))
    with pytest.raises(RecordingError, match=what):
        open_run(run_dir)
    assert what in str([one.what for one in examine(run_dir).findings])


def test_a_huge_text_and_many_damaged_lines_take_seconds_and_little_memory(run_dir: Path) -> None:
    (run_dir / "events.jsonl").write_bytes(b"x\n" * 20_000)
    (finding,) = examine(run_dir).findings
    assert "20000 lines" in finding.what
    with (run_dir / "events.jsonl").open("wb") as file:
        file.truncate(2**40)  # a file of zeros that takes no room on the disk
    (finding,) = examine(run_dir).findings
    assert "16 MiB" in finding.what
    with (run_dir / "run.json").open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(RecordingError, match="is larger than 16 MiB; restore it from a backup"):
        open_run(run_dir)


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights")
def test_the_export_copies_no_file_that_a_link_leads_to(run_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(SECRET)
    (run_dir / "notes.txt").symlink_to(tmp_path / "secret")
    left_out = export_run(open_run(run_dir), "archive", tmp_path / "run.h5")
    assert [line.partition(": ")[0] for line in left_out] == [str(run_dir / "notes.txt")]
    assert SECRET not in (tmp_path / "run.h5").read_bytes()
