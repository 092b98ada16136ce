"""Reads a shot's HDF5 file according to the schema."""

from __future__ import annotations

import contextlib
from collections.abc import Generator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, cast

import h5py
import numpy as np
from numpy.typing import NDArray

from labseq.errors import RecordingError
from labseq.messages import error_text
from labseq.model import Frame, ImageRecord, ShotRecord, StageTiming, StepTiming, TargetPattern
from labseq.model.records import LineEdge
from labseq.recording import schema
from labseq.recording.check_hdf5 import check_file
from labseq.recording.read_hdf5 import (
    load_filter,
    read_attribute,
    read_fields,
    read_texts,
    read_values,
)
from labseq.recording.run_file import check_version, regions_of
from labseq.text_files import something_else


@dataclass(frozen=True, slots=True, eq=False)
class ShotContent:
    """A shot's file without its frames.

    Attributes:
        record: The shot's record. Its images have no frames.
        run: Values that all shots of the run share: attribute of :class:`RunRecord` -> value.
        target: The target of the run.
    """

    record: ShotRecord
    run: dict[str, Any]
    target: TargetPattern

    @property
    def run_id(self) -> str:
        """The run's folder, relative to the data root to which it was written."""
        return self.run["run_id"]


def read_content(path: Path) -> ShotContent:
    """Read a shot's file without its frames.

    Raises:
        RecordingError: The file is missing, damaged, or of another format.
    """
    with opened(path) as entry:
        return content_of(entry)


def content_of(entry: Any) -> ShotContent:
    """Read a shot's file without its frames, from a group that :func:`opened` gave."""
    run = read_fields(entry["run"], schema.RUN) | read_texts(entry["run"], schema.RUN_TEXTS)
    if missing := [text.name for text in schema.RUN_TEXTS if text.attribute not in run]:
        raise ValueError(f"/entry/run/{missing[0]} is missing")
    fill, clear = (entry[f"target/{name}"][()].astype(np.bool_) for name in ("fill", "clear"))
    return ShotContent(
        _record(entry), run, TargetPattern(fill, clear, run["target.name"], regions_of(run["resolved"]))
    )


def read_occupancies(path: Path) -> tuple[list[tuple[int, int, str]], NDArray[np.uint8]]:
    """Read step, cycle and name of each image of a shot's file, and uint8 (n_images, n_rows, n_cols)."""
    with opened(path, "/entry/detection") as entry:
        rows = entry["detection/images"][()]
        names = zip(rows["step"].tolist(), rows["cycle"].tolist(), rows["name"], strict=True)
        return [(step, cycle, name.decode()) for step, cycle, name in names], entry["detection/occupancy"][()]


def read_frames(path: Path) -> dict[int, Frame]:
    """Read the frames of a shot's file: index of the image -> frame, in the order they were taken.

    Raises:
        RecordingError: As for :func:`read_content`, or the frames are compressed and the package to read
            them is missing, or two frames belong to the same image.
    """
    frames: dict[int, Frame] = {}
    for i, frame in iter_frames(path):
        if i in frames:
            raise RecordingError(path, f"has two frames of image {i}", "restore it from a backup")
        frames[i] = frame
    return {i: frames[i] for i in sorted(frames)}


def iter_frames(path: Path, only: int | None = None) -> Generator[tuple[int, Frame]]:
    """Read the frames one by one, with the index of the image of each, see :func:`read_frames`.

    Args:
        only: Index of the one image whose frame is read. None for all.
    """
    with opened(path, "/entry/camera") as entry:
        for group in entry["camera"].values() if "camera" in entry else ():
            stack = group["frames"]
            load_filter(path, stack)
            exposures = schema.EXPOSURES.arguments(Frame, group["exposures"][()])
            camera = str(read_attribute(group, "name"))
            for i, (index, exposure) in enumerate(zip(group["image"][()], exposures, strict=True)):
                if only not in (None, int(index)):
                    continue
                image = stack[i]
                image.flags.writeable = False  # as a camera's driver delivers it
                yield int(index), Frame(image, camera=camera, **exposure)


