"""A run in another process, as the events that it has written down."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from labseq.cli.show_tables import shot_time_s
from labseq.errors import RecordingError
from labseq.model import ImageRecord, RunRecord, ShotRecord, StageTiming
from labseq.recording import Run, Shot
from labseq.recording.durable import parse_object, whole_lines
from labseq.recording.folders import EVENTS_FILE, INDEX_FILE
from labseq.recording.run_file import is_index_row, read_state
from labseq.recording.shot import load_content

Event = tuple[str, Mapping[str, Any]]

FILES: Final = 20
"""Shots at most, the latest, whose files are read for their stages, each time."""
_OF_SHOTS: Final = frozenset({"shot_finished", "shot_repeated"})


class Tail:
    """The whole lines that come to a file of JSON lines.

    Args:
        path: The file; it may not be there yet.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._at = 0

    def read(self) -> list[dict[str, Any]]:
        """The lines since the last time, without damaged ones.

        Raises:
            RecordingError: The file cannot be read.
        """
        try:
            with self._path.open("rb") as file:
                file.seek(self._at)
                data = whole_lines(file.read())
        except FileNotFoundError:
            return []
        except OSError as error:
            raise RecordingError(self._path, f"cannot be read: {error.strerror}; check the disk") from error
        self._at += len(data)
        rows = (parse_object(line) for line in data.splitlines())
        return [row for row in rows if row is not None]


class Follower:
    """Tells a run's events as its own process told them to its live view, as far as they are on the disk.

    Args:
        run: The run, when it was opened first.
        clock: Seconds since 1970.
    """

    def __init__(self, run: Run, clock: Callable[[], float] = time.time) -> None:
        self._folder = run.path
        self._clock = clock
        self._events, self._index = Tail(run.path / EVENTS_FILE), Tail(run.path / INDEX_FILE)
        self._record = record_of(run)
        self._shots: dict[tuple[int, int], Shot] = {}
        self._told_s = math.nan

    def now(self) -> float:
        """Time of the run: that of the event that is being told, else that of the clock."""
        return self._clock() if math.isnan(self._told_s) else self._told_s

    def is_over(self) -> bool:
        """Whether the run has ended, or its process is gone."""
        return read_state(self._folder)[0] != "running"

    def read(self) -> Iterator[Event]:
        """What has come since the last time.

        Raises:
            RecordingError: The run cannot be read any more.
        """
        lines = self._events.read()
        for row in filter(is_index_row, self._index.read()):  # a shot is in the index before it is told
            self._shots[row["shot"], row["attempt"]] = Shot(self._folder / row["file"], row, load_content)
        finished = [i for i, line in enumerate(lines) if line.get("event") in _OF_SHOTS]
        to_open = frozenset(finished[-FILES:])
        for i, line in enumerate(lines):
            with suppress(KeyError, TypeError, ValueError, AttributeError):  # a damaged line
                self._told_s = datetime.fromisoformat(line["t_utc"]).timestamp()
                yield from self._forward(line["event"], line["values"], whole=i in to_open)
        self._told_s = math.nan

    def _forward(self, name: str, values: dict[str, Any], *, whole: bool) -> Iterator[Event]:
        if name == "run_starting":
            yield name, values | {"record": self._record}
        elif name in _OF_SHOTS:
            told = values["shot"]
            shot = self._shots.pop((told["shot_index"], told["attempt"]), None)
            if shot is not None and whole:
                yield from stages_and_image(shot)
            yield name, {"shot": _shot_record(told, shot)}
        else:
            yield name, values


def record_of(run: Run) -> RunRecord:
    """The record of a run, as far as a view needs it, of run.json."""
    told = run.record
    return RunRecord(
        name=run.name,
        n_shots=run.n_shots,
        seed=run.seed,
        simulated=run.simulated,
        t_start_utc=str(told.get("t_start_utc", "")),
        target=run.target,
        sequence_text="",
        profile_text="",
        sequence_path=str(told.get("sequence_path", "")),
        profile_path=str(told.get("profile_path", "")),
        resolved=told.get("resolved") or {},
        overrides={},
        devices={},
        plugins=(),
        provenance={},
        record_frames="none",
        grid_spacing_m=math.nan,
        lattice=str(told.get("lattice", "")),
        scan=told.get("scan") or {},
    )


def stages_and_image(shot: Shot) -> Iterator[Event]:
    """The stages of a shot, and its last image; nothing if its file cannot be read."""
    with suppress(RecordingError):
        timing = shot.timing
        for one in timing:
            yield "stage", {"timing": one}
        images = shot.summary.images
        steps = [one.step for one in timing if one.stage == "expose"]
        if len(images) and steps:
            image = ImageRecord(
                frame=None,
                occupancy=shot.occupancies[-1],
                confidence=shot.confidences[-1],
                step=steps[-1],
                cycle=images.cycle[-1],
                t_start_s=images.t_start_s[-1],
                exposure_s=images.exposure_s[-1],
            )
            yield "shot_started", {"shot": shot.index, "attempt": shot.attempt}
            yield "image", {"image": image, "filling_fraction": shot.filling_fraction}


def _shot_record(told: Mapping[str, Any], shot: Shot | None) -> ShotRecord:
    """A shot as its line of the event log and of the index have it."""
    row: Mapping[str, Any] = {} if shot is None else shot.row
    filling: float | None = told["filling_fraction"]
    time_s = math.nan if shot is None else shot_time_s(shot)
    timing = [] if math.isnan(time_s) else [StageTiming("shot", 0, 0, 0.0, time_s, math.nan)]
    return ShotRecord(
        shot_index=told["shot_index"],
        attempt=told["attempt"],
        seed=0,
        t_start_utc=str(row.get("t_start_utc", "")),
        status=told["status"],
        error=told["error"],
        timing=timing,
        seen_defect_free_cycle=int(row.get("seen_defect_free_cycle") or 0),
        success=bool(told["success"]),
        filling_fraction=math.nan if filling is None else float(filling),
        n_missing_atoms=int(row.get("n_missing_atoms") or 0),
        parameters=row.get("parameters") or {},
    )
