"""The runs of a data folder: the list, and the data of each run that the pages need."""

from __future__ import annotations

import math
import re
import time
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any, Final, cast

from labseq.data.catalogue import entries
from labseq.data.follower import Event, Follower
from labseq.data.points import reporting_damage
from labseq.data.quantities import WITH_TARGET, make_quantity, names_measured, quantity_problem
from labseq.data.reader import Run
from labseq.data.series import Series
from labseq.data.shot import Shot
from labseq.errors import RecordingError
from labseq.messages import visible
from labseq.model import TargetPattern
from labseq.recording.folders import INDEX_FILE, NOTES_FILE, RUN_FILE, STATE_FILE
from labseq.recording.listing import runs_in
from labseq.recording.notes import read_notes
from labseq.recording.run_file import read_run, read_state, target_of
from labseq.web.history import RunHistory, judged_values

MAX_TEXT: Final = 2000
"""Maximum number of characters of a text from a file that is passed on."""
SEARCH_S: Final = 4.0
"""Time limit of a search, in seconds. Runs that were read are kept, so the next search gets further."""
_MAX_SUMMARIES: Final = 2000
_LISTED_S: Final = 0.5
"""Minimum time before the list of folders is read again, in seconds."""
_DAY: Final = re.compile(r"\d{4}-\d\d-\d\d")
_LISTED_EVENTS: Final = frozenset(
    {"warning", "safe_state", "closed", "shot_repeated", "window_too_short", "window_exceeded"}
    | {"scan_ended", "ended_early", "leader_awaited", "left_on", "run_finished", "run_starting"}
)
"""Events that the page lists."""


def text_of(value: object, most: int = MAX_TEXT) -> str:
    """A text from a file, with limited length and escaped control characters. Line breaks are kept."""
    text = str(value)
    text = text if len(text) <= most else f"{text[:most]} ..."
    return "\n".join(visible(line.replace("\t", "    ")) for line in text.split("\n"))


class NoSuchRun(LookupError):  # noqa: N818 - a missing page is not a failure
    """The data folder has no run of this name."""


