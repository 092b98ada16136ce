"""Reads what the list of runs shows about a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from labseq.data.entry import RunEntry
from labseq.data.reader import Run, open_run
from labseq.data.results import results_of
from labseq.data.scanned import scanned
from labseq.errors import LabseqError, RecordingError
from labseq.recording.notes import read_notes


def read_entry(folder: Path) -> RunEntry:
    """Read a run's files. A damaged run gives an entry with the error."""
    notes = read_notes(folder)
    entry = RunEntry(folder, note=notes.comment, tags=notes.tags)
    try:
        return _described(entry)
    except (RecordingError, OSError) as failure:
        return replace(entry, error=str(failure))


def _described(entry: RunEntry) -> RunEntry:
    run = open_run(entry.path)
    resolved: Mapping[str, Any] = run.record.get("resolved") or {}
    overrides: Mapping[str, Any] = run.record.get("overrides") or {}
    return replace(
        entry,
        t_start_utc=str(run.record.get("t_start_utc") or ""),
        name=run.name,
        sequence=Path(str(run.record.get("sequence_path") or "")).stem,
        profile=str((resolved.get("profile") or {}).get("name") or ""),
        target="" if run.target.is_none else run.target.name,
        status=run.status,
        error=run.error,
        simulated=run.simulated,
        seed=run.seed,
        shots=len(run.shots),
        n_shots=run.n_shots,
        bytes=sum(shot.row.bytes for shot in (*run.shots, *run.attempts)),
        changes=run.changes,
        settings={address: change.get("value") for address, change in overrides.items()},
        calibrations=run.record.get("calibrations") or {},
        **_measured(run),
    )


def _measured(run: Run) -> dict[str, Any]:
    """The scanned values and the results. A damaged scan or result is left out."""
    values: dict[str, Any] = {}
    with suppress(LabseqError, LookupError, TypeError, ValueError):
        scan = scanned(run)
        axes = () if scan is None else scan.axes
        values["scanned"] = {axis.address: _range_text(axis.labels) for axis in axes}
        values["results"] = tuple(results_of(run))
    return values


def _range_text(labels: Sequence[str]) -> str:
    if len(labels) < 3:
        return " and ".join(labels)
    return f"{labels[0]} to {labels[-1]}, {len(labels)} values"
