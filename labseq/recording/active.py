"""Markers of runs in progress: after a run that died, the next one makes the hardware safe first.

A marker belongs to a profile (its hardware) and to a process. It stands in
``<root>/.active`` from before the devices are opened until they are safe again.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from pathlib import Path
from typing import Final

from labseq.recording.durable import explained, parse_object, sync_folder, write_file
from labseq.recording.folders import slug
from labseq.recording.plain import dumps
from labseq.recording.process import Owner

_FOLDER: Final = ".active"


def mark_active(root: Path, profile_key: str, run_dir: Path) -> None:
    """Mark that this process has a run in progress on a profile's hardware.

    Args:
        root: Data root.
        profile_key: What stands for the profile, for example its absolute path.
        run_dir: The run's folder.

    Raises:
        RecordingError: The data root cannot be written to.
    """
    owner = Owner.current()
    marker = root / _FOLDER / f"{_stem(profile_key)}.{owner.pid}.json"
    with explained(marker):
        marker.parent.mkdir(parents=True, exist_ok=True)
        sync_folder(root)
    values = {"profile": profile_key, "run_dir": str(run_dir.resolve()), **asdict(owner)}
    write_file(marker, dumps(values).encode() + b"\n")


def clear_active(root: Path, profile_key: str) -> None:
    """Remove this process's marker, and those of runs that died, now that the hardware is safe.

    Markers of other living processes stay.

    Raises:
        RecordingError: A marker cannot be removed.
    """
    current = Owner.current()
    for marker, owner, _ in _markers(root, profile_key):
        if owner is None or owner.pid == current.pid or _is_gone(owner):
            with explained(marker):
                marker.unlink(missing_ok=True)
                sync_folder(marker.parent)


def died(root: Path, profile_key: str) -> Path | None:
    """The run, if there is one, that died on a profile's hardware without making it safe.

    Returns:
        Its folder, or the marker itself if that cannot be read. A run on another
        computer counts as dead: nobody here can tell, and being safe twice harms
        nothing.
    """
    for marker, owner, run_dir in _markers(root, profile_key):
        if owner is None or _is_gone(owner):
            return run_dir or marker
    return None


def _is_gone(owner: Owner) -> bool:
    return not (owner.is_here and owner.lives)


def _stem(profile_key: str) -> str:
    digest = hashlib.sha256(profile_key.encode("utf-8", "backslashreplace")).hexdigest()[:12]
    return f"{slug(profile_key)[-40:]}-{digest}"


def _markers(root: Path, profile_key: str) -> list[tuple[Path, Owner | None, Path | None]]:
    """Each marker of a profile with the process and the run that it names, oldest name first."""
    found: list[tuple[Path, Owner | None, Path | None]] = []
    stem = _stem(profile_key)
    folder = root / _FOLDER
    names = sorted(entry.name for entry in folder.iterdir()) if folder.is_dir() else []
    for marker in (folder / name for name in names if name.startswith(stem) and name.endswith(".json")):
        try:
            values = parse_object(marker.read_bytes()) or {}
        except FileNotFoundError:
            continue  # its process has just ended
        except OSError:
            values = {}
        run_dir = values.get("run_dir")
        found.append((marker, Owner.from_plain(values), Path(run_dir) if isinstance(run_dir, str) else None))
    return found