class OpenRun:
    """A run whose files are followed while it writes them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.id = f"{folder.parent.name}/{folder.name}"
        self.follower = Follower(folder)
        self.history = RunHistory(folder, self.follower, self._series)
        self.lock = Lock()
        self._record: dict[str, Any] = {}
        self._record_stamp: object = None
        self.events: list[Event] = []
        self.scan_events: list[dict[str, Any]] = []
        self.first_shot_s = self.last_event_s = math.nan
        self.shots_before = 0

    @property
    def record(self) -> dict[str, Any]:
        """The content of run.json.

        Raises:
            RecordingError: run.json is damaged.
        """
        stamp = _stamp(self.folder / RUN_FILE)
        if stamp != self._record_stamp or not self._record:
            self._record = read_run(self.folder)
            self._record_stamp = stamp
            self.__dict__.pop("target", None)
        return self._record

    @cached_property
    def target(self) -> TargetPattern:
        """The target of the run.

        Raises:
            RecordingError: run.json is damaged.
        """
        return target_of(self.folder / RUN_FILE, self.record)

    @property
    def shown(self) -> tuple[str, ...]:
        """Names of the quantities that the page of the run shows, the most important first.

        Raises:
            RecordingError: run.json is damaged.
        """
        with reporting_damage(self.folder):
            measured = names_measured(self.record.get("resolved") or {}, self.target)
            names = dict.fromkeys((*measured, *(() if self.target.is_none else WITH_TARGET)))
            # a damaged or older record may have names that this version does not know
            return tuple(one for one in names if quantity_problem(one, (one,), (), self.target) is None)

    def _series(self) -> list[Series]:
        return [Series(make_quantity(name, self.target), self.folder) for name in self.shown]

    def read_events(self) -> None:
        """Read what was added to the event log.

        Raises:
            RecordingError: The event log cannot be read.
        """
        for event in self.follower.log():
            with suppress(TypeError, ValueError):  # a damaged line
                self._add_event(event)

    def _add_event(self, event: Event) -> None:
        self.last_event_s = event.t_s
        if event.name == "run_starting":
            self.shots_before, self.first_shot_s = int(event.values.get("n_before") or 0), math.nan
        elif event.name == "shot_started" and math.isnan(self.first_shot_s):
            self.first_shot_s = event.t_s
        elif event.name == "scan_point":
            self.scan_events.append(dict(event.values))
        if event.name in _LISTED_EVENTS and not (
            event.name in ("safe_state", "closed") and event.values.get("ok") is True
        ):
            self.events.append(event)
            del self.events[:-40]

    def with_rows(self, lines: Iterable[int]) -> list[Shot]:
        """The shots of some lines of the index. Unreadable lines are left out."""
        shots = list[Shot]()
        for line in lines:
            with suppress(RecordingError):
                shots.append(self.shot(line))
        return shots

    def shot(self, line: int) -> Shot:
        """The shot of a line of the index.

        Raises:
            RecordingError: The line cannot be read.
        """
        return self.follower.shot(self.history.row(line))

    def some(self, lines: Iterable[int]) -> Run:
        """The run with only the shots of some lines of the index, which is fast for any number of shots."""
        return Run(self.folder, self.record, *read_state(self.folder), tuple(self.with_rows(lines)), ())

    def outline(self) -> Run:
        """The run with shots that have nothing but an index, which is fast for any number of shots."""
        counted = self.history.columns()
        first = self.with_rows(counted.counted[:1].tolist())
        shots = (
            self.follower.shot(replace(first[0].row, shot=shot))
            for shot in counted.shot[counted.counted if first else []].tolist()
        )
        return Run(self.folder, self.record, *read_state(self.folder), tuple(shots), ())


class Catalogue:
    """All runs of a data folder. Methods may be called from several threads.

    Args:
        root: The data folder, which may vanish and return.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._lock = Lock()
        self._open: OrderedDict[str, OpenRun] = OrderedDict()
        self._summaries: dict[Path, tuple[object, dict[str, Any]]] = {}
        self._folders: list[Path] = []
        self._list_again_s = -math.inf

    def folders(self) -> list[Path]:
        """The folders of all runs, the newest last.

        Raises:
            RecordingError: The data folder cannot be read.
        """
        with self._lock:
            if (start_s := time.monotonic()) > self._list_again_s:
                try:
                    next(self.root.iterdir(), None)
                    self._folders = runs_in(self.root)
                except OSError as error:
                    self._folders = []
                    reason = f"the data folder cannot be read: {error.strerror}"
                    raise RecordingError(self.root, reason, "it is read again at the next request") from error
                # pages ask ten times a second, and a folder of 100,000 runs takes a while to list
                end_s = time.monotonic()
                self._list_again_s = end_s + max(_LISTED_S, 20.0 * (end_s - start_s))
            return self._folders

    def newest(self) -> OpenRun | None:
        """The newest run in progress, or else the newest run. None without runs.

        Raises:
            RecordingError: The data folder cannot be read.
        """
        folders = [folder for folder in self.folders()[-20:] if (folder / RUN_FILE).exists()]
        running = [folder for folder in folders if read_state(folder)[0] == "running"]
        candidates = running or folders
        return self._opened(candidates[-1]) if candidates else None

    def running(self) -> list[str]:
        """The runs in progress, among the newest 20.

        Raises:
            RecordingError: The data folder cannot be read.
        """
        return [run_id(folder) for folder in self.folders()[-20:] if read_state(folder)[0] == "running"]

    def open(self, day: str, name: str) -> OpenRun:
        """Open a run by its day and the name of its folder.

        Raises:
            NoSuchRun: There is no such run.
        """
        folder = self.root / day / name
        is_name = _DAY.fullmatch(day) and not {"/", "\\", "\0"} & set(name) and name.strip(".")
        if not is_name or len(name) > 255 or not folder.is_dir():
            raise NoSuchRun(f"there is no run {visible(day[:40])}/{visible(name[:100])}")
        return self._opened(folder)

    def _opened(self, folder: Path) -> OpenRun:
        with self._lock:
            run = self._open.pop(str(folder), None)
            if run is None or run.follower.is_replaced():
                run = OpenRun(folder)
            self._open[str(folder)] = run
            while len(self._open) > 12:  # each takes 3 MB for 20,000 shots
                self._open.popitem(last=False)
            return run

    def summary(self, folder: Path) -> dict[str, Any]:
        """A run as an entry in the list. It is read again only if one of its files has changed."""
        names = (RUN_FILE, STATE_FILE, INDEX_FILE, NOTES_FILE)
        stamp = [_stamp(folder / name) for name in names]
        cached = self._summaries.get(folder)
        # a run that died still says "running", so its process must be checked each time
        if cached is not None and cached[0] == stamp and cached[1]["status"] != "running":
            return cached[1]
        run = self._open.get(str(folder))
        values = _summary(OpenRun(folder) if run is None or run.follower.is_replaced() else run)
        values |= self._results(folder) if values["status"] != "running" else {"scanned": "", "results": []}
        self._summaries[folder] = (stamp, values)
        for oldest in [*self._summaries][:-_MAX_SUMMARIES]:
            self._summaries.pop(oldest, None)
        return values

    def _results(self, folder: Path) -> dict[str, Any]:
        """The scanned values and results of a run that has ended, as `labseq runs` shows them."""
        entry = next(entries(self.root, [_day_and_name(folder)]))
        return {
            "scanned": text_of(entry.scanned_text, 400),
            "results": [
                {"name": text_of(one.name, 200), "text": text_of(one, 400)} for one in entry.results[:5]
            ],
        }

    def warm(self) -> None:
        """Read all runs for searches once, the newest first, at a pace that leaves room for answers."""
        with suppress(RecordingError, OSError):
            if (newest := self.newest()) is not None:
                newest.history.update()
            names = [_day_and_name(folder) for folder in self.folders()[::-1]]
            for first in range(0, len(names), 100):  # every hundred entries are cached
                for _ in entries(self.root, names[first : first + 100]):
                    time.sleep(0.001)

    def search(self, text: str, status: str, first: int, most: int) -> dict[str, Any]:
        """The newest runs that contain all the words, from those that could be read within SEARCH_S.

        Args:
            text: Words that date, name, profile, results, comment or tags must contain.
            status: Only runs with this status. "" for all.
            first: Number of newer runs to leave out.
            most: Maximum number of runs.

        Raises:
            RecordingError: The data folder cannot be read.
        """
        matching = folders = self.folders()[::-1]
        n_read, words = len(folders), text.lower().split()
        if words or status:
            end_s, n_read = time.monotonic() + SEARCH_S, 0

            def names() -> Iterator[tuple[str, str]]:
                nonlocal n_read
                for folder in folders:
                    if time.monotonic() > end_s:
                        return
                    n_read += 1
                    yield _day_and_name(folder)

            found = entries(self.root, names(), words)
            matching = [entry.path for entry in found if status in ("", entry.status)]
        return {
            "n_runs": len(folders),
            "n_found": len(matching),
            "n_unread": len(folders) - n_read,
            "runs": [self.summary(folder) for folder in matching[first : first + most]],
        }


