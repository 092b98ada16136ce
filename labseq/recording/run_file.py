"""The files of a run's folder: run.json, the index of shots, the log.

They stand in the shot's line of the index, so that a run of many thousand shots is summed
up without opening their files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from numbers import Real
from pathlib import Path
from types import UnionType
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

import labseq
from labseq.errors import RecordingError
from labseq.files import Process
from labseq.model import RunRecord, ShotRecord, TargetPattern
from labseq.model.records import RunStatus
from labseq.plain import dumps, parse_object, to_plain
from labseq.recording import schema as layout
from labseq.recording.folders import PROFILE_FILE, RUN_FILE, SEQUENCE_FILE, STATE_FILE

SIMULATION: Final = "simulation."
"""What the names of readings begin with that only a simulation can know."""

_MAX_TEXT: Final = 80
_MAX_DEPTH: Final = 4


@dataclass(frozen=True, slots=True)
class Images:
    """The images of a shot, in the order they were taken.

    Attributes:
        cycle: The cycle that each ended, counted from 1 within its step; 0 for that of an ``image`` step.
        t_start_s: Start of each exposure, from the start of the shot.
        exposure_s: Exposure times.
        n_defects: Empty target sites on each.
        n_surplus: Atoms on each on sites that must be empty.
    """

    cycle: tuple[int, ...] = ()
    t_start_s: tuple[float, ...] = ()
    exposure_s: tuple[float, ...] = ()
    n_defects: tuple[int, ...] = ()
    n_surplus: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.cycle)


@dataclass(frozen=True, slots=True)
class Cycles:
    """The rearrangement cycles of a shot, in the order they were made.

    Attributes:
        n_batches: Batches of each plan.
        n_batches_played: How many of them fitted into the window.
        n_atom_moves: Atom moves in those that were played.
    """

    n_batches: tuple[int, ...] = ()
    n_batches_played: tuple[int, ...] = ()
    n_atom_moves: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.n_batches)


@dataclass(frozen=True, slots=True)
class ShotSummary:
    """A shot in a few numbers.

    Attributes:
        images: Its images.
        cycles: Its cycles.
        simulation: Truths that a simulation told, such as "lost.vacuum"; empty on real hardware.
    """

    images: Images
    cycles: Cycles
    simulation: Mapping[str, float]

    @property
    def is_judged(self) -> bool:
        """Whether no cycle ended with the last image: that one may have been chosen for being good."""
        return not any(self.images.cycle[-1:])

    def as_row(self) -> dict[str, Any]:
        """What goes into the index, JSON-ready; :func:`summary_in` reads it."""
        return asdict(self)


def summarise(shot: ShotRecord, target: TargetPattern) -> ShotSummary:
    """Sum up a shot.

    Args:
        shot: Its record.
        target: The target of the run.
    """
    occupancies = [image.occupancy.reshape(target.shape) for image in shot.images]
    images = Images(
        cycle=tuple(image.cycle for image in shot.images),
        t_start_s=tuple(round(float(image.t_start_s), 9) for image in shot.images),
        exposure_s=tuple(float(image.exposure_s) for image in shot.images),
        n_defects=tuple(map(target.n_defects, occupancies)),
        n_surplus=tuple(map(target.n_surplus, occupancies)),
    )
    cycles = Cycles(
        n_batches=tuple(cycle.plan.n_batches for cycle in shot.cycles),
        n_batches_played=tuple(cycle.n_batches_played for cycle in shot.cycles),
        n_atom_moves=tuple(int(cycle.plan.batch_offsets[cycle.n_batches_played]) for cycle in shot.cycles),
    )
    told = {
        name.removeprefix(SIMULATION): float(value)
        for name, value in shot.readings.items()
        if name.startswith(SIMULATION) and isinstance(value, Real)
    }
    return ShotSummary(images, cycles, told)


def flat_readings(readings: Mapping[str, Any]) -> dict[str, Any]:
    """The readings that are single values, by dotted names; those of a simulation stand in its summary.

    Example:
        >>> flat_readings({"laser": {"power_w": 0.1, "trace": [1, 2]}, "simulation.lost.vacuum": 2.0})
        {'laser.power_w': 0.1}
    """
    told = {name: value for name, value in readings.items() if not name.startswith(SIMULATION)}
    return dict(_flat("", to_plain(told), _MAX_DEPTH))


def _flat(prefix: str, values: Mapping[str, Any], depth: int) -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict) and depth:
            yield from _flat(f"{prefix}{name}.", cast("dict[str, Any]", value), depth - 1)
        elif isinstance(value, bool | int | float) or (isinstance(value, str) and len(value) <= _MAX_TEXT):
            yield f"{prefix}{name}", value


def summary_in(row: Mapping[str, Any]) -> ShotSummary | None:
    """The summary in a line of the index; None if there is none, as before version 1.1, or it is damaged."""
    try:
        images, cycles = (
            _columns(kind, row[name]) for kind, name in ((Images, "images"), (Cycles, "cycles"))
        )
        told = {str(name): float(value) for name, value in row["simulation"].items() if _is_number(value)}
    except (KeyError, TypeError, AttributeError, ValueError):
        return None
    return ShotSummary(cast("Images", images), cast("Cycles", cycles), told)


def _columns(kind: type[Images | Cycles], table: Mapping[str, Any]) -> Images | Cycles:
    """A table of numbers.

    Raises:
        ValueError: Its columns differ in length, or hold something else.
    """
    columns = [tuple(table[field.name]) for field in fields(kind)]
    if len({*map(len, columns)}) > 1 or not all(_is_number(value) for one in columns for value in one):
        raise ValueError(kind.__name__)
    return kind(*columns)


def _is_number(value: object) -> bool:
    return type(value) in (int, float)


_IN_RUN: Final = {"name": str, "n_shots": int, "seed": int, "simulated": bool, "target": dict}
_IN_INDEX: Final[Mapping[str, type | UnionType]] = {
    "shot": int,
    "attempt": int,
    "counts": bool,
    "file": str,
    "status": str,
    "success": bool,
    "filling_fraction": float | int | None,
    "seen_defect_free_cycle": int,
}
STATUSES: Final = ("running", "complete", "stopped", "failed")


class NewerFormatError(RecordingError):
    """A file was written by a newer labseq than this one."""


def encode_text(text: str) -> bytes:
    """The exact bytes that a text was decoded from."""
    return text.encode("utf-8", "surrogateescape")


def sha256_of_text(text: str) -> str:
    """SHA-256 of a text's bytes, in hexadecimal."""
    return hashlib.sha256(encode_text(text)).hexdigest()


