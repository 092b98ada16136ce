"""Runs in a thread of a lab's own Python, one shot per call or led by another control system."""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Generator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labseq.assembly.led import LedPoints
from labseq.assembly.point import Point
from labseq.errors import ConfigError, StopRequested
from labseq.guard import POLL_S, Guard, StopFlag
from labseq.model import ShotRecord, StageTiming
from labseq.recording.folders import RUN_FILE
from labseq.recording.index import IndexRow
from labseq.session.check import check_settings
from labseq.session.prepared import History
from labseq.session.session import Session


@dataclass(frozen=True, slots=True, eq=False)
class ShotResult:
    """A shot that :meth:`Session.shot` has taken.

    Attributes:
        index: Its index in the run, from 0.
        success: Whether the last ``image`` step met the target.
        filling: Filling of the target on that image, 0 to 1. nan if it was not judged.
        images: Names of the images, in the order they were taken.
        occupancies: bool (n_images, n_rows, n_cols), where an atom was detected.
        defects: Empty sites of the target on each image.
        timing: The stages, in the order they ended, in seconds after the start of the shot.
        parameters: Settings that differ from the files, address -> value in SI.
        file: The shot's HDF5 file.
    """

    index: int
    success: bool
    filling: float
    images: tuple[str, ...]
    occupancies: NDArray[np.bool_]
    defects: tuple[int, ...]
    timing: tuple[StageTiming, ...]
    parameters: Mapping[str, Any]
    file: Path

    @classmethod
    def of(cls, record: ShotRecord, row: IndexRow, run_dir: Path) -> ShotResult:
        """The result of a shot that is on disk."""
        occupancies = [image.occupancy for image in record.images]
        return cls(
            record.shot_index,
            record.success,
            record.filling_fraction,
            tuple(image.name for image in record.images),
            np.array(occupancies, np.bool_),
            tuple(map(int, row.images.n_defects)),
            tuple(record.timing),
            dict(record.parameters),
            run_dir / row.file,
        )


