"""`labseq watch`: the live view of a run in another process, read from the run's files."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TextIO

from labseq.cli.live import observer_for
from labseq.cli.show import shot_time_s
from labseq.cli.summary import summary_lines
from labseq.console.output import say
from labseq.console.runs import chosen_run
from labseq.data import Run, Shot, open_run
from labseq.errors import RecordingError
from labseq.files import NewLines
from labseq.model import ImageRecord, RunRecord, ShotRecord, StageTiming
from labseq.recording.folders import EVENTS_FILE, INDEX_FILE
from labseq.recording.run_file import RunTime, is_index_row, read_state
from labseq.roles import RunObserver

POLL_S: Final = 0.5
"""Interval at which the run's files are read, in seconds."""
_MAX_OPENED: Final = 20
"""Maximum number of new shots that are opened for their stages and images; older ones are not."""
_OF_SHOTS: Final = frozenset({"shot_finished", "shot_repeated"})

Event = tuple[str, Mapping[str, Any]]


def watch_run(
    path: Path | None, stream: TextIO | None = None, wait: Callable[[float], None] = time.sleep
) -> None:
    """Show a run until it ends, then print its summary; only its files are read."""
    run = chosen_run(path)
    reader = EventReader(run)
    shown = stream or sys.stdout
    view = observer_for(shown, reader.now)
    try:
        _follow(reader, view, wait)
    except KeyboardInterrupt:
        view.close()
        say(f"no longer watched; the run {run.path} continues", stream=shown)
    else:
        view.close()
        say(*summary_lines(open_run(run.path)), stream=shown)
    finally:
        view.close()


def _follow(reader: EventReader, view: Any, wait: Callable[[float], None]) -> None:
    """Pass a run's events to a view until the run is over."""
    observer: RunObserver = view
    while True:
        is_over = reader.is_over()  # checked first, so that the last events are read
        for name, values in reader.read():
            with suppress(KeyError, TypeError, ValueError):  # an event of another version of labseq
                observer.event(name, values)
        view.refresh()
        if is_over:
            return
        wait(POLL_S)


class EventReader:
    """Reads the events of a run from its files, in the form that the run passes to its live view."""

    def __init__(self, run: Run, clock: Callable[[], float] = time.monotonic) -> None:
        self._folder = run.path
        self._clock = clock
        self._events, self._index = NewLines(run.path / EVENTS_FILE), NewLines(run.path / INDEX_FILE)
        self._record = record_of(run)
        self._shots: dict[tuple[int, int], Shot] = {}
        self._time, self._read_s = RunTime(), math.nan

    def now(self) -> float:
        """Time of the run in seconds: that of the current event, or since the last was read."""
        waited_s = 0.0 if math.isnan(self._read_s) else self._clock() - self._read_s
        return self._time.total_s + waited_s

    def is_over(self) -> bool:
        """Whether the run or its process has ended."""
        return read_state(self._folder)[0] != "running"

    def read(self) -> Iterator[Event]:
        """The events since the last call.

        Raises:
            RecordingError: The run can no longer be read.
        """
        lines = self._events.read()
        if not lines:
            return
        self._read_s = math.nan
        for row in filter(is_index_row, self._index.read()):  # a shot is in the index before its event
            self._shots[row["shot"], row["attempt"]] = Shot(self._folder / row["file"], row)
        finished = [i for i, line in enumerate(lines) if line.get("event") in _OF_SHOTS]
        to_open = frozenset(finished[-_MAX_OPENED:])
        for i, line in enumerate(lines):
            with suppress(KeyError, TypeError, ValueError, AttributeError):  # a damaged line
                self._time.advance(line.get("t_s"))
                yield from self._events_of(line["event"], line["values"], with_content=i in to_open)
        self._read_s = self._clock()

    def _events_of(self, name: str, values: dict[str, Any], *, with_content: bool) -> Iterator[Event]:
        if name == "run_starting":
            yield name, values | {"record": self._record}
        elif name in _OF_SHOTS:
            logged = values["shot"]
            shot = self._shots.pop((logged["shot_index"], logged["attempt"]), None)
            if shot is not None and with_content:
                yield from _stages_and_image(shot)
            yield name, {"shot": _shot_record(logged, shot)}
        else:
            yield name, values


def record_of(run: Run) -> RunRecord:
    """The part of a run's record that the view needs, from run.json."""
    values = run.record
    return RunRecord(
        name=run.name,
        n_shots=run.n_shots,
        seed=run.seed,
        simulated=run.simulated,
        t_start_utc=str(values.get("t_start_utc", "")),
        target=run.target,
        sequence_text="",
        profile_text="",
        sequence_path=str(values.get("sequence_path", "")),
        profile_path=str(values.get("profile_path", "")),
        resolved=values.get("resolved") or {},
        overrides={},
        devices={},
        plugins=(),
        provenance={},
        record_frames="none",
        grid_spacing_m=math.nan,
        lattice=str(values.get("lattice", "")),
        scan=values.get("scan") or {},
    )


def _stages_and_image(shot: Shot) -> Iterator[Event]:
    """The stages of a shot and its last image; empty if its file cannot be read."""
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


def _shot_record(logged: Mapping[str, Any], shot: Shot | None) -> ShotRecord:
    """A shot from its line in the event log and its line in the index."""
    row: Mapping[str, Any] = {} if shot is None else shot.row
    filling: float | None = logged["filling_fraction"]
    time_s = math.nan if shot is None else shot_time_s(shot)
    timing = [] if math.isnan(time_s) else [StageTiming("shot", 0, -1, 0.0, time_s, math.nan)]
    return ShotRecord(
        shot_index=logged["shot_index"],
        attempt=logged["attempt"],
        seed=0,
        t_start_utc=str(row.get("t_start_utc", "")),
        status=logged["status"],
        error=logged["error"],
        timing=timing,
        seen_defect_free_cycle=int(row.get("seen_defect_free_cycle", -1)),
        success=bool(logged["success"]),
        filling_fraction=math.nan if filling is None else float(filling),
        n_missing_atoms=int(row.get("n_missing_atoms") or 0),
        parameters=row.get("parameters") or {},
    )
