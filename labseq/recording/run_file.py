"""Writes and reads run.json, STATE and the lines of a run's index.

A shot's line in the index also sums up its images and cycles, so that a run of many thousand shots is
evaluated without opening their files.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from numbers import Real
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

import labseq
from labseq.errors import RecordingError
from labseq.files import read_file
from labseq.messages import clean
from labseq.model import RunRecord, ShotRecord, TargetPattern
from labseq.model.records import RunStatus
from labseq.plain import dumps, parse_object, to_plain
from labseq.processes import Process
from labseq.recording import schema
from labseq.recording.folders import PROFILE_FILE, RUN_FILE, SEQUENCE_FILE, SHOTS_FOLDER, STATE_FILE

SIMULATION: Final = "simulation."
"""Prefix of the names of readings that only a simulation can know."""

SHOT_FILE: Final = re.compile(SHOTS_FOLDER + r"/shot_\d{6,}(\.attempt_\d+)?(\.take_(\d+))?\.h5")
"""A shot's file in a line of the index."""

STATUSES: Final = ("running", "complete", "stopped", "failed")

_DEVELOPED: Final = "the development version of labseq 0.2.0 that wrote it"
_READ_BY: Final = {1: "labseq 0.1.0", 2: _DEVELOPED, 3: _DEVELOPED}
"""Older major version of the format -> the labseq that reads it."""
_MAX_TEXT: Final = 80
_MAX_DEPTH: Final = 4


class OtherFormatError(RecordingError):
    """A file was written in a format that this version of labseq cannot read."""


def check_version(path: Path, found: str, known: str) -> None:
    """Raise for a file whose format has another major version."""
    found = clean(found)
    major = found.partition(".")[0]
    if not major.isdecimal():
        advice = f"expected one like {known}; it is damaged"
        raise RecordingError(path, f"has the format version '{found}'", advice)
    if major != known.partition(".")[0]:
        reader = _READ_BY.get(int(major), "")
        advice = f"use {reader} to read it" if reader else "update labseq"
        raise OtherFormatError(path, f"has format version {found}, this labseq reads {known}", advice)


_MAX_INT: Final = 2**63
_DICTS_IN_RUN: Final = ("units", "overrides", "scan", "devices", "resolved", "provenance")
_IN_RUN: Final = {"name": str, "n_shots": int, "seed": int, "simulated": bool, "target": dict}


def sha256_of_text(text: str) -> str:
    """SHA-256 of a text's bytes, in hexadecimal."""
    return hashlib.sha256(encode_text(text)).hexdigest()


def encode_text(text: str) -> bytes:
    """Encode a text to exactly the bytes that it was decoded from."""
    return text.encode("utf-8", "surrogateescape")


def encode_run(run: RunRecord, run_id: str) -> bytes:
    """The content of run.json."""
    values = {
        "format": schema.RUN_FORMAT,
        "format_version": schema.RUN_FORMAT_VERSION,
        "creator": f"labseq {labseq.__version__}",
        "run_id": run_id,
        **{field.name: getattr(run, field.name) for field in fields(run)},
        "target": {"name": run.target.name, "fill": _rows(run.target.fill), "clear": _rows(run.target.clear)},
        "sequence_file": SEQUENCE_FILE,
        "sequence_sha256": sha256_of_text(run.sequence_text),
        "profile_file": PROFILE_FILE,
        "profile_sha256": sha256_of_text(run.profile_text),
    }
    return dumps(values, indent=1).encode() + b"\n"


def read_run(folder: Path) -> dict[str, Any]:
    """Read run.json.

    Raises:
        RecordingError: It is damaged, or of another format.
    """
    path = folder / RUN_FILE
    record = parse_object(read_file(path))
    if record is None or record.get("format") != schema.RUN_FORMAT:
        raise RecordingError(path, "is damaged, or not labseq's", "restore it from a backup")
    check_version(path, str(record.get("format_version")), schema.RUN_FORMAT_VERSION)
    wrong = [name for name, kind in _IN_RUN.items() if not isinstance(record.get(name), kind)]
    wrong += [name for name in _DICTS_IN_RUN if not isinstance(record.get(name) or {}, dict)]
    if not wrong and not 0 <= record["n_shots"] < _MAX_INT:
        wrong = ["n_shots"]
    changes: dict[str, Any] = record.get("overrides") or {}
    if not wrong and not all(isinstance(one, dict) and "written" in one for one in changes.values()):
        wrong = ["overrides"]
    if wrong:
        raise RecordingError(path, f"is damaged: it has no valid '{wrong[0]}'", "restore it from a backup")
    return record


def target_of(path: Path, record: Mapping[str, Any]) -> TargetPattern:
    """The target in run.json.

    Raises:
        RecordingError: It is damaged.
    """
    try:
        target = record["target"]
        return TargetPattern(_grid(target["fill"]), _grid(target["clear"]), str(target["name"]))
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(path, f"has a damaged target: {error!r}", "restore it from a backup") from error


