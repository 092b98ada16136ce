"""Writes and reads run.json and STATE."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

import labseq
from labseq.errors import RecordingError
from labseq.files import read_file
from labseq.messages import clean
from labseq.model import RunRecord, TargetPattern
from labseq.model.records import RunStatus
from labseq.plain import dumps, parse_object
from labseq.processes import Process
from labseq.recording import schema
from labseq.recording.folders import PROFILE_FILE, RUN_FILE, SEQUENCE_FILE, STATE_FILE

SCANNER: Final = "scanner"
"""Key that only the record of an adaptive scan has, for the scanner and its settings."""
WRITTEN_UNITS: Final = "written_units"
"""Key in the record of a scan whose points are chosen during the run: the units of its written values."""

STATUSES: Final = ("running", "complete", "stopped", "failed")


class OtherFormatError(RecordingError):
    """A file was written in a format that this version of labseq cannot read."""


def check_version(path: Path, version: str, own_version: str) -> None:
    """Raise if the format of a file has another major version.

    Args:
        own_version: The version that this labseq writes.
    """
    version = clean(version)
    major = version.partition(".")[0]
    if not major.isdecimal():
        advice = f"expected a version like {own_version}; restore it from a backup"
        raise RecordingError(path, f"has the format version '{version}'", advice)
    if major != own_version.partition(".")[0]:
        development = "the development version of labseq 0.2.0 that wrote it"
        reader = {1: "labseq 0.1.0", 2: development, 3: development}.get(int(major), "")
        advice = f"use {reader} to read it" if reader else "update labseq"
        raise OtherFormatError(path, f"has format version {version}, this labseq reads {own_version}", advice)


def sha256_of_text(text: str) -> str:
    """SHA-256 of a text's bytes, in hexadecimal."""
    return hashlib.sha256(encode_text(text)).hexdigest()


def encode_text(text: str) -> bytes:
    """Encode a text to exactly the bytes that it was decoded from."""
    # a sequence file may hold bytes that are not UTF-8, for example in a comment
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
        RecordingError: It is damaged, or has another format.
    """
    path = folder / RUN_FILE
    record = parse_object(read_file(path))
    if record is None or record.get("format") != schema.RUN_FORMAT:
        raise RecordingError(path, "is damaged, or was not written by labseq", "restore it from a backup")
    check_version(path, str(record.get("format_version")), schema.RUN_FORMAT_VERSION)
    required = {"name": str, "n_shots": int, "seed": int, "simulated": bool, "target": dict}
    optional = ("units", "overrides", "scan", "devices", "resolved", "provenance")
    wrong = [name for name, kind in required.items() if not isinstance(record.get(name), kind)]
    wrong += [name for name in optional if not isinstance(record.get(name) or {}, dict)]
    # counts are columns of int64 in tables
    if not wrong and not 0 <= record["n_shots"] < 2**63:
        wrong = ["n_shots"]
    changes: dict[str, Any] = record.get("overrides") or {}
    if not wrong and not all(isinstance(change, dict) and "written" in change for change in changes.values()):
        wrong = ["overrides"]
    if wrong:
        raise RecordingError(path, f"is damaged: it has no valid '{wrong[0]}'", "restore it from a backup")
    return record


def read_record(folder: Path) -> RunRecord:
    """The record of a run, read from run.json as :func:`encode_run` writes it.

    Raises:
        RecordingError: It is damaged, or has another format.
    """
    path, values = folder / RUN_FILE, read_run(folder)
    arguments: dict[str, Any] = {name: values[name] for name in RunRecord.__match_args__ if name in values}
    arguments |= {"target": target_of(path, values), "scan": values.get("scan") or {}}
    try:
        return RunRecord(**arguments)
    except TypeError as error:  # a value is missing
        raise RecordingError(path, f"is damaged: {error}", "restore it from a backup") from error


def target_of(path: Path, record: Mapping[str, Any]) -> TargetPattern:
    """The target of a run from run.json.

    Raises:
        RecordingError: The target is damaged.
    """
    try:
        target = record["target"]
        regions = regions_of(record.get("resolved") or {})
        return TargetPattern(_grid(target["fill"]), _grid(target["clear"]), str(target["name"]), regions)
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(path, f"has a damaged target: {error!r}", "restore it from a backup") from error


def regions_of(resolved: Mapping[str, Any]) -> dict[str, NDArray[np.bool_]]:
    """The regions in the settings of a run. Runs of earlier versions have none."""
    return {name: _grid(rows) for name, rows in resolved.get("regions", {}).items()}


def plain_regions(target: TargetPattern) -> dict[str, list[str]]:
    """The regions of a target in the form of a run's settings, with a text of 0 and 1 for each row."""
    return {name: _rows(mask) for name, mask in target.regions.items()}


def _rows(sites: NDArray[np.bool_]) -> list[str]:
    return ["".join("1" if site else "0" for site in row) for row in sites]


def _grid(rows: list[str]) -> NDArray[np.bool_]:
    return np.array([[site == "1" for site in row] for row in rows], np.bool_).reshape(len(rows), -1)


def encode_state(status: RunStatus, error: str = "", ended_early: str = "") -> bytes:
    """The content of STATE: one line with the status and the process that takes the run."""
    ends = {"error": error, "ended_early": ended_early}
    return dumps({"state": status, **asdict(Process.current()), **ends}).encode() + b"\n"


def read_state_file(folder: Path) -> dict[str, Any]:
    """The content of STATE as it is. Empty if it is missing or damaged."""
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


def describe_end(folder: Path) -> str:
    """How a run that may have left devices on has ended, as the end of a sentence about it."""
    state = read_state_file(folder)
    if state.get("state") in (None, "running"):
        return "died"
    error = state.get("error")
    return f"did not leave all of them safe ({error})" if error else "did not leave all of them safe"


def read_owner(folder: Path) -> Process | None:
    """The process that takes or took a run. None if unknown."""
    return Process.from_plain(read_state_file(folder))


def is_skip_row(row: Mapping[str, Any], n_shots: int) -> bool:
    """Whether a line of skipped.jsonl has valid shot indices and a reason."""
    shots, why = row.get("shots"), row.get("why")
    if not isinstance(shots, list) or not isinstance(why, str):
        return False
    return all(type(shot) is int and 0 <= shot < n_shots for shot in cast("list[Any]", shots))
