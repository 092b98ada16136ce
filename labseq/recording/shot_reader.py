"""A shot's HDF5 file, read back into its record."""

from __future__ import annotations

import contextlib
from collections.abc import Generator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import h5py
import numpy as np
from numpy.typing import NDArray

from labseq.errors import RecordingError
from labseq.model import Frame, ImageRecord, ShotRecord, TargetPattern
from labseq.recording import layout, tables
from labseq.recording.nodes import plain_attribute, read_json, read_values
from labseq.recording.run_file import check_version


@dataclass(frozen=True, slots=True, eq=False)
class ShotContent:
    """What a shot's file holds, frames aside.

    Attributes:
        record: The shot's record; its images have no frames.
        provenance: Seed, versions, texts and settings of the run.
        devices: What each device said of itself.
        target: The target of the run.
        run_id: The run's folder, relative to the data root that it was written to.
    """

    record: ShotRecord
    provenance: dict[str, Any]
    devices: dict[str, Any]
    target: TargetPattern
    run_id: str


def read_content(path: Path) -> ShotContent:
    """Read a shot's file without its frames.

    Raises:
        RecordingError: It is missing, damaged, or of a newer labseq.
    """
    with _opened(path) as entry:
        target = entry["target"]
        return ShotContent(
            record=_record(entry),
            provenance=read_values(entry["provenance"]),
            devices=read_values(entry["devices"]),
            target=TargetPattern(
                target["fill"][()].astype(np.bool_),
                target["clear"][()].astype(np.bool_),
                str(target.attrs["name"]),
            ),
            run_id=str(entry.attrs["run_id"]),
        )


def read_occupancies(path: Path) -> NDArray[np.uint8]:
    """Read the occupancies of a shot's file and nothing else: uint8 (n_images, n_rows, n_cols).

    Raises:
        RecordingError: As for :func:`read_content`.
    """
    with _opened(path) as entry:
        return entry["detection/occupancy"][()]


def read_frames(path: Path) -> dict[int, Frame]:
    """Read the frames of a shot's file: index of the image -> frame, in the order they were taken.

    Raises:
        RecordingError: As for :func:`read_content`; or the frames are compressed
            and the package for it is missing.
    """
    frames: dict[int, Frame] = {}
    with _opened(path) as entry:
        for group in entry["camera"].values() if "camera" in entry else ():
            allow_filter(path, group["images"])
            columns = (
                group["image"][()],
                group["images"][()],
                group["exposure_s"][()],
                group["t_clock_s"][()],
                *_as_counted(group),
            )
            name = str(group.attrs["name"])
            for index, pixels, exposure_s, t_start_s, number, device_s in zip(*columns, strict=True):
                pixels.flags.writeable = False
                frames[int(index)] = Frame(
                    pixels, float(exposure_s), float(t_start_s), name, int(number), float(device_s)
                )
    return dict(sorted(frames.items()))


def _as_counted(group: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """Number and time stamp that the camera gave each frame; files before format 1.3 have none."""
    n_frames = len(group["image"])
    number = group["number"][()] if "number" in group else np.zeros(n_frames, np.int32)
    return number, group["t_device_s"][()] if "t_device_s" in group else np.full(n_frames, np.nan)


def with_frames(record: ShotRecord, frames: dict[int, Frame]) -> ShotRecord:
    """A record whose images have their frames again."""
    images = [replace(image, frame=frames.get(i)) for i, image in enumerate(record.images)]
    return replace(record, images=images)


@contextlib.contextmanager
def _opened(path: Path) -> Generator[Any]:
    if not path.is_file():
        raise RecordingError(path, "is missing; take it from a backup, or delete its line from the index")
    try:
        # A finished file never changes, and locks fail on network folders.
        with h5py.File(path, "r", locking=False) as file:
            if file.attrs.get("format") != layout.FORMAT:
                raise RecordingError(path, "is not a shot's file of labseq")
            check_version(path, str(file.attrs.get("format_version")), layout.FORMAT_VERSION)
            yield cast("Any", file["entry"])
    except (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError) as error:
        raise RecordingError(path, f"is damaged: {error}; take it from a backup") from error


def _record(entry: Any) -> ShotRecord:
    values = {name: plain_attribute(value) for name, value in entry.attrs.items()}
    moves = entry["rearrangement"]
    return ShotRecord(
        shot_index=values["shot_index"],
        attempt=values["attempt"],
        seed=int(values["seed"]),
        t_start_utc=values["t_start_utc"],
        t_end_utc=values["t_end_utc"],
        status=values["status"],
        error=values["error"],
        images=_images(entry["detection"]),
        cycles=tables.cycles_of(*(moves[name][()] for name in ("cycles", "batches", "moves", "predicted"))),
        timing=tables.timing_of(entry["timing"][()]),
        seen_defect_free_cycle=values["seen_defect_free_cycle"],
        success=values["success"],
        filling_fraction=values["filling_fraction"],
        n_missing_atoms=values["n_missing_atoms"],
        readings=read_json(entry, "readings"),
        parameters=read_json(entry, "parameters"),
        calibrations=dict(entry["calibrations"].attrs) if "calibrations" in entry else {},
        atom_events={name: table[()] for name, table in entry["story"].items()} if "story" in entry else {},
    )


def _images(group: Any) -> list[ImageRecord]:
    occupancies: NDArray[np.bool_] = group["occupancy"][()].astype(np.bool_)
    confidences: NDArray[np.float32] = group["confidence"][()]
    return [
        ImageRecord(
            frame=None,
            occupancy=occupancy,
            confidence=confidence,
            step=int(row["step"]),
            cycle=int(row["cycle"]),
            t_start_s=float(row["t_start_s"]),
            exposure_s=float(row["exposure_s"]),
        )
        for row, occupancy, confidence in zip(group["images"][()], occupancies, confidences, strict=True)
    ]


def allow_filter(path: Path, dataset: Any) -> None:
    """Get ready to read what may be compressed.

    Raises:
        RecordingError: It is, and the package for it is missing.
    """
    if dataset.id.get_create_plist().get_nfilters() == 0:
        return
    try:
        import hdf5plugin  # noqa: F401  # pyright: ignore[reportUnusedImport] - importing it registers the filter
    except ImportError as error:
        raise RecordingError(
            path,
            "holds compressed frames, and to read them hdf5plugin is needed; pip install 'labseq[compress]'",
        ) from error