def _rows(sites: NDArray[np.bool_]) -> list[str]:
    return ["".join("1" if site else "0" for site in row) for row in sites]


def _grid(rows: list[str]) -> NDArray[np.bool_]:
    return np.array([[site == "1" for site in row] for row in rows], np.bool_).reshape(len(rows), -1)


def encode_state(status: RunStatus, error: str = "") -> bytes:
    """The content of STATE: one line with the status, and the process that runs the run."""
    return dumps({"state": status, **asdict(Process.current()), "error": error}).encode() + b"\n"


def read_state_file(folder: Path) -> dict[str, Any]:
    """The content of STATE as it is; empty if it is missing or damaged."""
    try:
        return parse_object(read_file(folder / STATE_FILE)) or {}
    except RecordingError:
        return {}


def read_state(folder: Path) -> tuple[RunStatus, str]:
    """Status of a run, and the error that ended it.

    A "running" run whose process has ended counts as failed. For a run on another computer, whose
    process cannot be checked, the recorded status is returned.
    """
    state = read_state_file(folder)
    if state.get("state") not in STATUSES:
        return "failed", f"{STATE_FILE} is missing or damaged"
    status = cast("RunStatus", state["state"])
    if status != "running":
        return status, str(state.get("error") or "")
    process = Process.from_plain(state)
    if process is None or (process.is_here and not process.is_running):
        return "failed", "the process that ran it is gone"
    return "running", ""


def read_owner(folder: Path) -> Process | None:
    """The process that runs or ran a run; None if unknown."""
    return Process.from_plain(read_state_file(folder))


@dataclass(frozen=True, slots=True)
class Images:
    """The images of a shot, in the order they were taken.

    Attributes:
        cycle: Index of the cycle that each ended, within its step; -1 for that of an ``image`` step.
        t_start_s: Start of each exposure, from the start of the shot.
        exposure_s: Exposure times.
        n_atoms: Atoms on each.
        n_defects: Empty target sites on each.
        n_surplus: Atoms on each on sites that must be empty.
    """

    cycle: tuple[int, ...] = ()
    t_start_s: tuple[float, ...] = ()
    exposure_s: tuple[float, ...] = ()
    n_atoms: tuple[int, ...] = ()
    n_defects: tuple[int, ...] = ()
    n_surplus: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.cycle)


@dataclass(frozen=True, slots=True)
class Cycles:
    """The rearrangement cycles of a shot, in the order they were made.

    Attributes:
        n_batches: Batches of each plan.
        n_batches_played: Number of them that fitted into the window.
        n_atom_moves: Atom moves in those that were played.
    """

    n_batches: tuple[int, ...] = ()
    n_batches_played: tuple[int, ...] = ()
    n_atom_moves: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.n_batches)


@dataclass(frozen=True, slots=True)
class ShotSummary:
    """The main results of a shot, from its line in the index.

    Attributes:
        images: Its images.
        cycles: Its cycles.
        simulation: True values that a simulation reported, such as "lost.vacuum"; empty on real hardware.
    """

    images: Images
    cycles: Cycles
    simulation: Mapping[str, float]

    @property
    def is_judged(self) -> bool:
        """Whether the last image is not that of a cycle, whose result may have ended the rearrangement."""
        return all(cycle < 0 for cycle in self.images.cycle[-1:])


def summarise(shot: ShotRecord, target: TargetPattern) -> ShotSummary:
    """Sum up a shot."""
    occupancies = [image.occupancy.reshape(target.shape) for image in shot.images]
    images = Images(
        cycle=tuple(image.cycle for image in shot.images),
        t_start_s=tuple(round(float(image.t_start_s), 9) for image in shot.images),
        exposure_s=tuple(float(image.exposure_s) for image in shot.images),
        n_atoms=tuple(map(int, map(np.count_nonzero, occupancies))),
        n_defects=tuple(map(target.n_defects, occupancies)),
        n_surplus=tuple(map(target.n_surplus, occupancies)),
    )
    cycles = Cycles(
        n_batches=tuple(cycle.plan.n_batches for cycle in shot.cycles),
        n_batches_played=tuple(cycle.n_batches_played for cycle in shot.cycles),
        n_atom_moves=tuple(cycle.n_atom_moves_played for cycle in shot.cycles),
    )
    simulation = {
        name.removeprefix(SIMULATION): float(value)
        for name, value in shot.readings.items()
        if name.startswith(SIMULATION) and isinstance(value, Real)
    }
    return ShotSummary(images, cycles, simulation)


def summary_of(row: Mapping[str, Any]) -> ShotSummary:
    """The summary in a line of the index.

    Raises:
        RecordingError: The line is damaged.
    """
    try:
        simulation = {str(name): _number(value) for name, value in row["simulation"].items()}
        return ShotSummary(_columns(Images, row["images"]), _columns(Cycles, row["cycles"]), simulation)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        what = f"has a damaged line for shot {row.get('shot')}"
        raise RecordingError("index.jsonl", what, "'labseq doctor' moves it away") from error