def _day_and_name(folder: Path) -> tuple[str, str]:
    return folder.parent.name, folder.name


def run_id(folder: Path) -> str:
    """The name of a run in commands and pages."""
    return f"{folder.parent.name}/{folder.name}"


def _stamp(path: Path) -> object:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size


def _summary(run: OpenRun) -> dict[str, Any]:
    values: dict[str, Any] = {"id": text_of(run.id, 300), **notes_of(run.folder)}
    keys = ("name", "profile", "started_utc", "simulated", "n_shots", "n_done", "filling", "defect_free")
    values |= dict.fromkeys((*keys, "has_scan")) | {"measured": []}
    try:
        record, (status, error) = run.record, read_state(run.folder)
        run.history.update()
    except (RecordingError, OSError) as failure:
        return values | {"status": "damaged", "outcome": "cannot be read", "error": text_of(failure)}
    columns = run.history.columns()
    rate = columns.defect_free
    outcome = f"{rate.n} of {rate.n_trials} defect-free" if rate.n_trials else "no judged shots"
    return values | {
        "name": text_of(record["name"], 200),
        "profile": profile_of(record),
        "started_utc": text_of(record.get("t_start_utc", ""), 40),
        "simulated": record["simulated"],
        "n_shots": record["n_shots"],
        "n_done": run.history.n_shots,
        "status": status,
        "error": text_of(error, 400),
        **judged_values(columns.filling, rate),
        "measured": columns.means(),
        "outcome": outcome,
        "has_scan": bool(record.get("scan")),
    }


def profile_of(record: Mapping[str, Any]) -> str:
    """Name of the profile of a run."""
    resolved: Any = record.get("resolved")
    profile: Any = resolved.get("profile") if isinstance(resolved, dict) else None
    name: Any = cast("dict[str, Any]", profile).get("name") if isinstance(profile, dict) else None
    return text_of(name or Path(str(record.get("profile_path") or "")).stem or "-", 200)


def notes_of(folder: Path) -> dict[str, Any]:
    """Note and tags of a run, as the pages show them."""
    notes = read_notes(folder)
    return {
        "comment": text_of(notes.comment, len(notes.comment)),
        "tags": [text_of(tag) for tag in notes.tags],
    }
