"""From run to run of a data folder."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from labseq.errors import RecordingError
from labseq.recording import folders
from labseq.recording.active import Marker, markers_in
from labseq.recording.doctor.findings import QUARANTINE, Damage, Report, quarantined
from labseq.recording.doctor.runs import holders_gone, is_there, names_in, repair_run, unreadable

_RUN_NAME: Final = re.compile(r"\d{4,}_.*", re.DOTALL)
_CLAIM: Final = re.compile(r"\.\d{4,}\.claim")
_YOUNG_S: Final = 60.0
"""What is younger may belong to a run that is just being made."""


def examine(path: Path, *, dry_run: bool = False) -> Report:
    """Look for damage in a data folder or in one run, and repair what can be repaired.

    Runs in progress are left alone.

    Args:
        path: The data folder, a day of it, or a run's folder.
        dry_run: Whether to change nothing.

    Raises:
        RecordingError: The folder cannot be read.
    """
    root, report = path.absolute(), Report()
    markers = markers_in(root if not _is_run(root) else root.parent.parent)
    living = {marker.run_dir for marker in markers if marker.is_active}
    for run_dir in _runs(root, report):
        if run_dir.resolve() in living or _is_being_made(run_dir):
            report.in_progress.append(run_dir)
        else:
            repair_run(run_dir, report, dry_run=dry_run)
    if not _is_run(root):
        damage = [*map(_stale, (one for one in markers if not one.is_active)), *_check_leftovers(root)]
        report.findings += [damaged_item.apply_repair(dry_run=dry_run) for damaged_item in damage]
    return report


def _runs(root: Path, report: Report) -> Iterator[Path]:
    """The folders of runs: the path itself, those in it, or those in its days."""
    if _is_run(root):
        yield root
        return
    for name in names_in(root):
        folder = root / name
        if name == QUARANTINE or name.startswith(".") or not folder.is_dir():
            continue
        if _is_run(folder):
            yield folder
            continue
        try:
            yield from [folder / inner for inner in names_in(folder) if _is_run(folder / inner)]
        except RecordingError as error:
            report.findings.append(unreadable(error).apply_repair(dry_run=True))


def _is_run(folder: Path) -> bool:
    if folder.name == QUARANTINE or not folder.is_dir():
        return False
    own = (folders.RUN_FILE, folders.STATE_FILE, folders.INDEX_FILE, folders.SHOTS_FOLDER)
    return _RUN_NAME.fullmatch(folder.name) is not None or any(is_there(folder / name) for name in own)


def _is_being_made(run_dir: Path) -> bool:
    return not is_there(run_dir / folders.RUN_FILE) and _is_young(run_dir)


def _is_young(path: Path) -> bool:
    try:
        return abs(time.time() - path.stat().st_mtime) < _YOUNG_S
    except OSError:
        return False


def _check_leftovers(root: Path) -> Iterator[Damage]:
    """Claims on numbers, notes on locks, and half-written markers that nobody takes away any more."""
    for folder in (root, *(root / name for name in names_in(root) if not name.startswith("."))):
        names: list[str] = []
        with suppress(RecordingError):  # told by whoever looks for runs in it
            names = names_in(folder)
        for name in names:
            if _CLAIM.fullmatch(name) and not _is_young(folder / name):
                yield quarantined("a claim on a run's number that nobody gave back", folder / name, folder)
    active = root / ".active"
    yield from holders_gone(active)
    for name in names_in(active):
        if name.endswith(".part") and not _is_young(active / name):
            yield quarantined("half-written", active / name, active)


def _stale(marker: Marker) -> Damage:
    what = "a run died here without making its hardware safe"
    profile = marker.profile or "PROFILE"
    return Damage(what, marker.path, f"left: 'labseq safe {profile}', or the next run on it, makes it safe")
