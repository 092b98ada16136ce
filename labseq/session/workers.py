"""A simulated run whose shots are taken by workers; this process records them in order.

Each shot draws its random numbers from the run's seed and its own index, so that it does not matter where it
is taken. A worker assembles the run from its record, as a resumed run does, takes whole shots, and writes
their files, or sends them where it does not see the run's folder. A file gets its name, and its line in the
index, when all shots before it have theirs.
"""

from __future__ import annotations

import gc
import io
import os
import pickle
import secrets
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from labseq.cluster import ClusterWorkers, check_workers
from labseq.config.document import StoredText
from labseq.errors import ConfigError, LabseqError, Problem, RecordingError
from labseq.files import write_file
from labseq.guard import StopFlag
from labseq.model import Frame, RunRecord, ShotRecord
from labseq.recording import RunWriter
from labseq.recording.folders import SHOTS_FOLDER
from labseq.recording.writer import encoded, run_id_of, write_hashed
from labseq.sequencer.clock import VirtualClock
from labseq.sequencer.lab import Lab
from labseq.sequencer.leader import leaders
from labseq.session.assembly import Assembly, assemble_recorded
from labseq.session.chosen import HARDWARE_KINDS
from labseq.session.lab import build_lab, warm
from labseq.session.observers import Observers
from labseq.session.options import Options
from labseq.session.provenance import run_record
from labseq.session.recorded import RecordedFiles
from labseq.session.resume import changes_between, plain_record
from labseq.session.scan import Point
from labseq.session.scan_run import OwnShots, ScanRun
from labseq.watchdog import Watchdog
from labseq.workers import POLL_S, QUEUED, ProcessWorkers, Unfinished, Workers, portable

_AHEAD: Final = 1
"""Shots per worker that may wait to be recorded, besides those that are handed out."""
_LEFT_BY: Final = "worker"
_UNSEEN: Final = "state"
"""Event of workers that is not passed on."""

Place = int | Mapping[str, float]
"""The index of a point, or the values of one that a scanner has chosen."""


def open_workers(options: Options) -> Workers:
    """The workers that take the shots of a run.

    Raises:
        ConfigError: There is no such cluster, or it has no workers.
    """
    if options.scheduler is None:
        return ProcessWorkers(options.workers, "shot")
    return ClusterWorkers(options.scheduler, options.keys, "shot")


def refuse_workers(assembly: Assembly, options: Options, lab: Lab) -> None:
    """Check that the shots of a run can be taken by several workers.

    Args:
        assembly: The run.
        options: Its options.
        lab: Its devices; none is open.

    Raises:
        ConfigError: They cannot, and why.
    """
    check_workers(None if options.workers == 1 else options.workers, options.scheduler)
    problem = _problem_of(assembly, options, lab)
    if problem is not None:
        raise ConfigError(replace(problem, what=f"workers cannot take the shots: {problem.what}"))


def _problem_of(assembly: Assembly, options: Options, lab: Lab) -> Problem | None:
    """Why only one process can take the shots of a run."""
    name = f"'{assembly.hardware.profile.name}'"
    if not assembly.virtual_time:
        chosen = assembly.hardware.chosen.items()
        real = [role for role, one in chosen if one.entry.kind in HARDWARE_KINDS and not one.virtual_time]
        what = f"the profile {name} has real hardware ({', '.join(real)})"
        return Problem(what, expected="simulated hardware", hint="add --dry-run, or take them in one process")
    if options.realtime:
        return Problem("simulated time cannot pass at the speed of real time", hint="leave out --realtime")
    hardware = dict(lab.hardware())
    led = [leader for leader, _ in leaders(hardware)]
    for device in [*led, *(one for one, part in hardware.items() if getattr(part, "shots_in_order", False))]:
        return Problem(f"with '{device}' of the profile {name}, shots must be taken in order")
    for step, made in assembly.steps:
        if made.shots_in_order:
            return Problem(f"what the step '{step}' does stays in effect for later shots")
    return None


@dataclass(frozen=True, slots=True)
class Recipe:
    """What a worker needs to know of a run.

    Attributes:
        record: The run's record, with the descriptions of its devices.
        run_id: Its id.
        options: Its options.
        folder: The folder for the files of shots.
        mark: Name of a file there; a worker that does not see it is on a computer with other disks.
        keeps_frames: Whether the frames of a shot are sent too.
    """

    record: RunRecord
    run_id: str
    options: Options
    folder: str
    mark: str
    keeps_frames: bool