def encode_run(run: RunRecord, run_id: str) -> bytes:
    """The content of run.json."""
    fields = {name: getattr(run, name) for name in RunRecord.__slots__}
    target = {"name": run.target.name, "fill": _rows(run.target.fill), "clear": _rows(run.target.clear)}
    values = {
        "format": layout.RUN_FORMAT,
        "format_version": layout.RUN_FORMAT_VERSION,
        "creator": f"labseq {labseq.__version__}",
        "run_id": run_id,
        **fields,
        "target": target,
        "sequence_file": SEQUENCE_FILE,
        "sequence_sha256": sha256_of_text(run.sequence_text),
        "profile_file": PROFILE_FILE,
        "profile_sha256": sha256_of_text(run.profile_text),
    }
    return dumps(values, indent=1).encode() + b"\n"


def read_run(folder: Path) -> dict[str, Any]:
    """Read run.json.

    Raises:
        RecordingError: It is damaged, or of a newer labseq.
    """
    path = folder / RUN_FILE
    try:
        record = parse_object(path.read_bytes())
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}; check the disk") from error
    if record is None or record.get("format") != layout.RUN_FORMAT:
        raise RecordingError(path, "is damaged, or not labseq's; take it from a backup")
    check_version(path, str(record.get("format_version")), layout.RUN_FORMAT_VERSION)
    wrong = [name for name, kind in _IN_RUN.items() if not isinstance(record.get(name), kind)]
    if wrong:
        raise RecordingError(path, f"is damaged: it has no valid '{wrong[0]}'; take it from a backup")
    return record


def check_version(path: Path, came: str, known: str) -> None:
    """Refuse files of a newer major version than this labseq knows.

    Raises:
        RecordingError: The version is newer, or none at all.
    """
    major = came.partition(".")[0]
    if not major.isdecimal():
        raise RecordingError(
            path, f"has the format version '{came}'; expected one like {known}; it is damaged"
        )
    if int(major) > int(known.partition(".")[0]):
        reason = f"has format version {came}, this labseq reads {known}; update labseq"
        raise NewerFormatError(path, reason)


