"""Writes a shot's HDF5 file according to the schema."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import fields
from types import SimpleNamespace
from typing import Any, Final, cast

import h5py
import numpy as np

import labseq
from labseq.errors import RecordingError
from labseq.messages import format_error
from labseq.model import Frame, ImageRecord, RunRecord, ShotRecord
from labseq.recording import schema
from labseq.recording.run_file import sha256_of_text
from labseq.recording.write_hdf5 import (
    describe,
    link_name,
    set_attributes,
    write_array,
    write_fields,
    write_table,
    write_texts,
    write_values,
)

_AXES: Final = ("t_s", ".", ".")


class ShotEncoder:
    """Encodes the shots of one run as HDF5 files.

    A file is built in memory, so that a full disk cannot interrupt HDF5, and so that the hashed bytes
    are exactly the written bytes.
    """

    def __init__(self, run: RunRecord, run_id: str) -> None:
        self._run = run
        self._run_id = run_id
        self._detector: tuple[Any, ...] = ()
        self._common = b""

    def encode(self, shot: ShotRecord) -> memoryview:
        """Encode a shot as the bytes of its file.

        Raises:
            RecordingError: The record contradicts itself, for example with occupancies of different shapes.
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
            problem = f"cannot be written as a file: {format_error(error)}"
            raise RecordingError(where, problem, "see the plugin that made it") from error
        # of the bytes, which are not copied, because the buffer's own view would keep it from being closed
        return memoryview(buffer.getvalue())

    def _write_shot(self, entry: Any, shot: ShotRecord) -> None:
        kept = self._frames_to_keep(shot.images)
        set_attributes(entry, {"default": "images_view" if kept else "detection"})
        write_fields(entry, schema.SHOT, shot)
        if shot.target is not None and shot.target is not self._run.target:
            for part, sites in (("fill", shot.target.fill), ("clear", shot.target.clear)):
                entry[f"target/{part}"][...] = sites
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
        series: dict[tuple[str, tuple[int, ...]], list[int]] = {}  # frames of the same size share a dataset
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
            if options:  # takes a quarter less time than HDF5's chunk cache
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
    """A file with the values that shots share, including the detector's. Completing it halves the time."""
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
        if name == "signal":  # nan for an image without a signal
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