class BackgroundRun:
    """A run in a thread of this process. The thread that waits for it may be interrupted with Ctrl-C.

    Attributes:
        started: Set once all devices are open, or the run has ended.
        idle: Set while no control system waits for the end of a shot, or for its file.
        run_dir: Its folder. None before it has one.
    """

    def __init__(self, session: Session) -> None:
        self.started = threading.Event()
        self.idle = threading.Event()
        self.idle.set()
        self.run_dir: Path | None = None
        self._session = session
        self._error: BaseException | None = None
        session.observers.add(self)
        self._thread = threading.Thread(target=self._run, name="labseq run", daemon=True)

    def begin(self) -> None:
        """Start the thread."""
        self._thread.start()

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Note that the devices are open, and whether a shot is in progress."""
        if name == "run_started":
            self.run_dir = Path(values["run_dir"])
            self.started.set()
        elif name == "leader_signal":
            self.idle.clear()
        elif name in ("shot_finished", "shot_repeated"):
            self.idle.set()

    def raise_error(self) -> None:
        """Raise the error that ended the run, if any."""
        if self._error is not None:
            raise self._error

    def join(self) -> None:
        """Wait for the end of the run, when the devices are safe."""
        self._thread.join()

    def _run(self) -> None:
        try:
            self._session.run()
        except BaseException as error:  # noqa: BLE001 - raised in the thread that waits
            self._error = error
        self.ended()
        self.started.set()
        self.idle.set()

    def ended(self) -> None:
        """The run has ended."""


class AskedShots(BackgroundRun):
    """Takes the shots of a session one by one. Implements ``labseq.session.prepared.Points``."""

    def __init__(self, session: Session) -> None:
        super().__init__(session)
        if session.run_dir is not None:
            raise ConfigError("a session runs once; open another for the next run")
        if session.assembly.scanned is not None:
            raise ConfigError("shot() takes no scans, but the sequence has one; use run()")
        self._led: LedPoints | None = session.assembly.led
        self._first: Point = session.assembly.first_point
        # the run checks the first before it opens the devices; the points are kept so that ids stay unique
        self._checked = {id(self._first): self._first}
        self._asked = queue.SimpleQueue[Point | None]()
        self._results = queue.SimpleQueue[ShotResult | None]()
        self._has_begun = False
        session.points = self

    def take(self, values: Mapping[str, Any]) -> ShotResult:
        """Take a shot with these values. See :meth:`Session.shot`."""
        point = self._point(values)
        if not self._has_begun:
            self._has_begun = True
            self.begin()
        self._asked.put(point)
        try:
            result = self._results.get()
        except KeyboardInterrupt:
            self._session.stop_flag.request()
            raise
        if result is None:
            self.raise_error()
            raise ConfigError("the run has taken all its shots; ask for more with 'shots'")
        return result

    def end(self) -> None:
        """End the run, and wait until the devices are safe."""
        if self._has_begun:
            self._asked.put(None)
            self.join()

    def next(self, history: History) -> Point | None:
        """The point of the next shot, once it is asked for. Called by the run."""
        if history.last is None and not self.started.is_set():
            return self._first  # the devices are built before anything is asked
        while history.to_take:
            self._session.stop_flag.check()
            with suppress(queue.Empty):
                return self._asked.get(timeout=POLL_S)
        return None

    def known(self, history: History) -> Mapping[int, Point]:
        """The settings of the files."""
        del history
        return {0: self._first}

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Hand over a shot that is on disk."""
        super().event(name, values)
        if name == "shot_finished" and values["row"].counts and self.run_dir is not None:
            self._results.put(ShotResult.of(values["shot"], values["row"], self.run_dir))

    def ended(self) -> None:
        """Let the thread that waits for a shot continue."""
        self._results.put(None)

    def _point(self, values: Mapping[str, Any]) -> Point:
        """The settings with these values, checked once."""
        texts = {k: v if isinstance(v, str) else json.dumps(v) for k, v in values.items()}
        if self._led is None and texts:
            what = f"the sequence does not allow '{next(iter(texts))}' to be set for each shot"
            raise ConfigError(f"{what}; add 'leader: {{may_set: [{next(iter(texts))}]}}' to it")
        point = self._first if self._led is None else self._led.with_texts(texts)
        if id(point) not in self._checked:
            guard = Guard(StopFlag())
            try:
                check_settings(self._session, guard, point, self._session.build_lab(point))
            finally:
                guard.end()
            if len(self._checked) >= 1000:
                self._checked.clear()
            self._checked[id(point)] = point
        return point


@dataclass(frozen=True, slots=True)
class Served:
    """A run that another control system leads.

    Attributes:
        address: Address of labseq for the control system, for example "127.0.0.1:5750".
        run_dir: Folder of the run.
    """

    address: str
    run_dir: Path


@contextmanager
def serve(sequence: str | Path, **options: Any) -> Generator[Served]:
    """Run a sequence that another control system leads, in a thread of this process.

    The block begins when all devices are open and labseq listens. At its end, labseq finishes the current
    shot, makes the devices safe and closes them.

    Args:
        sequence: As for :meth:`Session.open`. A step `wait: {for: go, ...}` waits for the control system.
        **options: As for :meth:`Session.open`.

    Raises:
        ConfigError: The files have an error, or no device of the profile has an address.
        LabseqError: The error that ended the run.
    """
    with Session.open(sequence, **options) as session:
        run = BackgroundRun(session)
        run.begin()
        try:
            run.started.wait()
            run.raise_error()
            assert run.run_dir is not None
            yield Served(_address(run.run_dir), run.run_dir)
        finally:
            run.idle.wait()
            session.stop_flag.request()
            run.join()
        with suppress(StopRequested):
            run.raise_error()


def _address(run_dir: Path) -> str:
    """The address at which a control system finds labseq."""
    devices = json.loads((run_dir / RUN_FILE).read_text(encoding="utf-8"))["devices"]
    for about in devices.values():
        if "protocol" in about:
            return str(about["address"])
    raise ConfigError("no device of the profile has an address for a control system")