def with_frames(record: ShotRecord, frames: dict[int, Frame]) -> ShotRecord:
    """A copy of a record with the frames added to its images."""
    images = [replace(image, frame=frames.get(i)) for i, image in enumerate(record.images)]
    return replace(record, images=images)


@contextlib.contextmanager
def opened(path: Path, only: str = "") -> Generator[Any]:
    """Open a shot's file to read its group ``/entry``. An error in the body reports the file as damaged.

    Args:
        only: The one dataset or group that will be read. "" for any.

    Raises:
        RecordingError: The file is missing, damaged, or of another format.
    """
    # opening a named pipe would wait forever
    if other_kind := something_else(path):
        raise RecordingError(path, f"cannot be read: {other_kind}", "restore it from a backup")
    if not path.is_file():
        raise RecordingError(
            path, "is missing", "restore it from a backup, or delete its line from the index"
        )
    with damage_reported(path), open_finished(path) as file:
        if read_attribute(file, "format") != schema.FORMAT:
            raise RecordingError(path, "is not a shot's file of labseq")
        check_version(path, str(read_attribute(file, "format_version")), schema.FORMAT_VERSION)
        check_file(file, path, only)
        yield cast("Any", file["entry"])


def open_finished(path: Path) -> h5py.File:
    """Open a file that never changes again without a lock, because locks fail on network folders."""
    try:
        return h5py.File(path, "r", locking=False)
    except OSError as error:
        if "locking flag" not in str(error):
            raise
        return h5py.File(path, "r")  # this process has it open with a lock, and HDF5 allows no mixture


@contextlib.contextmanager
def damage_reported(path: Path) -> Generator[None]:
    """Report the file as damaged if anything in the body fails.

    Raises:
        RecordingError: Something failed.
    """
    try:
        yield
    except RecordingError:
        raise
    except Exception as error:  # from h5py, numpy, or unexpected content of a damaged file
        raise RecordingError(path, f"is damaged: {error_text(error)}", "restore it from a backup") from error


def _record(entry: Any) -> ShotRecord:
    values = read_fields(entry, schema.SHOT) | read_texts(entry, schema.SHOT_TEXTS)
    names = {field.name for field in fields(ShotRecord)}  # a newer minor version may have more
    cycles = entry["rearrangement"]
    events = entry.get("atom_events", {})
    timing = schema.TIMING.arguments(StageTiming, entry["timing"][()])
    steps = schema.STEPS.arguments(StepTiming, entry["steps"][()]) if "steps" in entry else []
    edges = schema.EDGES.arguments(LineEdge, entry["edges"][()]) if "edges" in entry else []
    return ShotRecord(
        **{name: value for name, value in values.items() if name in names},
        parameters=read_values(entry["parameters"]),
        images=_images(entry["detection"]),
        **_detector(entry["detection"]),
        cycles=schema.cycles_of(
            {name: cycles[name][()] for name in ("cycles", "batches", "moves", "paths") if name in cycles},
            cycles["predicted"][()],
        ),
        timing=[StageTiming(**stage) for stage in timing],
        steps=[StepTiming(**step) for step in steps],
        edges=[LineEdge(**edge) for edge in edges],
        atom_events={name: table[()] for name, table in events.items()},
    )


def _images(group: Any) -> list[ImageRecord]:
    occupancies: NDArray[np.bool_] = group["occupancy"][()].astype(np.bool_)
    rows = schema.IMAGES.arguments(ImageRecord, group["images"][()])
    signals = group["signal"][()] if "signal" in group else [None] * len(rows)
    return [
        ImageRecord(frame=None, occupancy=occupancy, confidence=confidence, signal=signal, **values)
        for occupancy, confidence, signal, values in zip(
            occupancies, group["confidence"][()], signals, rows, strict=True
        )
    ]


def _detector(group: Any) -> dict[str, Any]:
    """The values that the detector reported about itself, as arguments of the shot's record."""
    values: dict[str, Any] = {
        argument: group[name][()]
        for argument, name in (("thresholds", "threshold"), ("sites_px", "sites_px"))
        if name in group
    }
    return values | (
        {"signal_unit": read_attribute(group["threshold"], "units")} if "threshold" in group else {}
    )
