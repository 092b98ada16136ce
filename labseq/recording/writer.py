"""Writes a run's folder while the run is in progress."""

from __future__ import annotations

import hashlib
import itertools
import shutil
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Final, ParamSpec, TypeVar

from labseq.errors import DeviceError, DeviceHungError, RecordingError, StopRequested
from labseq.files import LineLog, explained, make_folder, sync_folder, write_file
from labseq.guard import Guard, StopFlag
from labseq.model import RunRecord, ShotRecord
from labseq.model.image_quantities import measured_in
from labseq.model.records import RunStatus
from labseq.plain import dumps, now_utc
from labseq.recording import folders
from labseq.recording.index import IndexRow, row_of_record
from labseq.recording.run_file import encode_run, encode_state, encode_text, read_run

if TYPE_CHECKING:
    from labseq.recording.shot_encoder import ShotEncoder


P = ParamSpec("P")
T = TypeVar("T")

ANSWER_S: Final = 5.0
"""Time limit for writing a file. After that nothing more is written, and the run ends."""


class RunWriter:
    """The folder of a run in progress, opened by :meth:`create` or :meth:`reopen` and used by one process.

    A shot is complete on the disk before its line is in the index. So the shots
    in the index are intact even after a kill or a full disk.

    A separate thread writes to the disk. If the disk does not answer within ANSWER_S, or the run is asked
    to stop twice, that thread is abandoned so that the devices are made safe. Nothing is written after that.

    Attributes:
        run_dir: The run's folder.
        run: The run's record, of which each shot has a copy.
        n_written: Number of shots written that count. Failed attempts do not count.
        ended_early: Why the run is complete before its last shot, or "".
        is_given_up: True if the disk did not answer, so that nothing more is written.
    """

    def __init__(self, run_dir: Path, run: RunRecord, stop: StopFlag | None = None) -> None:
        self.run_dir = run_dir
        self._guard = Guard(stop)
        self.is_given_up = False
        self.n_written = 0
        self.ended_early = ""
        self._last_row: IndexRow | None = None
        self.run = run
        self._encoder = self._make_encoder()
        self._index = LineLog(run_dir / folders.INDEX_FILE)
        self._events = LineLog(run_dir / folders.EVENTS_FILE)
        self._events_lock = threading.Lock()
        self._n_events_lost = 0
        self._began_s = time.monotonic()
        # run.json, if another process began the run, because its settings are those of the first shots
        self._before: dict[str, Any] | None = None
        self._existing_files: frozenset[str] = frozenset()

    @classmethod
    def create(
        cls,
        root: Path,
        run: RunRecord,
        extra_files: Mapping[str, str | bytes] | None = None,
        stop: StopFlag | None = None,
    ) -> RunWriter:
        """Create ``<root>/<local date>/<counter>_<name>/`` and write the files that a run starts with.

        Several processes may call it at the same time.

        Args:
            root: Data root. Created if it does not exist.
            run: The record of the run before its devices are open.
            extra_files: Further files for the folder: name -> content.
            stop: The request to stop the run.

        Raises:
            RecordingError: The folder cannot be written to, or the disk is full.
        """
        run_dir = folders.make_run_folder(root, run.name, datetime.fromisoformat(run.t_start_utc))
        try:
            with explained(run_dir):
                make_folder(run_dir / folders.SHOTS_FOLDER)
            # run.json comes last, because a folder without one holds no shots and may be deleted
            write_file(run_dir / folders.STATE_FILE, encode_state("running"))
            texts = {folders.SEQUENCE_FILE: run.sequence_text, folders.PROFILE_FILE: run.profile_text}
            for name, content in {**texts, **(extra_files or {})}.items():
                write_file(run_dir / name, encode_text(content) if isinstance(content, str) else content)
            writer = cls(run_dir, run, stop)
            writer._on_disk(writer._write_run_file)()  # also starts the thread, while there is memory for one
            with explained(run_dir):
                sync_folder(run_dir)
        except BaseException:
            shutil.rmtree(run_dir, ignore_errors=True)  # it holds no shots yet
            raise
        return writer

    @classmethod
    def reopen(
        cls, run_dir: Path, run: RunRecord, *, n_written: int, stop: StopFlag | None = None
    ) -> RunWriter:
        """Resume a run that ended before its last shot. No other process may write to it.

        Args:
            run: Its current record, for the files of the next shots. In run.json, only ``resumed`` changes,
                and settings that follow from the number of shots if that has grown. All other settings there
                stay those of the first shots. ``resumed`` contains changes that were accepted.
            n_written: Number of shots written before that count.
            stop: The request to stop the run.

        Raises:
            RecordingError: The folder cannot be written to, the disk is full, or run.json is damaged.
        """
        before: dict[str, Any] = {**read_run(run_dir), "resumed": run.resumed}
        if run.n_shots != before["n_shots"]:
            before |= {"n_shots": run.n_shots, "scan": run.scan}
            for name in ("overrides", "resolved"):
                before[name] = {**before[name], "shots": getattr(run, name)["shots"]}
        with explained(run_dir):
            (run_dir / folders.STOP_FILE).unlink(missing_ok=True)
            # all files, because one may have been written without its line in the index
            existing = frozenset(path.name for path in (run_dir / folders.SHOTS_FOLDER).iterdir())
        writer = cls(run_dir, run, stop)
        writer.n_written, writer._before, writer._existing_files = n_written, before, existing
        writer._on_disk(writer._write_run_file)()
        write_file(run_dir / folders.STATE_FILE, encode_state("running"))
        return writer

    @property
    def last_row(self) -> IndexRow:
        """The last attempt that was written, as the index lists it. There must be one."""
        assert self._last_row is not None
        return self._last_row

    def set_devices(self, devices: Mapping[str, Mapping[str, Any]]) -> None:
        """Add the descriptions of the devices. Call it before the first shot, when they are open.

        Raises:
            RecordingError: The disk is full.
        """
        self.run = replace(self.run, devices=devices)
        self._encoder = self._make_encoder()
        if self._before is not None:
            if self._before.get("devices"):
                return
            self._before["devices"] = devices  # the run ended before they were open
        self._on_disk(self._write_run_file)()

    def _write_run_file(self) -> None:
        """Write run.json. For a resumed run, it stays as the first process wrote it."""
        if self._before is None:
            data = encode_run(self.run, run_id_of(self.run_dir))
        else:
            data = dumps(self._before, indent=1).encode() + b"\n"
        write_file(self.run_dir / folders.RUN_FILE, data)

    def _make_encoder(self) -> ShotEncoder:
        from labseq.recording.shot_encoder import ShotEncoder  # h5py takes 0.1 s to import

        return ShotEncoder(self.run, run_id_of(self.run_dir))

    def write_shot(self, shot: ShotRecord) -> IndexRow:
        """Write an attempt at a shot. It counts if it is complete.

        Returns:
            The attempt as the index lists it. Its file and its line are on the disk.

        Raises:
            RecordingError: The disk is full, or the record contradicts itself.
                The shots written before are intact, and this one may be written again.
        """
        data = self._encoder.encode(shot)
        file = self._free_name(shot.shot_index, shot.attempt, counts=shot.status == "complete")
        row = row_of_record(
            shot,
            shot.target or self.run.target,
            file=file,
            sha256="",
            n_bytes=data.nbytes,
            measured=measured_in(self.run.resolved),
        )
        sha256 = SimpleQueue[str]()
        wait = self._on_disk(self._write_shot, row, data, sha256)
        sha256.put(hashlib.sha256(data).hexdigest())  # while the disk writes
        self._last_row = row = wait()
        self.n_written += row.counts
        return row

    def _write_shot(self, row: IndexRow, data: memoryview, sha256: SimpleQueue[str]) -> IndexRow:
        """Write the file of an attempt, then its line in the index. Return that line."""
        path = self.run_dir / row.file
        with self._guard.step(f"{path.name} ", ANSWER_S, "disk"):
            write_file(path, data)
        row = replace(row, sha256=sha256.get())
        with self._guard.step(f"{folders.INDEX_FILE} ", ANSWER_S, "disk"):
            self._index.append(row, sync=True)
        return row

    def _on_disk(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Callable[[], T]:
        """Begin to write something, and return a function that waits until it is written.

        Raises:
            RecordingError: The disk does not answer, or ``work`` raised it.
            StopRequested: The run was asked to stop twice.
        """
        no_answer = RecordingError(self.run_dir, "cannot be written: the disk does not answer")
        if self.is_given_up:
            raise no_answer
        # twice the limit, because a shot is written to two files, its own and the index
        _, result = self._guard.begin("disk", 2 * ANSWER_S, partial(work, *args, **kwargs), is_patient=False)

        def wait() -> T:
            try:
                return result()
            except (DeviceHungError, StopRequested) as error:
                self.is_given_up = True
                if isinstance(error, StopRequested):
                    raise
                raise no_answer from error
            except DeviceError as error:
                raise RecordingError(self.run_dir, f"cannot be written: {error}") from error

        return wait

    def skip(self, shots: Sequence[int], why: str) -> None:
        """Record that shots will not be taken, even if the run is resumed.

        Raises:
            RecordingError: The disk is full.
        """
        self._on_disk(self._skip, {"shots": list(shots), "why": why, "t_utc": now_utc()})()

    def _skip(self, row: Mapping[str, Any]) -> None:
        LineLog(self.run_dir / folders.SKIPPED_FILE).append(row, sync=True)
        with explained(self.run_dir):
            sync_folder(self.run_dir)  # the file may not exist yet

    def place_of(self, shot_index: int) -> dict[str, str]:
        """Where a shot will be recorded if it counts: the folder "run" and the "file" in it."""
        return {"run": str(self.run_dir), "file": self._free_name(shot_index, 0, counts=True)}

    def _free_name(self, shot_index: int, attempt: int, *, counts: bool) -> str:
        """The name of a shot's file, different from names that the run had before it was resumed."""
        for take in itertools.count(1):
            file = folders.shot_file_name(shot_index, attempt, counts=counts, take=take)
            if Path(file).name not in self._existing_files:
                return file
        raise AssertionError

    def event(self, name: str, /, **values: Any) -> None:
        """Add a line to the event log. Never raises, from any thread.

        A line that cannot be written is lost. The next line says how many were.
        """
        line: dict[str, Any] = {
            "t_utc": now_utc(),
            "t_s": round(time.monotonic() - self._began_s, 6),  # whatever happens to the clock
            "event": name,
            "values": values,
        }
        if self.is_given_up:
            return
        with self._events_lock:
            if self._n_events_lost:
                line["n_lost_before"] = self._n_events_lost
            try:
                self._events.append(line, sync=False)  # losing an event is harmless, so no sync
                self._n_events_lost = 0
            except RecordingError:
                self._n_events_lost += 1

    def finish(self, status: RunStatus, error: str = "") -> None:
        """Record how the run ended.

        Raises:
            RecordingError: The disk is full. The run counts as failed once this
                process has ended.
        """
        try:
            self._on_disk(self._finish, status, error)()
        finally:
            self._guard.end()

    def _finish(self, status: RunStatus, error: str) -> None:
        with suppress(OSError):
            (self.run_dir / folders.STOP_FILE).unlink(missing_ok=True)
        # the state comes last, so that a reader that sees it finds all other lines
        self.event("run_finished", status=status, error=error, n_shots=self.n_written)
        write_file(self.run_dir / folders.STATE_FILE, encode_state(status, error, self.ended_early))


def run_id_of(run_dir: Path) -> str:
    """The id of a run, which consists of the names of its last two folders."""
    return f"{run_dir.parent.name}/{run_dir.name}"
