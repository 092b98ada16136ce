"""What stands in a shot's file, seen with h5py alone."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from labseq.errors import RecordingError
from labseq.model import Frame
from labseq.recording import schema
from labseq.recording.shot_encoder import ShotEncoder
from labseq.recording.shot_file import read_content

from .records import make_run, make_shot


@contextmanager
def opened(data: memoryview | bytes) -> Generator[Any]:
    with h5py.File(io.BytesIO(data), "r") as file:
        yield file


def default_plot(file: Any) -> Any:
    """Follow the chain of NeXus defaults, as silx, H5Web and NeXpy do."""
    node = file
    while "signal" not in node.attrs:
        node = node[node.attrs["default"].decode()]
    assert node.attrs["NX_class"] == b"NXdata"
    return node


def test_viewers_open_the_frames() -> None:
    shot = make_shot()
    with opened(ShotEncoder(make_run(), "day/run").encode(shot)) as file:
        view = default_plot(file)
        assert view.name == "/entry/images_view"
        signal = view[view.attrs["signal"].decode()]
        assert signal.shape == (3, 6, 8)
        assert list(view.attrs["axes"]) == [b"t_s", b".", b"."]
        assert view["t_s"].shape == (3,)
        assert signal.attrs["interpretation"] == b"image"
        np.testing.assert_array_equal(signal[1], shot.images[1].frame.image)  # pyright: ignore[reportOptionalMemberAccess]


def test_the_tables_hold_every_move() -> None:
    shot = make_shot()
    with opened(ShotEncoder(make_run(), "day/run").encode(shot)) as file:
        moves = file["entry/rearrangement/moves"][()]
        cycles = file["entry/rearrangement/cycles"][()]
    assert list(moves["cycle"]) == [0] * 6 + [2]
    assert list(moves["batch"]) == [0, 0, 1, 2, 2, 2, 0]
    assert list(moves["played"]) == [True] * 3 + [False] * 4
    sites = np.stack([moves[name] for name in ("from_row", "from_col", "to_row", "to_col")], axis=1)
    np.testing.assert_array_equal(sites[:6], shot.cycles[0].plan.moves)
    assert list(cycles["n_batches"]) == [3, 0, 1]
    assert list(cycles["n_batches_played"]) == [2, 0, 0]
    assert cycles["planned_duration_s"][0] == shot.cycles[0].report.duration_s


def test_stages_over_budget_are_marked() -> None:
    with opened(ShotEncoder(make_run(), "day/run").encode(make_shot())) as file:
        timing = file["entry/timing"][()]
        assert [stage.decode() for stage in timing["stage"]] == ["load", "plan", "plan", "prüfen"]
        assert list(timing["over_budget"]) == [False, True, False, False]


def test_atom_events_are_kept_as_tables(tmp_path: Path) -> None:
    flights = np.array([(0.5, b"kept", 2e-9)], [("held_s", "f8"), ("fate", "S8"), ("offset_m", "f4")])
    shot = make_shot()
    shot.atom_events = {"flights": flights, "a/b": flights[:0]}
    path = tmp_path / "shot.h5"
    path.write_bytes(ShotEncoder(make_run(), "day/run").encode(shot))
    with h5py.File(path) as file:
        units: Any = file["entry/atom_events/flights"].attrs["units"]
        assert list(units) == [b"s", b"", b"m"]
    atom_events = read_content(path).record.atom_events
    assert list(atom_events) == ["a_b", "flights"]
    assert atom_events["flights"].tobytes() == flights.tobytes()
    assert atom_events["a_b"].dtype == flights.dtype


def test_any_hdf5_from_1_8_on_can_read_it() -> None:
    data = bytes(ShotEncoder(make_run(), "day/run").encode(make_shot()))
    assert data[:8] == b"\x89HDF\r\n\x1a\n"
    assert data[8] == 0  # superblock version 0: no flag that a killed writer could leave set


def test_frames_of_several_cameras_and_sizes_have_groups_of_their_own() -> None:
    shot = make_shot(n_images=4)
    sizes_and_names = [((6, 8), "a/b"), ((3, 2), "a/b"), ((6, 8), "a/b"), ((6, 8), "日")]
    frames = [
        Frame(np.full(size, i, np.uint16), 0.1, 0.0, name) for i, (size, name) in enumerate(sizes_and_names)
    ]
    shot.images = [
        dataclasses.replace(image, frame=frame) for image, frame in zip(shot.images, frames, strict=True)
    ]
    with opened(ShotEncoder(make_run(), "day/run").encode(shot)) as file:
        cameras = file["entry/camera"]
        assert {name: list(group["image"]) for name, group in cameras.items()} == {
            "a_b": [0, 2],
            "a_b_2": [1],
            "日": [3],
        }
        assert cameras["a_b_2"].attrs["name"] == b"a/b"
        assert default_plot(file)["frames"].shape == (2, 6, 8)


def test_a_file_of_an_older_minor_format_reads_with_defaults(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = tuple(field for field in schema.SHOT if field.name != "n_missing_atoms")
    monkeypatch.setattr(schema, "SHOT", shown)
    path = tmp_path / "shot.h5"
    path.write_bytes(ShotEncoder(make_run(), "day/run").encode(make_shot()))
    monkeypatch.undo()
    assert read_content(path).record.n_missing_atoms == 0


def test_a_record_that_a_plugin_has_spoilt_is_explained() -> None:
    shot = make_shot(5)
    frame = shot.images[0].frame
    assert frame is not None
    object.__setattr__(frame, "camera", None)
    with pytest.raises(RecordingError, match=r"AttributeError: .*; see the plugin that made it"):
        ShotEncoder(make_run(), "day/run").encode(shot)