_T = TypeVar("_T", Images, Cycles)


def _columns(kind: type[_T], table: Mapping[str, Any]) -> _T:
    columns = [tuple(map(_number, table[name])) for name in kind.__match_args__]
    if len({*map(len, columns)}) > 1:
        raise ValueError(kind.__name__)
    return kind(*columns)


def _number(value: Any) -> Any:
    """A number of the index; JSON has null for nan and infinities."""
    kind = type(value)
    if kind is float or (kind is int and -_MAX_INT <= value < _MAX_INT):
        return value
    if value is None:
        return math.nan
    raise TypeError(value)


def index_row(
    shot: ShotRecord, target: TargetPattern, *, file: str, sha256: str, n_bytes: int
) -> dict[str, Any]:
    """A shot's line in the index."""
    stage_s: dict[str, float] = {}
    for timing in shot.timing:
        stage_s[timing.stage] = stage_s.get(timing.stage, 0.0) + timing.duration_s
    return {
        **{field.name: field.value(shot) for field in schema.IN_INDEX},
        "success": None if math.isnan(shot.filling_fraction) else shot.success,
        "counts": shot.status == "complete",
        "stage_s": stage_s,
        "parameters": to_plain(shot.parameters),
        "readings": flat_readings(shot.readings),
        "calibrations": to_plain(shot.calibrations),
        **asdict(summarise(shot, target)),
        "file": file,
        "sha256": sha256,
        "bytes": n_bytes,
    }


def flat_readings(readings: Mapping[str, Any]) -> dict[str, Any]:
    """The readings that are single values, by dotted name, except those of a simulation.

    Example:
        >>> flat_readings({"laser": {"power_w": 0.1, "trace": [1, 2]}, "simulation.lost.vacuum": 2.0})
        {'laser.power_w': 0.1}
    """
    real = {name: value for name, value in readings.items() if not name.startswith(SIMULATION)}
    return dict(_flat("", to_plain(real), _MAX_DEPTH))


def _flat(prefix: str, values: Mapping[str, Any], depth: int) -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict) and depth:
            yield from _flat(f"{prefix}{name}.", cast("dict[str, Any]", value), depth - 1)
        elif isinstance(value, bool | int | float) or (isinstance(value, str) and len(value) <= _MAX_TEXT):
            yield f"{prefix}{name}", value


_NONE: Final = type(None)
_KINDS: Final = {"int64": int, "bool": (bool, _NONE), "text": str, "float64": (float, int, _NONE)}
_KINDS_IN_INDEX: Final = tuple((field.name, _KINDS[field.dtype]) for field in schema.IN_INDEX)
_ALWAYS: Final = ("shot", "attempt", "status", "success", "filling_fraction", "seen_defect_free_cycle")
_NEEDED_IN_INDEX: Final = (
    *((name, kind) for name, kind in _KINDS_IN_INDEX if name in _ALWAYS),
    *dict.fromkeys(("stage_s", "parameters", "readings", "calibrations"), dict).items(),
    *dict.fromkeys(("images", "cycles", "simulation"), dict).items(),
    *{"counts": bool, "file": str, "sha256": str, "bytes": int}.items(),
)
_NOTHING: Final = object()


class RunTime:
    """The time that a run has taken, from the times in its event log, which no change of the clock moves.

    Attributes:
        total_s: Of all parts of the run together; the time between a part and its resuming is not counted.
    """

    def __init__(self) -> None:
        self.total_s = self._last_s = 0.0

    def advance(self, t_s: Any) -> None:
        """Go on to a line of the event log; each part of the run begins at 0."""
        if type(t_s) in (int, float) and 0 <= t_s < 1e12:
            self.total_s += t_s - self._last_s if t_s >= self._last_s else t_s
            self._last_s = t_s


def is_index_row(row: Mapping[str, Any]) -> bool:
    """Whether a line of the index is complete; values that an older minor format lacks may be missing."""
    if not all(isinstance(row.get(name, _NOTHING), kind) for name, kind in _NEEDED_IN_INDEX):
        return False
    if not all(isinstance(row.get(name), kind) for name, kind in _KINDS_IN_INDEX if name in row):
        return False
    if not SHOT_FILE.fullmatch(row["file"]) or not all(
        -_MAX_INT <= value < _MAX_INT for value in row.values() if type(value) is int
    ):
        return False
    try:
        summary_of(row)
    except RecordingError:
        return False
    return all(type(seconds) in (int, float, type(None)) for seconds in row["stage_s"].values())


def is_skip_row(row: Mapping[str, Any], n_shots: int) -> bool:
    """Whether a line of skipped.jsonl has valid shot indices and a reason."""
    shots, why = row.get("shots"), row.get("why")
    if not isinstance(shots, list) or not isinstance(why, str):
        return False
    return all(type(shot) is int and 0 <= shot < n_shots for shot in cast("list[Any]", shots))
