"""Creates and finds a run's folder, and names the files in it."""

from __future__ import annotations

import contextlib
import re
import unicodedata
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Final

from labseq.errors import RecordingError
from labseq.files import data_root, explained, is_there, make_folder, sync_folder

RUN_FILE: Final = "run.json"
STATE_FILE: Final = "STATE"
INDEX_FILE: Final = "index.jsonl"
EVENTS_FILE: Final = "events.jsonl"
SKIPPED_FILE: Final = "skipped.jsonl"
"""Lists skipped shots with the reason. Exists only if there are any."""
SEQUENCE_FILE: Final = "sequence.yaml"
PROFILE_FILE: Final = "profile.yaml"
SHOTS_FOLDER: Final = "shots"
RESULTS_FOLDER: Final = "analysis"
"""Results of analyses, with a file of lines for each analysis."""
RESULT_PREFIX: Final = "analysis."
"""Prefix of the names of results, as in "analysis.NAME.KEY"."""
STOP_FILE: Final = "STOP"
"""Exists while a request to end the run after the current shot is pending."""
NOTIFY_FILE: Final = "notify.yaml"
"""In the data folder: where to send notices of failures, alarms and the end of the queue."""
NOTES_FILE: Final = "notes.json"
"""Note and tags, see :mod:`labseq.recording.notes`. Exists only if there are any."""
SOURCES_FILE: Final = "sources.zip"
"""The sources of the plugins that the run uses."""
LOCK_FILE: Final = ".lock"
"""Locked by the process that resumes or repairs the run."""

UNLOGGED_EVENTS: Final[Mapping[str, str]] = {
    "image": SHOTS_FOLDER,
    "cycle": SHOTS_FOLDER,
    "stage": SHOTS_FOLDER,  # a stage over its budget is logged as "over_budget"
    "state": "",
    "compiling": "",
    "compiled": "",
}
"""Events of a run that its event log leaves out -> where their content is. "" if nowhere."""
UNLOGGED_VALUES: Final[Mapping[str, str]] = {"record": RUN_FILE, "row": INDEX_FILE}
"""Values of logged events that the event log leaves out -> where their content is."""


def slug(name: str) -> str:
    """Convert a text to a name that every file system accepts.

    Example:
        >>> slug("20 x 20: to/from µ")
        '20_x_20_to_from_µ'
        >>> slug("../")
        'run'
    """
    safe = re.sub(r"[^\w.-]+", "_", unicodedata.normalize("NFC", name))
    return safe[:60].strip("._-") or "run"


def split_result(name: str) -> tuple[str, str] | None:
    """The analysis and the key in the name of a result. None for the name of another quantity.

    Example:
        >>> split_result("analysis.losses.heating")
        ('losses', 'heating')
    """
    if not name.startswith(RESULT_PREFIX):
        return None
    analysis, _, key = name.removeprefix(RESULT_PREFIX).partition(".")
    return analysis, key


def shot_file_name(shot_index: int, attempt: int, *, counts: bool, take: int = 1) -> str:
    """Path of a shot's file, relative to the run's folder.

    Args:
        counts: Whether the attempt completed the shot.
        take: Number from 1. A resumed run that keeps the file of an earlier take counts it up.

    Example:
        >>> shot_file_name(17, 1, counts=False)
        'shots/shot_000017.attempt_1.h5'
        >>> shot_file_name(17, 0, counts=True, take=2)
        'shots/shot_000017.take_2.h5'
    """
    suffix = "" if counts else f".attempt_{attempt}"
    suffix += "" if take == 1 else f".take_{take}"
    return f"{SHOTS_FOLDER}/shot_{shot_index:06d}{suffix}.h5"


def make_run_folder(root: Path, name: str, started: datetime) -> Path:
    """Create ``<root>/<local date>/<counter>_<slug>``. No two runs of a day share a counter.

    A process claims a counter by creating the folder ``.<counter>.claim``, in which only one process
    succeeds. When the claim is removed, the run's folder exists.

    Raises:
        RecordingError: The folder cannot be created.
    """
    day = root / started.astimezone().date().isoformat()
    with explained(day):
        make_folder(day)
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
                # another process may have made the folder and given up its claim since the first look
                if any(n == counter for n in _counters(day, claims=False)):
                    continue
                make_folder(folder, is_new=True)
                sync_folder(day)
                return folder
            finally:
                with contextlib.suppress(OSError):
                    claim.rmdir()


def later_day(run_dir: Path) -> str:
    """The last day in the data folder with runs, if it is after the day of this run. Otherwise ""."""
    own_day, root = run_dir.parent.name, run_dir.parent.parent
    with contextlib.suppress(OSError):
        days = [
            day.name
            for day in root.iterdir()
            if re.fullmatch(r"\d{4}-\d\d-\d\d", day.name) and day.name > own_day
        ]
        return max((day for day in days if _counters(root / day)), default="")
    return ""


def _counters(day: Path, *, claims: bool = True) -> list[int]:
    """The numbers of a day's runs. With ``claims``, also numbers that a run is just claiming."""
    names = (entry.name for entry in day.iterdir())
    matches = (re.match(r"\.?(\d{4,})[_.]", name) for name in names if claims or not name.startswith("."))
    return [int(match[1]) for match in matches if match]


def find_run(path: Path) -> Path:
    """Find the folder of a run.

    Args:
        path: The folder, or any file in it, or the name or number of a run, see
            :func:`labseq.recording.listing.named_run`.

    Raises:
        RecordingError: There is no such run. The message says what to give instead.
    """
    try:
        exists = is_there(path.expanduser())
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {str(error.strerror or error).lower()}") from error
    place = path.expanduser().resolve()
    for folder in (place, place.parent, place.parent.parent) if exists else ():
        if (folder / RUN_FILE).is_file():
            return folder
    from labseq.recording.listing import named_run, not_a_run  # a plain run does not need it

    if exists:
        raise not_a_run(place)
    return named_run(path.as_posix(), data_root())
