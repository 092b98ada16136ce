"""A run's index, with one line of JSON per attempt at a shot, read back as an :class:`IndexRow`.

A line also sums up the images and cycles of its shot, so that a run of many thousand shots can be evaluated
without opening their files.
"""

from __future__ import annotations

import hashlib
import math
import os
import re
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from numbers import Real
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar, cast, get_type_hints

import numpy as np

from labseq.errors import RecordingError
from labseq.files import NewLines, open_ordinary
from labseq.model import ShotRecord, TargetPattern
from labseq.model.image_quantities import OF_IMAGES, Events, events_of, parse_name
from labseq.model.records import STEP, ShotStatus
from labseq.plain import to_plain
from labseq.recording import schema
from labseq.recording.folders import INDEX_FILE, SHOTS_FOLDER

SIMULATION: Final = "simulation."
"""Prefix of the names of readings that only a simulation can know."""

SHOT_FILE: Final = re.compile(SHOTS_FOLDER + r"/shot_\d{6,}(\.attempt_\d+)?(\.take_(\d+))?\.h5")
"""Path of a shot's file in a line of the index."""

_OPEN_FOR_WRITING: Final = b"\1\0\0\0"
"""What HDF5 writes after byte 20 of a file instead of zeros while a program has it open for writing."""

_T = TypeVar("_T")


class ShotDigest(NamedTuple):
    """Size and checksum of a shot's file, to tell whether it is as it was written.

    Attributes:
        n_bytes: Its size.
        sha256: Its SHA-256 in hexadecimal without HDF5's mark, as in the index.
        is_marked: Whether a program has it open for writing, or had when it died.
    """

    n_bytes: int
    sha256: str
    is_marked: bool


def digest_of(path: Path, max_bytes: int | None = None) -> ShotDigest:
    """Read a shot's file for its digest. The mark of a program that opens it for writing is ignored.

    Args:
        path: The file.
        max_bytes: Its size in the index. A longer file has changed. It is not read, and its digest is "".

    Raises:
        OSError: The file cannot be read.
    """
    with open_ordinary(path) as file:
        n_bytes = os.fstat(file.fileno()).st_size
        head = file.read(24)
        is_marked = head[:9] == b"\x89HDF\r\n\x1a\n\0" and head[20:] == _OPEN_FOR_WRITING
        if max_bytes is not None and n_bytes > max_bytes:
            return ShotDigest(n_bytes, "", is_marked)
        digest = hashlib.sha256(head[:20] + bytes(4) if is_marked else head)
        while chunk := file.read(1 << 20):
            digest.update(chunk)
        return ShotDigest(n_bytes, digest.hexdigest(), is_marked)


@dataclass(frozen=True, slots=True)
class Images:
    """The images of a shot, in the order they were taken.

    Attributes:
        cycle: Index of the cycle that each image ended, within its step. -1 for an ``image`` step.
        t_start_s: Start of each exposure, from the start of the shot.
        exposure_s: Exposure times.
        n_atoms: Number of atoms on each image.
        n_defects: Number of empty target sites on each image.
        n_surplus: Number of atoms on each image on sites that must be empty.
    """

    cycle: Sequence[int] = ()
    t_start_s: Sequence[float] = ()
    exposure_s: Sequence[float] = ()
    n_atoms: Sequence[int] = ()
    n_defects: Sequence[int] = ()
    n_surplus: Sequence[int] = ()

    def __len__(self) -> int:
        return len(self.cycle)


@dataclass(frozen=True, slots=True)
class Cycles:
    """The rearrangement cycles of a shot, in the order they were made.

    Attributes:
        n_batches: Number of batches of each plan.
        n_batches_played: Number of batches that fitted into the window.
        n_atom_moves: Number of atom moves in the batches that were played.
    """

    n_batches: Sequence[int] = ()
    n_batches_played: Sequence[int] = ()
    n_atom_moves: Sequence[int] = ()

    def __len__(self) -> int:
        return len(self.n_batches)


