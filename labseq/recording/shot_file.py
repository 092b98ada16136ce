"""Writes and reads a shot's HDF5 file according to the schema."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Generator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, cast

import h5py
import numpy as np
from numpy.typing import NDArray

import labseq
from labseq.errors import RecordingError
from labseq.messages import error_text, format_error
from labseq.model import Frame, ImageRecord, RunRecord, ShotRecord, StageTiming, StepTiming, TargetPattern
from labseq.model.records import LineEdge
from labseq.recording import schema
from labseq.recording.hdf5 import (
    check_contents,
    describe,
    link_name,
    load_filter,
    read_attribute,
    read_fields,
    read_texts,
    read_values,
    set_attributes,
    write_array,
    write_fields,
    write_table,
    write_texts,
    write_values,
)
from labseq.recording.run_file import check_version, regions_of, sha256_of_text
from labseq.text_files import something_else

_AXES: Final = ("t_s", ".", ".")


class ShotEncoder:
    """Turns the shots of one run into the bytes of HDF5 files.

    The file is built in memory, so that a full disk cannot interrupt HDF5, and so that the hashed bytes
    are exactly the written ones.
    """

    def __init__(self, run: RunRecord, run_id: str) -> None:
        self._run = run
        self._run_id = run_id
        self._detector: tuple[Any, ...] = ()
        self._common = b""

    def encode(self, shot: ShotRecord) -> memoryview:
        """The bytes of the shot's file.

        Raises:
            RecordingError: The record contradicts itself, for example occupancies of different shapes.
        """
        try:
            arrays = [
                None if array is None else array.tobytes() for array in (shot.thresholds, shot.sites_px)
            ]
            if (detector := (*arrays, shot.signal_unit)) != self._detector:  # they rarely change in a run
                self._common, self._detector = _encode_common(self._run, self._run_id, shot), detector
            buffer = io.BytesIO(self._common)
            with h5py.File(buffer, "r+", libver=schema.LIBRARY_VERSIONS) as file:
                self._write_shot(file["entry"], shot)
        except Exception as error:  # a plugin's camera or step may put anything into the record
            where = f"shot {shot.shot_index} (attempt {shot.attempt})"
            problem = f"cannot be laid out as a file: {format_error(error)}"
            raise RecordingError(where, problem, "see the plugin that made it") from error
        # of the bytes, which are not copied: the buffer's own view would keep it from being closed
        return memoryview(buffer.getvalue())

    def _write_shot(self, entry: Any, shot: ShotRecord) -> None:
        kept = self._frames_to_keep(shot.images)
        set_attributes(entry, {"default": "images_view" if kept else "detection"})
        write_fields(entry, schema.SHOT, shot)
        write_texts(entry, schema.SHOT_TEXTS, shot)
        write_values(
            entry.create_group("parameters"), shot.parameters, self._run.units, schema.PARAMETER.description
        )
        if kept:
            self._write_frames(entry, shot.images, kept)
        _write_detection(entry["detection"], shot, self._run.target.shape)
        _write_cycles(entry.create_group("rearrangement"), shot, self._run.target.shape)
        write_table(entry, schema.STEPS, schema.STEPS.rows(shot.steps))
        if shot.edges:
            write_table(entry, schema.EDGES, schema.EDGES.rows(shot.edges))
        write_table(entry, schema.TIMING, schema.TIMING.rows(shot.timing))
        if shot.atom_events:
            events, names = entry.create_group("atom_events"), list[str]()
            for name, table in shot.atom_events.items():
                names.append(link_name(name, names))
                write_table(events, schema.ATOM_EVENTS, table, names[-1])

    def _frames_to_keep(self, images: Sequence[ImageRecord]) -> list[int]:
        """Indices of the images whose frames are recorded."""
        indices = range(len(images))
        recorded = {"all": indices, "last": indices[-1:], "none": range(0)}[self._run.record_frames]
        return [i for i in recorded if images[i].frame is not None]

    def _write_frames(self, entry: Any, images: Sequence[ImageRecord], kept: Sequence[int]) -> None:
        series: dict[tuple[str, tuple[int, ...]], list[int]] = {}  # frames of one size share a dataset
        for i in kept:
            frame = cast("Frame", images[i].frame)
            series.setdefault((frame.camera, frame.image.shape), []).append(i)
        cameras, names = entry.create_group("camera"), list[str]()
        for (camera, _), indices in series.items():
            names.append(link_name(camera, names))
            self._write_series(cameras.create_group(names[-1]), camera, images, indices)
        view = entry.create_group("images_view")
        set_attributes(view, {"NX_class": "NXdata", "signal": "frames", "axes": _AXES})
        for dataset in ("frames", "t_s"):
            view[dataset] = h5py.SoftLink(f"/entry/camera/{names[0]}/{dataset}")

    @staticmethod
    def _write_series(group: Any, camera: str, images: Sequence[ImageRecord], indices: Sequence[int]) -> None:
        frames = [cast("Frame", images[i].frame) for i in indices]
        shape = frames[0].image.shape
        options: dict[str, Any] = {"chunks": (1, *shape)} if all(shape) else {}
        stack = group.create_dataset("frames", (len(frames), *shape), np.uint16, **options)
        for i, frame in enumerate(frames):
            if options:  # a quarter less time than through HDF5's chunk cache
                stack.id.write_direct_chunk((i, 0, 0), frame.image)
            else:
                stack[i] = frame.image
        set_attributes(group, {"NX_class": "NXdetector", "name": camera})
        describe(stack, schema.ARRAYS["camera/<name>/frames"])
        set_attributes(stack, {"interpretation": "image", "long_name": f"{camera} (ADU)"})
        write_array(group, "camera/<name>/t_s", [images[i].t_start_s for i in indices])
        write_array(group, "camera/<name>/image", indices)
        write_table(group, schema.EXPOSURES, schema.EXPOSURES.rows(frames))


def _encode_common(run: RunRecord, run_id: str, shot: ShotRecord) -> bytes:
    """A file with what shots share, the detector's values among it; completing it takes half the time."""
    buffer = io.BytesIO()
    values = {field.name: getattr(run, field.name) for field in fields(run)}
    hashes = {f"{name}_sha256": sha256_of_text(values[f"{name}_text"]) for name in ("sequence", "profile")}
    with h5py.File(buffer, "w", libver=schema.LIBRARY_VERSIONS) as file:
        root = {"format": schema.FORMAT, "format_version": schema.FORMAT_VERSION}
        creator = f"labseq {labseq.__version__}"
        set_attributes(file, {**root, "NX_class": "NXroot", "default": "entry", "creator": creator})
        entry = file.create_group("entry")
        set_attributes(entry, {"NX_class": "NXentry"})
        common = SimpleNamespace(**values, **hashes, run_id=run_id)
        group = entry.create_group("run")
        write_fields(group, schema.RUN, common)
        write_texts(group, schema.RUN_TEXTS, common)
        target = entry.create_group("target")
        write_array(target, "target/fill", run.target.fill)
        write_array(target, "target/clear", run.target.clear)
        detection = entry.create_group("detection")
        if shot.thresholds is not None:
            write_array(detection, "detection/threshold", shot.thresholds, shot.signal_unit)
        if shot.sites_px is not None:
            write_array(detection, "detection/sites_px", shot.sites_px)
    return buffer.getvalue()


