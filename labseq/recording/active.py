"""Markers of runs in progress: after a run that died, the next one makes the hardware safe first.

A marker belongs to a profile (its hardware) and to a process. It stands in the folder
``.active`` of the data root, and in that of the user's state folder for runs whose data
lie elsewhere, from before the devices are opened until they are safe again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Final

from labseq.errors import RecordingError
from labseq.recording.durable import explained, parse_object, sync_folder, write_file
from labseq.recording.folders import slug, state_root
from labseq.recording.plain import dumps
from labseq.recording.process import Owner

_FOLDER: Final = ".active"


def marker_roots(root: Path) -> tuple[Path, ...]:
    """Where the markers of a run stand: in its data root, and in the user's state folder if there is one.

    The paths are absolute: some vendors' libraries change the working folder.
    """
    state = state_root()
    return (root.absolute(), *(() if state is None else (state.absolute(),)))


def mark_active(roots: Sequence[Path], profile_key: str, run_dir: Path) -> None:
    """Mark that this process has a run in progress on a profile's hardware.

    Args:
        roots: See :func:`marker_roots`; the first must take the marker, the others need not.
        profile_key: What stands for the profile, for example its absolute path.
        run_dir: The run's folder.

    Raises:
        RecordingError: The first root cannot be written to.
    """
    _mark(roots[0], profile_key, run_dir)
    for root in roots[1:]:
        with suppress(RecordingError):
            _mark(root, profile_key, run_dir)


def clear_active(roots: Sequence[Path], profile_key: str) -> None:
    """Remove this process's markers, and those of runs that died, now that the hardware is safe.

    Markers of other living processes stay.

    Raises:
        RecordingError: A marker cannot be removed; all others are.
    """
    current = Owner.current()
    failures: list[RecordingError] = []
    for marker, owner, _ in _markers(roots, profile_key):
        if owner is None or owner.pid == current.pid or _is_gone(owner):
            try:
                with explained(marker):
                    marker.unlink(missing_ok=True)
                    sync_folder(marker.parent)
            except RecordingError as failure:
                failures.append(failure)
    if failures:
        raise failures[0]


def died(roots: Sequence[Path], profile_key: str) -> Path | None:
    """The run, if there is one, that died on a profile's hardware without making it safe.

    Returns:
        Its folder, or the marker itself if that cannot be read. A run on another
        computer counts as dead: nobody here can tell, and being safe twice harms
        nothing.
    """
    for marker, owner, run_dir in _markers(roots, profile_key):
        if owner is None or _is_gone(owner):
            return run_dir or marker
    return None


def in_progress(roots: Sequence[Path], profile_key: str) -> Path | None:
    """The run, if there is one, that a living process here has in progress on a profile's hardware.

    Returns:
        Its folder, or the marker itself if that tells none.
    """
    for marker, owner, run_dir in _markers(roots, profile_key):
        if owner is not None and not _is_gone(owner):
            return run_dir or marker
    return None


def _mark(root: Path, profile_key: str, run_dir: Path) -> None:
    owner = Owner.current()
    marker = root / _FOLDER / f"{_stem(profile_key)}.{owner.pid}.json"
    with explained(marker):
        marker.parent.mkdir(parents=True, exist_ok=True)
        sync_folder(root)
    values = {"profile": profile_key, "run_dir": str(run_dir.resolve()), **asdict(owner)}
    write_file(marker, dumps(values).encode() + b"\n")


def _is_gone(owner: Owner) -> bool:
    return not (owner.is_here and owner.lives)


def _stem(profile_key: str) -> str:
    digest = hashlib.sha256(profile_key.encode("utf-8", "backslashreplace")).hexdigest()[:12]
    return f"{slug(profile_key)[-40:]}-{digest}"


def _markers(roots: Sequence[Path], profile_key: str) -> list[tuple[Path, Owner | None, Path | None]]:
    """Each marker of a profile with the process and the run that it names, oldest name first."""
    found: list[tuple[Path, Owner | None, Path | None]] = []
    for marker in (path for root in roots for path in _files(root, _stem(profile_key))):
        try:
            values = parse_object(marker.read_bytes()) or {}
        except FileNotFoundError:
            continue  # its process has just ended
        except OSError:
            values = {}
        run_dir = values.get("run_dir")
        found.append((marker, Owner.from_plain(values), Path(run_dir) if isinstance(run_dir, str) else None))
    return found


def _files(root: Path, stem: str) -> list[Path]:
    folder = root / _FOLDER
    try:
        names = sorted(entry.name for entry in folder.iterdir())
    except OSError:  # there is none, or none that can be looked into
        return []
    return [folder / name for name in names if name.startswith(stem) and name.endswith(".json")]
