"""run.json, STATE and the lines of the index: a run's record in JSON, and back."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from types import UnionType
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

import labseq
from labseq.errors import RecordingError
from labseq.model import RunRecord, ShotRecord, TargetPattern
from labseq.model.records import RunStatus
from labseq.recording import layout
from labseq.recording.durable import parse_object
from labseq.recording.folders import PROFILE_FILE, RUN_FILE, SEQUENCE_FILE, STATE_FILE
from labseq.recording.plain import dumps, to_plain
from labseq.recording.process import Owner
from labseq.recording.summaries import flat_readings, summarise

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
    return dumps({"state": status, **asdict(Owner.current()), "error": error}).encode() + b"\n"


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
    owner = Owner.from_plain(state)
    if owner is None or (owner.is_here and not owner.lives):
        return "failed", "the process that ran it is gone"
    return "running", ""


def read_owner(folder: Path) -> Owner | None:
    """The process that a run belongs to, or belonged to; None if that is not known."""
    try:
        return Owner.from_plain(parse_object((folder / STATE_FILE).read_bytes()) or {})
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