def _write_detection(group: Any, shot: ShotRecord, grid_shape: tuple[int, int]) -> None:
    nexus = {"NX_class": "NXdata", "signal": "occupancy", "auxiliary_signals": ["confidence"], "axes": _AXES}
    set_attributes(group, nexus)
    names = ["occupancy", "confidence"]
    if any(image.signal is not None for image in shot.images):
        names.append("signal")
    for name in names:
        values = [getattr(image, name) for image in shot.images]
        if name == "signal":  # nan for an image without
            values = [np.full(grid_shape, np.nan) if value is None else value for value in values]
        stack = np.array(values, schema.ARRAYS[f"detection/{name}"].dtype).reshape(len(values), *grid_shape)
        units = shot.signal_unit if name == "signal" else None
        set_attributes(write_array(group, f"detection/{name}", stack, units), {"interpretation": "image"})
    write_array(group, "detection/t_s", [image.t_start_s for image in shot.images])
    write_table(group, schema.IMAGES, schema.IMAGES.rows(shot.images))


def _write_cycles(group: Any, shot: ShotRecord, grid_shape: tuple[int, int]) -> None:
    cycles = shot.cycles
    paths = [schema.PATHS] if any(cycle.plan.has_paths for cycle in cycles) else []
    for table in (schema.MOVES, schema.BATCHES, *paths, schema.CYCLES):
        write_table(group, table, table.rows(cycles))
    predicted = np.array([cycle.report.predicted for cycle in cycles], np.uint8)
    write_array(group, "rearrangement/predicted", predicted.reshape(len(cycles), *grid_shape))


