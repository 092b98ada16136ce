"""Devices in use on this computer: the locks of their processes, and the markers of runs in progress.

They belong to the hardware (see ``Settings.identities``), not to the profile's path or the data folder. One
folder per computer holds them, see :func:`labseq.files.devices_root`. A lock ends with its process. A marker
exists from before the devices are opened until they are safe. If its process is gone, the run died.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, cast

from labseq.errors import RecordingError
from labseq.files import devices_root, explained, read_file, sync_folder, write_shared
from labseq.plain import dumps, parse_object
from labseq.processes import Process
from labseq.recording.folders import slug

_SUFFIX: Final = ".json"
_CLEARED: Final = b"safe\n"
"""Content of a marker that no longer counts, but that only its owner may delete."""


@dataclass(frozen=True, slots=True)
class Marker:
    """The content of a marker file.

    Attributes:
        path: The file.
        owner: The process. None if the file cannot be read.
        run_dir: The run's folder. None if the file cannot be read.
        profile: Key of the profile. "" if the file cannot be read.
        hardware: Identities of the devices that may be on.
    """

    path: Path
    owner: Process | None
    run_dir: Path | None
    profile: str
    hardware: frozenset[str]

    @property
    def is_active(self) -> bool:
        """Whether its process is running."""
        return self.owner is not None and self.owner.is_here and self.owner.is_running

    def concerns(self, profile: str, hardware: Collection[str]) -> bool:
        """Whether the run used this profile or shares a device with it. True if the marker cannot be read."""
        return self.owner is None or self.profile == profile or not self.hardware.isdisjoint(hardware)


def mark_active(profile: str, hardware: Collection[str], run_dir: Path) -> None:
    """Mark that this process has a run in progress.

    Args:
        profile: Key of the profile, for example its absolute path.
        hardware: Identities of its devices.
        run_dir: The run's folder.

    Raises:
        RecordingError: The marker cannot be written.
    """
    owner = Process.current()
    marker = devices_root() / f"{_stem(profile)}.{owner.pid}{_SUFFIX}"
    values = {"profile": profile, "hardware": sorted(hardware), "run_dir": str(run_dir.resolve())}
    with explained(marker):
        write_shared(marker, dumps({**values, **asdict(owner)}).encode())
        sync_folder(marker.parent)


def clear_active(profile: str, hardware: Collection[str]) -> None:
    """Remove this process's marker, and remove devices that are now safe from the markers of dead runs.

    Markers of other running processes stay, and so do markers of dead runs with other devices.

    Raises:
        RecordingError: A marker cannot be changed. All others are.
    """
    failures: list[RecordingError] = []
    for marker in markers():
        is_own = marker.owner is not None and marker.owner.pid == os.getpid()
        if not marker.concerns(profile, hardware) or (marker.is_active and not is_own):
            continue
        try:
            with explained(marker.path):
                _remove(marker, marker.hardware.difference(hardware))
        except RecordingError as failure:
            failures.append(failure)
    if failures:
        raise failures[0]


def _remove(marker: Marker, devices: frozenset[str]) -> None:
    """Remove a marker, or reduce it to the devices that may still be on."""
    if devices and marker.owner is not None:
        values = {"profile": marker.profile, "hardware": sorted(devices), "run_dir": str(marker.run_dir)}
        write_shared(marker.path, dumps({**values, **asdict(marker.owner)}).encode())
        return
    try:
        marker.path.unlink(missing_ok=True)
    except PermissionError:  # in this folder only its own user can delete it
        write_shared(marker.path, _CLEARED)
    sync_folder(marker.path.parent)


def find_dead_run(profile: str, hardware: Collection[str]) -> Path | None:
    """Find a run whose process died before it made these devices safe. None if there is none.

    Returns:
        The run's folder, or the marker itself if it cannot be read.
    """
    for marker in markers():
        if not marker.is_active and marker.concerns(profile, hardware):
            return marker.run_dir or marker.path
    return None


def lock_file(identity: str) -> Path:
    """The file to lock so that no other process uses a device."""
    return devices_root() / f"{_stem(identity)}.lock"


def runs_in_progress() -> dict[Path, str]:
    """Runs in progress on this computer: folder -> key of the profile."""
    active = [marker for marker in markers() if marker.is_active]
    return {marker.run_dir: marker.profile for marker in active if marker.run_dir is not None}


def markers() -> list[Marker]:
    """All markers on this computer, by name."""
    folder = devices_root()
    try:
        files = sorted(folder / entry.name for entry in folder.iterdir() if entry.name.endswith(_SUFFIX))
    except OSError:  # there is no such folder, or it cannot be read
        return []
    return [marker for marker in map(_read, files) if marker is not None]


def _stem(key: str) -> str:
    digest = hashlib.sha256(key.encode("utf-8", "backslashreplace")).hexdigest()[:12]
    return f"{slug(key)[-40:]}-{digest}"


def _read(path: Path) -> Marker | None:
    """A marker. None if it is gone or cleared."""
    data = None
    with suppress(RecordingError):
        data = read_file(path)
    if data == _CLEARED or (data is None and not path.exists()):
        return None
    values = parse_object(data or b"") or {}
    run_dir, profile, hardware = (values.get(key) for key in ("run_dir", "profile", "hardware"))
    return Marker(
        path,
        Process.from_plain(values),
        Path(run_dir) if isinstance(run_dir, str) else None,
        profile if isinstance(profile, str) else "",
        frozenset(map(str, cast("list[Any]", hardware))) if isinstance(hardware, list) else frozenset(),
    )
