"""What is known of a run when it starts."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from labseq.calibrations import encode_entry
from labseq.errors import StopRequested
from labseq.model import CalibrationEntry, RunRecord
from labseq.model.records import RunStatus
from labseq.session.assembly import Assembly
from labseq.session.provenance import gather_provenance


def run_record(
    assembly: Assembly, seed: int, changes: Mapping[str, Any], scan: Mapping[str, Any], folder: Path
) -> RunRecord:
    """What is known of a run before anything is opened.

    Args:
        assembly: The run.
        seed: Its seed.
        changes: What options changed: address -> value.
        scan: Its scan, see :meth:`labseq.session.scan_run.Course.record`.
        folder: The working folder, absolute: relative paths in the settings are relative to it.
    """
    spec, bench = assembly.sequence, assembly.bench
    return RunRecord(
        name=spec.name,
        n_shots=spec.shots,
        seed=seed,
        simulated=assembly.virtual_time,
        t_start_utc=now_utc(),
        target=assembly.target,
        sequence_text=assembly.document.text,
        profile_text=bench.document.text,
        sequence_path=str(folder / assembly.document.path),
        profile_path=str(folder / bench.document.path),
        resolved=assembly.resolved,
        overrides=changes,
        devices={},
        plugins=plugins_of(assembly),
        provenance=gather_provenance((folder / assembly.document.path).parent) | {"folder": str(folder)},
        record_frames=spec.record_frames,
        grid_spacing_m=bench.grid.spacing_m,
        lattice=bench.grid.lattice,
        scan=scan,
        calibrations={kind: entry.id for kind, entry in bench.calibrations.items()},
    )


def copies(calibrations: Mapping[str, CalibrationEntry]) -> dict[str, bytes | str]:
    """The calibrations in use as files for the run's folder: name -> content."""
    return {f"calibration_{kind}.json": encode_entry(entry) for kind, entry in calibrations.items()}


def ending(error: BaseException | None) -> tuple[RunStatus, str]:
    """How a run ended, and why."""
    if error is None:
        return "complete", ""
    if isinstance(error, StopRequested):
        return "stopped", str(error)
    status: RunStatus = "stopped" if isinstance(error, KeyboardInterrupt) else "failed"
    return status, f"{type(error).__name__}: {error}"


def plugins_of(assembly: Assembly) -> tuple[dict[str, str], ...]:
    """Name, origin and version of each plugin that a run uses."""
    used = [*assembly.bench.chosen.values(), assembly.planner]
    used += [] if assembly.search is None else [assembly.search.chosen]
    origins = {item.entry.origin for item in used}
    return tuple(
        {"name": info.name, "origin": info.origin, "version": info.version}
        for info in assembly.bench.host.infos
        if info.name in origins
    )


def now_utc() -> str:
    """Wall time, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="microseconds")
