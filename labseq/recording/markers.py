"""Markers of runs in progress: which process uses which profile's hardware, for which run.

They are in the folder ``.active`` of the data root, and in the user's state folder for runs with another
data root, from before the devices are opened until they are safe again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from labseq.errors import RecordingError
from labseq.files import Process, explained, read_file, state_root, sync_folder, write_file
from labseq.plain import dumps, parse_object
from labseq.recording.folders import slug

ACTIVE_FOLDER: Final = ".active"


@dataclass(frozen=True, slots=True)
class Marker:
    """The content of a marker file.

    Attributes:
        path: The file.
        owner: The process; None if the file cannot be read.
        run_dir: The run's folder; None likewise.
        profile: Key of the profile; "" likewise.
    """

    path: Path
    owner: Process | None
    run_dir: Path | None
    profile: str

    @property
    def is_active(self) -> bool:
        """Whether its process is known to run; false for a process on another computer."""
        return self.owner is not None and self.owner.is_here and self.owner.is_running


def marker_roots(root: Path) -> tuple[Path, ...]:
    """Folders that hold the markers of a run: its data root, and the user's state folder if there is one.

    The paths are absolute because some vendors' libraries change the working folder.
    """
    state = state_root()
    return (root.absolute(), *(() if state is None else (state.absolute(),)))


def mark_active(roots: Sequence[Path], profile_key: str, run_dir: Path) -> None:
    """Mark that this process has a run in progress on a profile's hardware.

    Args:
        roots: See :func:`marker_roots`; only the first must be writable.
        profile_key: Key of the profile, for example its absolute path.

    Raises:
        RecordingError: The first root cannot be written to.
    """
    _mark(roots[0], profile_key, run_dir)
    for root in roots[1:]:
        with suppress(RecordingError):
            _mark(root, profile_key, run_dir)


def clear_active(roots: Sequence[Path], profile_key: str) -> None:
    """Remove this process's markers, and those of runs that died, once the hardware is safe.

    Markers of other running processes stay.

    Raises:
        RecordingError: A marker cannot be removed; all others are.
    """
    current = Process.current()
    failures: list[RecordingError] = []
    for marker in _markers(roots, profile_key):
        if not marker.is_active or (marker.owner and marker.owner.pid == current.pid):
            try:
                with explained(marker.path):
                    marker.path.unlink(missing_ok=True)
                    sync_folder(marker.path.parent)
            except RecordingError as failure:
                failures.append(failure)
    if failures:
        raise failures[0]


def find_dead_run(roots: Sequence[Path], profile_key: str) -> Path | None:
    """Find a run whose process died before it made a profile's hardware safe; None if there is none.

    Returns:
        Its folder, or the marker itself if that cannot be read. A run on another
        computer counts as dead, because its process cannot be looked up, and making
        hardware safe twice does no harm.
    """
    for marker in _markers(roots, profile_key):
        if not marker.is_active:
            return marker.run_dir or marker.path
    return None


def lock_files(roots: Sequence[Path], profile_key: str) -> tuple[Path, ...]:
    """Files to lock so that no other process uses a profile's hardware: one in each root."""
    return tuple(root / ACTIVE_FOLDER / f"{_stem(profile_key)}.lock" for root in roots)


def runs_in_progress(roots: Sequence[Path]) -> dict[Path, str]:
    """Runs in progress on this computer: folder -> key of the profile."""
    markers = [marker for root in roots for marker in markers_in(root) if marker.is_active]
    return {marker.run_dir: marker.profile for marker in markers if marker.run_dir is not None}


def markers_in(root: Path) -> list[Marker]:
    """The markers of all profiles in a data root."""
    return [_read(path) for path in _files(root)]


def _mark(root: Path, profile_key: str, run_dir: Path) -> None:
    owner = Process.current()
    marker = root / ACTIVE_FOLDER / f"{_stem(profile_key)}.{owner.pid}.json"
    with explained(marker):
        marker.parent.mkdir(parents=True, exist_ok=True)
        sync_folder(root)
    values = {"profile": profile_key, "run_dir": str(run_dir.resolve()), **asdict(owner)}
    write_file(marker, dumps(values).encode() + b"\n")


def _stem(profile_key: str) -> str:
    digest = hashlib.sha256(profile_key.encode("utf-8", "backslashreplace")).hexdigest()[:12]
    return f"{slug(profile_key)[-40:]}-{digest}"


def _markers(roots: Sequence[Path], profile_key: str) -> list[Marker]:
    """The markers of a profile, oldest name first."""
    return [_read(path) for root in roots for path in _files(root, _stem(profile_key)) if path.exists()]


def _read(path: Path) -> Marker:
    try:
        values = parse_object(read_file(path)) or {}
    except RecordingError:
        values = {}
    run_dir, profile = values.get("run_dir"), values.get("profile")
    return Marker(
        path,
        Process.from_plain(values),
        Path(run_dir) if isinstance(run_dir, str) else None,
        profile if isinstance(profile, str) else "",
    )


def _files(root: Path, stem: str = "") -> list[Path]:
    folder = root / ACTIVE_FOLDER
    try:
        names = sorted(entry.name for entry in folder.iterdir())
    except OSError:  # there is no such folder, or it cannot be read
        return []
    return [folder / name for name in names if name.startswith(stem) and name.endswith(".json")]