@dataclass(frozen=True, slots=True)
class IndexRow:
    """An attempt at a shot, as the index lists it.

    Its first attributes are described in :data:`labseq.recording.schema.IN_INDEX`.

    Attributes:
        counts: Whether it is the shot. False for an attempt that failed or was interrupted.
        stage_s: Stage -> sum of its durations on the session's clock. A step is named like "step_0_load".
        parameters: Settings that differ from the files: address -> value, scanned values in SI.
        readings: Single values read from devices, by dotted name.
        calibrations: The calibrations in use: kind -> id.
        images: Its images.
        cycles: Its rearrangement cycles.
        simulation: True values that a simulation reported, such as "lost.vacuum". Empty on real hardware.
        measured: What the run measures, if images tell it: name -> events and trials. Other quantities are
            in the columns.
        file: The shot's file, from the run's folder.
        sha256: Checksum of the file.
        bytes: Size of the file.
    """

    shot: int
    attempt: int
    status: ShotStatus
    error: str
    t_start_utc: str
    t_end_utc: str
    success: bool | None
    filling_fraction: float
    seen_defect_free_cycle: int
    n_images: int
    n_cycles: int
    n_batches: int
    n_atom_moves: int
    n_missing_atoms: int
    counts: bool
    stage_s: Mapping[str, float]
    parameters: Mapping[str, Any]
    readings: Mapping[str, Any]
    calibrations: Mapping[str, str]
    images: Images
    cycles: Cycles
    simulation: Mapping[str, float]
    measured: Mapping[str, Events]
    file: str
    sha256: str
    bytes: int

    @property
    def duration_s(self) -> float:
        """Sum of the steps on the session's clock, in seconds. nan if no step has ended."""
        steps_s = [s for name, s in self.stage_s.items() if name.startswith(STEP) and not math.isnan(s)]
        return math.fsum(steps_s) if steps_s else math.nan

    @property
    def was_defect_free(self) -> bool:
        """Whether at least one image met the target."""
        return bool(self.success) or self.seen_defect_free_cycle >= 0

    @property
    def ends_with_image_step(self) -> bool:
        """Whether the last image is from an ``image`` step, not from a cycle that may have ended early."""
        return all(cycle < 0 for cycle in self.images.cycle[-1:])


def row_of_record(
    shot: ShotRecord,
    target: TargetPattern,
    *,
    file: str,
    sha256: str,
    n_bytes: int,
    measured: Iterable[str] = (),
) -> IndexRow:
    """A shot as the index lists it, the same as when its line is read back.

    A scanner thus chooses the same points in a resumed run as in an uninterrupted one.

    Args:
        file: Its file, from the run's folder.
        sha256: Checksum of the file.
        n_bytes: Size of the file.
        measured: The quantities that the run measures.

    Raises:
        RecordingError: The record contradicts itself.
    """
    stage_s: dict[str, float] = {}
    for timing in shot.timing:
        stage_s[timing.stage] = stage_s.get(timing.stage, 0.0) + timing.duration_s
    values = {
        **{field.name: field.value(shot) for field in schema.IN_INDEX},
        "success": None if math.isnan(shot.filling_fraction) else shot.success,
        "counts": shot.status == "complete",
        "stage_s": stage_s,
        "parameters": shot.parameters,
        "readings": flat_readings(shot.readings),
        "calibrations": shot.calibrations,
        "images": _images(shot, target),
        "cycles": {
            "n_batches": [cycle.plan.n_batches for cycle in shot.cycles],
            "n_batches_played": [cycle.n_batches_played for cycle in shot.cycles],
            "n_atom_moves": [cycle.n_atom_moves_played for cycle in shot.cycles],
        },
        "simulation": {
            name.removeprefix(SIMULATION): float(value)
            for name, value in shot.readings.items()
            if name.startswith(SIMULATION) and isinstance(value, Real)
        },
        "measured": {
            name: events_of(name, shot, target) for name in measured if parse_name(name).kind in OF_IMAGES
        },
        "file": file,
        "sha256": sha256,
        "bytes": n_bytes,
    }
    row = row_of_line(to_plain(values))  # as it is read back, because JSON has neither tuples nor infinities
    if row is None:
        raise RecordingError(
            file, f"cannot be listed in {INDEX_FILE}", "a value of the shot has another type"
        )
    return row


def _images(shot: ShotRecord, target: TargetPattern) -> dict[str, list[Any]]:
    occupancies = [image.occupancy.reshape(target.shape) for image in shot.images]
    return {
        "cycle": [image.cycle for image in shot.images],
        "t_start_s": [round(float(image.t_start_s), 9) for image in shot.images],
        "exposure_s": [float(image.exposure_s) for image in shot.images],
        "n_atoms": list(map(np.count_nonzero, occupancies)),
        "n_defects": list(map(target.n_defects, occupancies)),
        "n_surplus": list(map(target.n_surplus, occupancies)),
    }