@dataclass(frozen=True, slots=True)
class TakenShot:
    """A shot that a worker has taken.

    Attributes:
        events: In order: the events, name and values, and the attempts at the shot: the line in the index,
            and the bytes of the file, or its name once it is written.
        given_up: Why it failed for good, or "".
        error: The error that ends the run, or None.
    """

    events: list[tuple[Any, Any]]
    given_up: str
    error: LabseqError | None


class _NoWatchdog(Watchdog):
    """Simulated devices end with their process: nothing is left on."""

    def add(self, name: str, order: int, script: Path, arguments: object) -> None:
        """Do nothing."""


class ShotWorker:
    """Takes shots of a run in a process of its own.

    Raises:
        ConfigError: The run cannot be assembled here, or would be another one.
        LabseqError: A simulated device fails.
    """

    def __init__(self, recipe: Recipe) -> None:
        from labseq.recording.shot_file import ShotEncoder

        self._recipe, self._record = recipe, recipe.record
        self._assembly = _assembled_again(recipe)
        self._encoder = ShotEncoder(recipe.record, recipe.run_id)
        self._stop = StopFlag()
        self._place: Place | None = None
        self._point: Point | None = None
        self._own: OwnShots | None = None
        self._error: LabseqError | None = None
        self._events: list[tuple[Any, Any]] = []
        self._name = secrets.token_hex(4)
        folder = Path(recipe.folder)
        has_folder = (folder / recipe.mark).is_file() and os.access(folder, os.W_OK)
        self._folder = folder if has_folder else None

    def __call__(self, task: tuple[int, Place]) -> Unfinished:
        """Take a shot; its files are written, and its :class:`TakenShot` pickled, when it is finished."""
        shot, place = task
        self._events, given_up = [], ""
        if self._error is None:
            point = self._point_at(place)
            if self._own is None:
                self._own = self._open(point)
            try:
                given_up = self._own.take(shot, point)
            except LabseqError as error:
                self._error = portable(error)  # it ends the run before the shots that this worker still has
        return Unfinished(partial(self._finish, TakenShot(self._events, given_up, self._error)))

    def _finish(self, taken: TakenShot) -> bytes:
        if self._folder is not None:
            taken = self._written(taken, self._folder)
        buffer = io.BytesIO()
        pickler = pickle.Pickler(buffer, pickle.HIGHEST_PROTOCOL)
        if not self._recipe.keeps_frames:  # by far the largest part of a shot; they are in its file
            pickler.dispatch_table = {Frame: lambda _: (_nothing, ())}
        pickler.dump(taken)
        return buffer.getvalue()

    def _written(self, taken: TakenShot, folder: Path) -> TakenShot:
        """A shot whose files are on the disk; after one that cannot be written, nothing has happened."""
        events = list[tuple[Any, Any]]()
        for what, value in taken.events:
            if isinstance(what, str):
                events.append((what, value))
                continue
            name = f"shot_{what['shot']:06}_{what['attempt']}.{self._name}.{_LEFT_BY}.part"
            try:
                sha256 = write_hashed(folder / name, value)
            except RecordingError as error:
                return TakenShot(events, taken.given_up, error)
            events.append(({**what, "sha256": sha256}, name))
        return replace(taken, events=events)

    def _point_at(self, place: Place) -> Point:
        """The settings of a point; the same object for following shots of the same point."""
        if self._point is None or place != self._place:
            search = self._assembly.search
            if isinstance(place, int):
                self._point = self._assembly.at(place)
            else:
                assert search is not None
                self._point = search.at(place)
            self._place = place
        return self._point

    def _open(self, point: Point) -> OwnShots:
        lab = build_lab(point, self._assembly.target, VirtualClock(self._stop), self._record.seed)
        warm(lab, self._stop, self)
        policy, watchdog = self._assembly.policy, _NoWatchdog()
        own = OwnShots(lab, point, self._record, policy, self._stop, self, self, watchdog)
        gc.freeze()
        own.sequencer.open()
        return own

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Keep an event for the process that records the run."""
        if name != _UNSEEN:
            self._events.append((name, dict(values)))

    def write_shot(self, shot: ShotRecord) -> None:
        """Keep the file of an attempt at a shot."""
        row, data = encoded(self._encoder, self._record, shot)
        self._events.append((row, data if self._folder is not None else bytes(data)))


def _nothing() -> None:
    """What is sent in place of a frame."""


def _assembled_again(recipe: Recipe) -> Assembly:
    """Assemble a run from its record.

    Raises:
        ConfigError: That is not possible here, or its shots would differ.
    """
    record = recipe.record
    recorded = RecordedFiles(
        Path(record.sequence_path),
        StoredText(record.sequence_text, record.sequence_path),
        Path(record.profile_path),
        StoredText(record.profile_text, record.profile_path),
        record.calibrations,
    )
    assembly = assemble_recorded(recorded, recipe.options)
    folder = Path(record.provenance["folder"])
    today = run_record(assembly, record.seed, recipe.options.changes(), {}, folder)
    if changes := changes_between(plain_record(record), today):
        host = today.provenance["host"]
        raise ConfigError([Problem(f"a worker on {host} would take other shots: {one}") for one in changes])
    return assembly


class WorkersShots:
    """Has the shots of a run taken by workers, a bounded number ahead, and records them in order.

    Args:
        workers: The workers.
        scan_run: The run's shots and points.
        options: Its options.
        writer: Its folder.
        observers: Receive the events of each shot when it is recorded.
        stop: The request to stop.

    Raises:
        LabseqError: No worker can be started.
    """

    def __init__(
        self,
        workers: Workers,
        scan_run: ScanRun,
        options: Options,
        writer: RunWriter,
        observers: Observers,
        stop: StopFlag,
    ) -> None:
        self._workers = workers
        self._scan_run = scan_run
        self._writer = writer
        self._observers = observers
        self._stop = stop
        self._n_handed_out = 0  # of the shots of the run, those skipped included
        self._out: set[int] = set()
        self._done: dict[int, bytes] = {}
        self._folder = writer.run_dir / SHOTS_FOLDER
        mark = f"{secrets.token_hex(8)}.{_LEFT_BY}.part"
        write_file(self._folder / mark, b"")
        for_worker = replace(options, output=None, keys=None)
        run_id, needs_frames = run_id_of(writer.run_dir), observers.need_frames
        recipe = Recipe(writer.run, run_id, for_worker, str(self._folder), mark, needs_frames)
        workers.prepare(ShotWorker, recipe)

    def take(self, shot: int, point: Point, skipped: Collection[int]) -> str:
        """Wait for a shot, and record it; see :class:`labseq.session.scan_run.ShotTaker`."""
        self._out.difference_update(skipped)
        for late in self._done.keys() & skipped:
            del self._done[late]
        self._stop.check()
        self._hand_out(shot, point, skipped)
        while shot not in self._done:
            self._stop.check()
            found = self._workers.finished(POLL_S)
            self._done.update((one, taken) for one, taken in found if one in self._out)
            self._hand_out(shot, point, skipped)
        self._out.remove(shot)
        taken: TakenShot = pickle.loads(self._done.pop(shot))  # noqa: S301 - of our own worker
        for name, values in taken.events:
            if isinstance(name, str):
                self._observers.event(name, values)
            else:
                self._writer.add_shot(name, self._folder / values if isinstance(values, str) else values)
        if taken.error is not None:
            raise taken.error
        return taken.given_up

    def _hand_out(self, current: int, point: Point, skipped: Collection[int]) -> None:
        """Hand out as many shots as may be under way, those of later points only if they are known."""
        run, limit = self._scan_run, (QUEUED + _AHEAD) * self._workers.n_workers
        while len(self._out) < limit and self._n_handed_out < len(run.shots):
            shot = run.shots[self._n_handed_out]
            place = run.place_of(shot)
            if run.is_adaptive and place != run.place_of(current):
                return
            self._n_handed_out += 1
            if shot not in skipped:
                self._out.add(shot)
                chosen: Place = dict(point.parameters) if run.is_adaptive else place
                self._workers.submit(shot, (shot, chosen))

    def close(self) -> None:
        """End the workers, and remove the files of shots that were not recorded."""
        self._workers.close()
        for path in self._folder.glob(f"*.{_LEFT_BY}.part*"):
            path.unlink(missing_ok=True)
