"""Folders of runs, and which run is in progress in which process.

A marker belongs to a profile (its hardware) and to a process. It stands in the folder
``.active`` of the data root, and in that of the user's state folder for runs whose data
lie elsewhere, from before the devices are opened until they are safe again.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import unicodedata
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Final

from labseq.errors import RecordingError
from labseq.files import Process, explained, state_root, sync_folder, write_file
from labseq.plain import dumps, parse_object

RUN_FILE: Final = "run.json"
STATE_FILE: Final = "STATE"
INDEX_FILE: Final = "index.jsonl"
EVENTS_FILE: Final = "events.jsonl"
SKIPPED_FILE: Final = "skipped.jsonl"
"""Shots that will not be taken, and why; only where there are any."""
SEQUENCE_FILE: Final = "sequence.yaml"
PROFILE_FILE: Final = "profile.yaml"
SHOTS_FOLDER: Final = "shots"
RESULTS_FOLDER: Final = "analysis"
"""Results of analyses: a file of lines for each."""
STOP_FILE: Final = "STOP"
"""Stands in a run's folder while it is asked to end after the shot at hand."""
LOCK_FILE: Final = ".lock"
"""Locked by whoever goes on with a run."""
OWN_NAMES: Final = frozenset(
    {RUN_FILE, STATE_FILE, INDEX_FILE, EVENTS_FILE, SEQUENCE_FILE, PROFILE_FILE, STOP_FILE}
    | {SKIPPED_FILE}
    | {SHOTS_FOLDER, RESULTS_FOLDER}
)

_COUNTER = re.compile(r"\.?(\d{4,})[_.]")
_MAX_SLUG: Final = 60


def slug(name: str) -> str:
    """A name that every file system takes.

    Example:
        >>> slug("20 x 20: to/from µ")
        '20_x_20_to_from_µ'
        >>> slug("../")
        'run'
    """
    words = re.sub(r"[^\w.-]+", "_", unicodedata.normalize("NFC", name))
    return words[:_MAX_SLUG].strip("._-") or "run"


def shot_file_name(shot_index: int, attempt: int, *, counts: bool, take: int = 1) -> str:
    """Path of a shot's file, relative to the run's folder.

    Args:
        shot_index: Index of the shot, from 0.
        attempt: Which attempt it is, from 0.
        counts: Whether the shot is done with it.
        take: Counted up from 1 where a run was resumed and the file of an earlier take is kept.

    Example:
        >>> shot_file_name(17, 1, counts=False)
        'shots/shot_000017.attempt_1.h5'
        >>> shot_file_name(17, 0, counts=True, take=2)
        'shots/shot_000017.take_2.h5'
    """
    kept = "" if counts else f".attempt_{attempt}"
    kept += "" if take == 1 else f".take_{take}"
    return f"{SHOTS_FOLDER}/shot_{shot_index:06d}{kept}.h5"


def make_run_folder(root: Path, name: str, started: datetime) -> Path:
    """Make ``<root>/<local date>/<counter>_<slug>``; no two runs of a day share a counter.

    A counter is claimed by making the folder ``.<counter>.claim``, which succeeds
    for one process only. Whoever comes later, when the claim is gone again, sees
    the run's folder.

    Raises:
        RecordingError: The place cannot be written to.
    """
    day = root / started.astimezone().date().isoformat()
    with explained(day):
        day.mkdir(parents=True, exist_ok=True)
        sync_folder(root)
        counter = max(_counters(day), default=0)
    while True:
        counter += 1
        claim = day / f".{counter:04d}.claim"
        folder = day / f"{counter:04d}_{slug(name)}"
        with explained(folder):
            try:
                claim.mkdir()
            except FileExistsError:
                continue
            try:
                if any(n == counter for n in _counters(day, claims=False)):
                    continue
                folder.mkdir()
                sync_folder(day)
                return folder
            finally:
                with contextlib.suppress(OSError):
                    claim.rmdir()


def _counters(day: Path, *, claims: bool = True) -> list[int]:
    names = (entry.name for entry in day.iterdir())
    found = (_COUNTER.match(name) for name in names if claims or not name.startswith("."))
    return [int(match[1]) for match in found if match]


def find_run(path: Path) -> Path:
    """The run that a path belongs to.

    Args:
        path: A run's folder or any file or folder in it.

    Raises:
        RecordingError: It is no part of a run; the text says what to give instead.
    """
    path = Path(path).expanduser().resolve()
    if not path.exists():
        raise RecordingError(
            path, "no such file or folder; give a run's folder, <data>/<date>/<counter>_<name>"
        )
    for folder in (path, path.parent, path.parent.parent):
        if (folder / RUN_FILE).is_file():
            return folder
    for folder in (path, path.parent, path.parent.parent):
        if (folder / STATE_FILE).is_file():
            raise RecordingError(folder, _without_run_file(folder))
    runs = sorted(found.parent for depth in ("*", "*/*") for found in path.glob(f"{depth}/{RUN_FILE}"))
    if runs:
        holds = "1 run" if len(runs) == 1 else f"{len(runs)} runs"
        raise RecordingError(
            path, f"holds {holds} and is none itself; give one of them, for example {runs[-1]}"
        )
    raise RecordingError(path, f"is not a run: it has no {RUN_FILE}; give a run's folder")


def _without_run_file(folder: Path) -> str:
    if any((folder / SHOTS_FOLDER).glob("*.h5")):
        return f"holds shots, but its {RUN_FILE} is gone; take that from a backup"
    return f"has no {RUN_FILE}: the run died while its folder was made; it holds no shots, delete it"


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
    owner: Process | None
    run_dir: Path | None
    profile: str

    @property
    def is_active(self) -> bool:
        """Whether its process is known to live; of one on another computer nobody knows."""
        return self.owner is not None and self.owner.is_here and self.owner.is_running


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
    owner = Process.current()
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
        Process.from_plain(values),
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
