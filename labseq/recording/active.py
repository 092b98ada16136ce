"""Markers of runs in progress: after a run that died, the next one makes the hardware safe first.

A marker belongs to a profile (its hardware) and to a process. It stands in the folder
``.active`` of the data root, and in that of the user's state folder for runs whose data
lie elsewhere, from before the devices are opened until they are safe again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from labseq.errors import RecordingError
from labseq.recording.durable import explained, parse_object, sync_folder, write_file
from labseq.recording.folders import slug, state_root
from labseq.recording.plain import dumps
from labseq.recording.process import Owner

_FOLDER: Final = ".active"


@dataclass(frozen=True, slots=True)
class Marker:
    """A marker, as its file has it.

    Attributes:
        path: The file.
        owner: The process; None if the file cannot be read.
        run_dir: The run's folder; None likewise.
        profile: What stands for the profile; "" likewise.
    """

    path: Path
    owner: Owner | None
    run_dir: Path | None
    profile: str

    @property
    def is_active(self) -> bool:
        """Whether its process is known to live; of one on another computer nobody knows."""
        return self.owner is not None and self.owner.is_here and self.owner.lives


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


def died(roots: Sequence[Path], profile_key: str) -> Path | None:
    """The run, if there is one, that died on a profile's hardware without making it safe.

    Returns:
        Its folder, or the marker itself if that cannot be read. A run on another
        computer counts as dead: nobody here can tell, and being safe twice harms
        nothing.
    """
    for marker in _markers(roots, profile_key):
        if not marker.is_active:
            return marker.run_dir or marker.path
    return None


def lock_files(roots: Sequence[Path], profile_key: str) -> tuple[Path, ...]:
    """What to lock so that nobody else uses a profile's hardware: one file in each root."""
    return tuple(root / _FOLDER / f"{_stem(profile_key)}.lock" for root in roots)


def runs_in_progress(roots: Sequence[Path]) -> dict[Path, str]:
    """The runs that living processes here have in progress: folder -> what stands for the profile."""
    markers = [marker for root in roots for marker in markers_in(root) if marker.is_active]
    return {marker.run_dir: marker.profile for marker in markers if marker.run_dir is not None}


def markers_in(root: Path) -> list[Marker]:
    """The markers of all profiles in a data root."""
    return [_read(path) for path in _files(root)]


def _mark(root: Path, profile_key: str, run_dir: Path) -> None:
    owner = Owner.current()
    marker = root / _FOLDER / f"{_stem(profile_key)}.{owner.pid}.json"
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
        values = parse_object(path.read_bytes()) or {}
    except OSError:
        values = {}
    run_dir, profile = values.get("run_dir"), values.get("profile")
    return Marker(
        path,
        Owner.from_plain(values),
        Path(run_dir) if isinstance(run_dir, str) else None,
        profile if isinstance(profile, str) else "",
    )


def _files(root: Path, stem: str = "") -> list[Path]:
    folder = root / _FOLDER
    try:
        names = sorted(entry.name for entry in folder.iterdir())
    except OSError:  # there is none, or none that can be looked into
        return []
    return [folder / name for name in names if name.startswith(stem) and name.endswith(".json")]