def target_of(path: Path, record: Mapping[str, Any]) -> TargetPattern:
    """The target in run.json.

    Raises:
        RecordingError: There is none, or it is damaged.
    """
    try:
        target = record["target"]
        return TargetPattern(_grid(target["fill"]), _grid(target["clear"]), str(target["name"]))
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(path, f"has a damaged target: {error!r}; take it from a backup") from error


def _rows(sites: NDArray[np.bool_]) -> list[str]:
    return ["".join("1" if site else "0" for site in row) for row in sites]


def _grid(rows: list[str]) -> NDArray[np.bool_]:
    return np.array([[site == "1" for site in row] for row in rows], np.bool_).reshape(len(rows), -1)


def encode_state(status: RunStatus, error: str = "") -> bytes:
    """The content of STATE: one line, with the process that the run belongs to."""
    return dumps({"state": status, **asdict(Process.current()), "error": error}).encode() + b"\n"


def read_state(folder: Path) -> tuple[RunStatus, str]:
    """Status of a run, and the error that ended it.

    A run that is "running" while its process is gone has failed. On another
    computer that cannot be known, and the run is believed.
    """
    try:
        state = parse_object((folder / STATE_FILE).read_bytes())
    except OSError:
        state = None
    if state is None or state.get("state") not in STATUSES:
        return "failed", f"{STATE_FILE} is missing or damaged"
    status = cast("RunStatus", state["state"])
    if status != "running":
        return status, str(state.get("error") or "")
    owner = Process.from_plain(state)
    if owner is None or (owner.is_here and not owner.is_running):
        return "failed", "the process that ran it is gone"
    return "running", ""


def read_owner(folder: Path) -> Process | None:
    """The process that a run belongs to, or belonged to; None if that is not known."""
    try:
        return Process.from_plain(parse_object((folder / STATE_FILE).read_bytes()) or {})
    except OSError:
        return None


def index_row(
    shot: ShotRecord, target: TargetPattern, *, file: str, sha256: str, n_bytes: int
) -> dict[str, Any]:
    """A shot's line in the index. ``n_batches`` and ``n_atom_moves`` count what was played."""
    stage_s: dict[str, float] = {}
    for timing in shot.timing:
        stage_s[timing.stage] = stage_s.get(timing.stage, 0.0) + timing.duration_s
    played = [(cycle.n_batches_played, cycle.plan.batch_offsets) for cycle in shot.cycles]
    return {
        "shot": shot.shot_index,
        "attempt": shot.attempt,
        "counts": shot.status == "complete",
        "file": file,
        "status": shot.status,
        "error": shot.error,
        "t_start_utc": shot.t_start_utc,
        "t_end_utc": shot.t_end_utc,
        "success": shot.success,
        "filling_fraction": shot.filling_fraction,
        "seen_defect_free_cycle": shot.seen_defect_free_cycle,
        "n_cycles": len(shot.cycles),
        "n_images": len(shot.images),
        "n_batches": sum(n for n, _ in played),
        "n_atom_moves": sum(int(offsets[n]) for n, offsets in played),
        "n_missing_atoms": shot.n_missing_atoms,
        "stage_s": stage_s,
        "parameters": to_plain(shot.parameters),
        "readings": flat_readings(shot.readings),
        "calibrations": to_plain(shot.calibrations),
        **summarise(shot, target).as_row(),
        "sha256": sha256,
        "bytes": n_bytes,
    }


def is_index_row(row: Mapping[str, Any]) -> bool:
    """Whether a line of the index holds what a run cannot be shown without; other values may be missing."""
    return all(name in row and isinstance(row[name], kind) for name, kind in _IN_INDEX.items())


def is_skip_row(row: Mapping[str, Any], n_shots: int) -> bool:
    """Whether a line of skipped.jsonl names shots of a run, and says why they were left out."""
    shots, why = row.get("shots"), row.get("why")
    if not isinstance(shots, list) or not isinstance(why, str):
        return False
    return all(type(shot) is int and 0 <= shot < n_shots for shot in cast("list[Any]", shots))