def flat_readings(readings: Mapping[str, Any]) -> dict[str, Any]:
    """The readings that are single values, by dotted name, without readings of a simulation.

    Example:
        >>> flat_readings({"laser": {"power_w": 0.1, "trace": [1, 2]}, "simulation.lost.vacuum": 2.0})
        {'laser.power_w': 0.1}
    """
    real = {name: value for name, value in readings.items() if not name.startswith(SIMULATION)}
    return dict(_flat("", to_plain(real), depth=4))


def _flat(prefix: str, values: Mapping[str, Any], depth: int) -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict) and depth:
            yield from _flat(f"{prefix}{name}.", cast("dict[str, Any]", value), depth - 1)
        elif isinstance(value, bool | int | float) or (isinstance(value, str) and len(value) <= 80):
            yield f"{prefix}{name}", value


def read_index(folder: Path) -> tuple[list[IndexRow], int]:
    """The lines of a run's index, and the number of damaged lines, which are left out.

    Raises:
        RecordingError: The index exists but cannot be read.
    """
    lines = NewLines(folder / INDEX_FILE).placed()
    rows = [None if values is None else row_of_line(values) for _, values in lines]
    intact = [row for row in rows if row is not None]
    return intact, len(rows) - len(intact)


def row_of_line(line: Mapping[str, Any]) -> IndexRow | None:
    """The row in a line of the index. None if the line is damaged."""
    try:
        line = {"measured": {}, **line}  # lines of earlier versions have none
        values: list[Any] = [read(line[name]) for name, read in _READ]
        return IndexRow(*values)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        return None


def _of_type(*types: type) -> Callable[[Any], Any]:
    def read(value: Any) -> Any:
        if type(value) not in types:
            raise TypeError(value)
        return value

    return read


def _integer(value: Any) -> int:
    """An integer, not a bool, that fits into a column of numpy."""
    if type(value) is not int or not -(2**63) <= value < 2**63:
        raise TypeError(value)
    return value


def _float(value: Any) -> float:
    """A number. JSON has null for nan and infinities."""
    return _floats([value])[0]


def _integers(values: Iterable[Any]) -> Sequence[int]:
    return array("q", values)  # eight bytes a number, as an index may have many thousand lines


def _floats(values: Iterable[Any]) -> Sequence[float]:
    return array("d", [math.nan if value is None else value for value in values])


def _floats_by_name(values: Mapping[str, Any]) -> Mapping[str, float]:
    return dict(zip(values, _floats(values.values()), strict=True))


def _events_by_name(values: Mapping[str, Any]) -> Mapping[str, Events]:
    return {name: (_float(n), _float(n_trials)) for name, (n, n_trials) in values.items()}


def _table(kind: Callable[..., _T]) -> Callable[[Any], _T]:
    """Make a reader for columns of equal length."""
    columns = [
        (name, _integers if hint == Sequence[int] else _floats) for name, hint in get_type_hints(kind).items()
    ]

    def read(table: Mapping[str, Any]) -> _T:
        values = [read_column(table[name]) for name, read_column in columns]
        if len({*map(len, values)}) > 1:
            raise ValueError(table)
        return kind(*values)

    return read


def _file(value: Any) -> str:
    if not SHOT_FILE.fullmatch(value):  # a damaged index must not lead out of the run's folder
        raise ValueError(value)
    return value


def _reader_of(dtype: str) -> Callable[[Any], Any]:
    readers = {"int64": _integer, "bool": _of_type(bool, type(None)), "text": _of_type(str)}
    return readers.get(dtype, _float)


_READERS: Final[Mapping[str, Callable[[Any], Any]]] = {
    **{field.name: _reader_of(field.dtype) for field in schema.IN_INDEX},
    "counts": _of_type(bool),
    "stage_s": _floats_by_name,
    **dict.fromkeys(("parameters", "readings", "calibrations"), _of_type(dict)),
    "images": _table(Images),
    "cycles": _table(Cycles),
    "simulation": _floats_by_name,
    "measured": _events_by_name,
    "file": _file,
    "sha256": _of_type(str),
    "bytes": _integer,
}
_READ: Final = tuple((field.name, _READERS[field.name]) for field in fields(IndexRow))
"""Name and reader of each value of a line, in the order of the attributes.

Computed once, as an index has many thousand lines."""
