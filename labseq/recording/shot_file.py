"""A shot's record, laid out as an HDF5 file."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

import labseq
from labseq.errors import RecordingError
from labseq.model import CycleRecord, ImageRecord, RunRecord, ShotRecord
from labseq.recording import schema as layout, schema as tables
from labseq.recording.run_file import sha256_of_text
from labseq.recording.schema import (
    DATASETS,
    column_meanings,
    describe,
    describe_columns,
    link_name,
    set_attributes,
    write_json,
    write_values,
)


class ShotEncoder:
    """Turns the shots of one run into the bytes of HDF5 files.

    The file is built in memory: HDF5 itself never meets a full disk, and the
    bytes that are hashed are the bytes that are written.

    Args:
        run: The run that the shots belong to.
        run_id: The run's folder, relative to the data root.
        compress: Whether frames are compressed (bitshuffle and LZ4).

    Raises:
        RecordingError: Compression is asked for and the package for it is missing.
    """

    def __init__(self, run: RunRecord, run_id: str, *, compress: bool = False) -> None:
        self._run = run
        self._run_id = run_id
        self._filter = _bitshuffle() if compress else {}
        self._common = self._encode_common()

    def encode(self, shot: ShotRecord) -> memoryview:
        """The bytes of the shot's file.

        Raises:
            RecordingError: The record contradicts itself, for example occupancies of differing shapes.
        """
        buffer = io.BytesIO(self._common)
        try:
            with h5py.File(buffer, "r+", libver=layout.LIBRARY_VERSIONS) as file:
                self._write_shot(file["entry"], shot)
        except Exception as error:  # a stranger's camera or step may put anything into the record
            where = f"shot {shot.shot_index} (attempt {shot.attempt})"
            what = f"cannot be laid out as a file: {type(error).__name__}: {error}"
            raise RecordingError(where, f"{what}; see the plugin that made it") from error
        return buffer.getbuffer()

    def _encode_common(self) -> bytes:
        """A file with what is the same in all shots; adding to it takes half the time of making it anew."""
        buffer = io.BytesIO()
        with h5py.File(buffer, "w", libver=layout.LIBRARY_VERSIONS) as file:
            set_attributes(
                file,
                format=layout.FORMAT,
                format_version=layout.FORMAT_VERSION,
                NX_class="NXroot",
                default="entry",
                creator=f"labseq {labseq.__version__}",
            )
            run = self._run
            entry = file.create_group("entry")
            set_attributes(entry, NX_class="NXentry", run_id=self._run_id, simulated=run.simulated)
            set_attributes(entry, record_frames=run.record_frames)
            target = entry.create_group("target")
            set_attributes(
                target, name=run.target.name, lattice=run.lattice, grid_spacing_m=run.grid_spacing_m
            )
            _write_array(target, "target/fill", run.target.fill.view(np.uint8))
            _write_array(target, "target/clear", run.target.clear.view(np.uint8))
            write_values(entry.create_group("devices"), run.devices, "devices")
            write_values(entry.create_group("provenance"), _provenance(run), "provenance")
        return buffer.getvalue()

    def _write_shot(self, entry: Any, shot: ShotRecord) -> None:
        kept = _kept(shot.images, self._run.record_frames)
        grid_shape = self._run.target.shape
        _write_outcome(entry, shot, default="images_view" if kept else "detection")
        if kept:
            self._write_frames(entry, shot.images, kept)
        _write_detection(entry.create_group("detection"), shot.images, grid_shape)
        _write_cycles(entry.create_group("rearrangement"), shot.cycles, grid_shape)
        _write_table(entry, "timing", tables.timing_table(shot.timing))
        if shot.calibrations:
            set_attributes(entry.create_group("calibrations"), **shot.calibrations)
        if shot.atom_events:
            _write_atom_events(entry.create_group("story"), shot.atom_events)
        write_json(entry, "parameters", shot.parameters, DATASETS["parameters"])
        write_json(entry, "readings", shot.readings, DATASETS["readings"])

    def _write_frames(self, entry: h5py.Group, images: Sequence[ImageRecord], kept: Sequence[int]) -> None:
        series: dict[tuple[str, tuple[int, ...]], list[int]] = {}  # frames of one size share a dataset
        for i in kept:
            frame = images[i].frame
            assert frame is not None
            series.setdefault((frame.camera, frame.image.shape), []).append(i)
        cameras = entry.create_group("camera")
        names: list[str] = []
        for (camera, _), indices in series.items():
            names.append(link_name(camera, names))
            self._write_series(cameras.create_group(names[-1]), camera, images, indices)
        view = entry.create_group("images_view")
        set_attributes(view, NX_class="NXdata", signal="images", axes=["t_s", ".", "."])
        for dataset in ("images", "t_s"):
            view[dataset] = h5py.SoftLink(f"/entry/camera/{names[0]}/{dataset}")

    def _write_series(
        self, group: h5py.Group, camera: str, images: Sequence[ImageRecord], indices: Sequence[int]
    ) -> None:
        chosen = [images[i] for i in indices]
        frames = [image.frame for image in chosen if image.frame is not None]
        shape = frames[0].image.shape
        options: dict[str, Any] = {"chunks": (1, *shape), **self._filter} if all(shape) else {}
        stack = group.create_dataset("images", (len(frames), *shape), np.uint16, **options)
        for i, frame in enumerate(frames):
            if options and not self._filter:  # a quarter less time than through HDF5's chunk cache
                stack.id.write_direct_chunk((i, 0, 0), frame.image)
            else:
                stack[i] = frame.image
        set_attributes(group, NX_class="NXdetector", name=camera)
        describe(stack, DATASETS["camera/<name>/images"])
        set_attributes(stack, interpretation="image", long_name=f"{camera} (ADU)")
        columns = {
            "t_s": [image.t_start_s for image in chosen],
            "t_clock_s": [frame.t_start_s for frame in frames],
            "t_device_s": [frame.device_time_s for frame in frames],
            "number": [frame.number for frame in frames],
            "exposure_s": [frame.exposure_s for frame in frames],
            "image": indices,
            "step": [image.step for image in chosen],
            "cycle": [image.cycle for image in chosen],
        }
        for name, values in columns.items():
            path = f"camera/<name>/{name}"
            _write_array(group, path, np.array(values, DATASETS[path].dtype))
        _write_array(group, "camera/<name>/event", np.array(list(map(_event, chosen)), layout.EVENT))


def _provenance(run: RunRecord) -> dict[str, Any]:
    return {
        **run.provenance,
        "seed": run.seed,
        "sequence": run.sequence_text,
        "sequence_sha256": sha256_of_text(run.sequence_text),
        "profile": run.profile_text,
        "profile_sha256": sha256_of_text(run.profile_text),
        "resolved": run.resolved,
        "overrides": run.overrides,
        "plugins": run.plugins,
    }


def _write_outcome(entry: h5py.Group, shot: ShotRecord, *, default: str) -> None:
    set_attributes(
        entry,
        default=default,
        shot_index=shot.shot_index,
        attempt=shot.attempt,
        status=shot.status,
        error=shot.error,
        t_start_utc=shot.t_start_utc,
        t_end_utc=shot.t_end_utc,
        success=shot.success,
        filling_fraction=shot.filling_fraction,
        seen_defect_free_cycle=shot.seen_defect_free_cycle,
        n_missing_atoms=shot.n_missing_atoms,
        n_images=len(shot.images),
        n_cycles=len(shot.cycles),
        seed=shot.seed if -(2**63) <= shot.seed < 2**63 else str(shot.seed),
    )


def _kept(images: Sequence[ImageRecord], record_frames: str) -> list[int]:
    """Indices of the images whose frames go to the file."""
    wanted = {"all": range(len(images)), "last": range(len(images))[-1:], "none": range(0)}[record_frames]
    return [i for i in wanted if images[i].frame is not None]


def _event(image: ImageRecord) -> bytes:
    return f"cycle_{image.cycle}".encode() if image.cycle else b"image"


def _write_detection(group: h5py.Group, images: Sequence[ImageRecord], shape: tuple[int, int]) -> None:
    n = len(images)
    occupancy = np.array([image.occupancy for image in images], np.uint8).reshape(n, *shape)
    confidence = np.array([image.confidence for image in images], np.float32).reshape(n, *shape)
    set_attributes(
        group,
        NX_class="NXdata",
        signal="occupancy",
        auxiliary_signals=["confidence"],
        axes=["t_s", ".", "."],
    )
    for path, values in (("detection/occupancy", occupancy), ("detection/confidence", confidence)):
        set_attributes(_write_array(group, path, values), interpretation="image")
    _write_array(group, "detection/t_s", np.array([image.t_start_s for image in images], np.float64))
    rows = [(i.step, i.cycle, i.t_start_s, i.exposure_s, _event(i)) for i in images]
    _write_table(group, "detection/images", np.array(rows, layout.IMAGES))


def _write_atom_events(group: h5py.Group, atom_events: Mapping[str, NDArray[Any]]) -> None:
    names: list[str] = []
    for name, table in atom_events.items():
        names.append(link_name(name, names))
        _write_table(group, "story/<name>", table, names[-1])


def _write_cycles(group: h5py.Group, cycles: Sequence[CycleRecord], shape: tuple[int, int]) -> None:
    _write_table(group, "rearrangement/moves", tables.moves_table(cycles))
    _write_table(group, "rearrangement/batches", tables.batches_table(cycles))
    _write_table(group, "rearrangement/cycles", tables.cycles_table(cycles))
    predicted = np.array([c.report.predicted for c in cycles], np.uint8).reshape(len(cycles), *shape)
    _write_array(group, "rearrangement/predicted", predicted)


def _write_table(group: h5py.Group, path: str, table: NDArray[Any], name: str = "") -> None:
    dataset = group.create_dataset(name or path.rpartition("/")[2], data=table)
    describe_columns(dataset, layout.units_of(table.dtype), column_meanings(path, table.dtype))
    set_attributes(dataset, description=DATASETS[path].meaning)


def _write_array(group: h5py.Group, path: str, values: NDArray[Any]) -> Any:
    """Add an array under the last part of its path in :data:`DATASETS`."""
    dataset = group.create_dataset(path.rpartition("/")[2], data=values)
    describe(dataset, DATASETS[path])
    return dataset


def _bitshuffle() -> Mapping[str, Any]:
    try:
        import hdf5plugin
    except ImportError as error:
        missing = "compressed frames need hdf5plugin, which is not installed"
        raise RecordingError(Path("compress"), f"{missing}; pip install 'labseq[compress]'") from error
    return hdf5plugin.Bitshuffle(cname="lz4")