@dataclass(frozen=True, slots=True, eq=False)
class ShotContent:
    """A shot's file without its frames.

    Attributes:
        record: The shot's record; its images have no frames.
        run: Values that all shots of the run share: attribute of :class:`RunRecord` -> value.
        target: The target of the run.
    """

    record: ShotRecord
    run: dict[str, Any]
    target: TargetPattern

    @property
    def run_id(self) -> str:
        """The run's folder, relative to the data root that it was written to."""
        return self.run["run_id"]


def read_content(path: Path) -> ShotContent:
    """Read a shot's file without its frames.

    Raises:
        RecordingError: It is missing, damaged, or of another format.
    """
    with opened(path) as entry:
        return content_of(entry)


def content_of(entry: Any) -> ShotContent:
    """Read a shot's file, :func:`opened`, without its frames."""
    run = read_fields(entry["run"], schema.RUN) | read_texts(entry["run"], schema.RUN_TEXTS)
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
        RecordingError: As for :func:`read_content`; or the frames are compressed
            and the package for it is missing; or two of them are of the same image.
    """
    frames: dict[int, Frame] = {}
    for i, frame in iter_frames(path):
        if i in frames:
            raise RecordingError(path, f"has two frames of image {i}", "restore it from a backup")
        frames[i] = frame
    return {i: frames[i] for i in sorted(frames)}


def iter_frames(path: Path, only: int | None = None) -> Generator[tuple[int, Frame]]:
    """Read the frames one by one, with the index of the image of each; see :func:`read_frames`.

    Args:
        path: The file.
        only: Index of the one image whose frame is read; None for all.
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
    """Open a shot's file to read its group ``/entry``; an error in the body reports the file as damaged.

    Args:
        path: The file.
        only: The one dataset or group that will be read; "" for any.

    Raises:
        RecordingError: It is missing, damaged, or of another format.
    """
    # opening a named pipe would wait for ever
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
        check_contents(file, path.stat().st_size, only)
        yield cast("Any", file["entry"])


def open_finished(path: Path) -> h5py.File:
    """Open a file that never changes again without a lock, as locks fail on network folders."""
    try:
        return h5py.File(path, "r", locking=False)
    except OSError as error:
        if "locking flag" not in str(error):
            raise
        return h5py.File(path, "r")  # this process has it open with a lock: HDF5 allows no mixture


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
    except Exception as error:  # of h5py, numpy, and whatever a damaged file has instead of the values
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
    """The values that a detector reported about itself, as arguments of the shot's record."""
    values: dict[str, Any] = {
        argument: group[name][()]
        for argument, name in (("thresholds", "threshold"), ("sites_px", "sites_px"))
        if name in group
    }
    return values | (
        {"signal_unit": read_attribute(group["threshold"], "units")} if "threshold" in group else {}
    )
