"""A recorded shot, read back."""

from __future__ import annotations

import contextlib
import hashlib
import math
from collections.abc import Callable, Generator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import h5py
import numpy as np
from numpy.typing import NDArray

from labseq.errors import RecordingError
from labseq.model import CycleRecord, Frame, ImageRecord, Plan, ShotRecord, StageTiming, TargetPattern
from labseq.model.records import ShotStatus
from labseq.recording import schema as layout, schema as tables
from labseq.recording.run_file import ShotSummary, check_version, summarise, summary_in
from labseq.recording.schema import plain_attribute, read_json, read_values


def load_content(path: Path) -> ShotContent:
    """Read a shot's file without its frames; see :func:`labseq.recording.shot.read_content`."""
    return read_content(path)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Shot:
    """A shot on disk. What the index holds costs nothing; the rest reads the shot's file.

    Every property from ``occupancies`` on raises ``RecordingError`` if the file is missing or damaged.

    Attributes:
        file: The shot's HDF5 file.
        row: Its line in the index.
    """

    file: Path
    row: dict[str, Any]
    _load: Callable[[Path], ShotContent] = field()

    def __repr__(self) -> str:
        return f"<Shot {self.index}: {self.status}, {self.file}>"

    @property
    def index(self) -> int:
        """Index in the run, from 0."""
        return int(self.row["shot"])

    @property
    def attempt(self) -> int:
        """Which attempt this is, from 0."""
        return int(self.row["attempt"])

    @property
    def status(self) -> ShotStatus:
        """One of "complete", "interrupted" and "failed"."""
        return self.row["status"]

    @property
    def success(self) -> bool:
        """Whether the last ``image`` step met the target."""
        return bool(self.row["success"])

    @property
    def filling_fraction(self) -> float:
        """Filling of the target on the last ``image`` step; nan without one."""
        value = self.row["filling_fraction"]
        return math.nan if value is None else float(value)

    @property
    def seen_defect_free_cycle(self) -> int:
        """First cycle whose image met the target; 0 if none."""
        return int(self.row["seen_defect_free_cycle"])

    @property
    def occupancies(self) -> NDArray[np.bool_]:
        """As detected, bool (n_images, n_rows, n_cols)."""
        return self._of_each_image("occupancy", np.bool_)

    @property
    def summary(self) -> ShotSummary:
        """What its images and cycles came to; the file is read for runs before format 1.1 only."""
        found = summary_in(self.row)
        return summarise(self._content.record, self._content.target) if found is None else found

    @property
    def confidences(self) -> NDArray[np.float32]:
        """The detector's confidence, float32 (n_images, n_rows, n_cols)."""
        return self._of_each_image("confidence", np.float32)

    @property
    def target(self) -> TargetPattern:
        """The target of the run."""
        return self._content.target

    @property
    def images(self) -> tuple[ImageRecord, ...]:
        """The images without their frames, in the order they were taken."""
        return tuple(self._content.record.images)

    @property
    def plans(self) -> tuple[Plan, ...]:
        """The plan of each cycle."""
        return tuple(cycle.plan for cycle in self.cycles)

    @property
    def cycles(self) -> tuple[CycleRecord, ...]:
        """The rearrangement cycles."""
        return tuple(self._content.record.cycles)

    @property
    def timing(self) -> tuple[StageTiming, ...]:
        """The stages, in the order they ended."""
        return tuple(self._content.record.timing)

    @property
    def parameters(self) -> dict[str, Any]:
        """What differs from the files in this shot: address -> value; those of a scan in SI."""
        return dict(self.row.get("parameters") or {})

    @property
    def calibrations(self) -> dict[str, str]:
        """The calibrations in use: kind -> id."""
        return dict(self._content.record.calibrations)

    @property
    def readings(self) -> dict[str, Any]:
        """Values read from devices during the shot."""
        return dict(self._content.record.readings)

    @property
    def atom_events(self) -> dict[str, NDArray[Any]]:
        """What the simulation told of the atoms: name -> structured array; empty if it told nothing."""
        return dict(self._content.record.atom_events)

    @property
    def provenance(self) -> dict[str, Any]:
        """Seed, versions, texts and settings, as the shot's file has them."""
        return dict(self._content.provenance)

    @property
    def devices(self) -> dict[str, Any]:
        """What each device said of itself."""
        return dict(self._content.devices)

    @property
    def frames(self) -> NDArray[np.uint16]:
        """The frames that were kept, uint16 (n_frames, height, width); read anew each time.

        Raises:
            RecordingError: The frames differ in size; :meth:`record` gives them one by one.
        """
        images = [frame.image for frame in read_frames(self.file).values()]
        if len({image.shape for image in images}) > 1:
            raise RecordingError(self.file, "holds frames of several sizes; use shot.record().images")
        return np.stack(images) if images else np.empty((0, 0, 0), np.uint16)

    def record(self) -> ShotRecord:
        """The whole record as it was written, frames included."""
        return with_frames(self._content.record, read_frames(self.file))

    def verify(self) -> None:
        """Compare the file with the checksum in the index.

        Raises:
            RecordingError: A byte has changed since it was written.
        """
        try:
            data = self.file.read_bytes()
        except OSError as error:
            reason = f"cannot be read: {error.strerror}; take it from a backup"
            raise RecordingError(self.file, reason) from error
        if hashlib.sha256(data).hexdigest() != self.row.get("sha256"):
            raise RecordingError(self.file, "has changed since it was written; take it from a backup")

    @property
    def _content(self) -> ShotContent:
        return self._load(self.file)

    def _of_each_image(self, name: str, dtype: Any) -> NDArray[Any]:
        images = self._content.record.images
        shape = (len(images), *self._content.target.shape)
        return np.array([getattr(image, name) for image in images], dtype).reshape(shape)


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
