"""A session, which takes a sequence on a profile from the files to the data, with each shot at its point."""

from __future__ import annotations

import gc
import signal
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager, nullcontext, suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, ParamSpec, Self

from labseq.assembly.assemble import Assembly, assemble
from labseq.assembly.options import DryRun, Options, path_of
from labseq.assembly.point import Point
from labseq.calibration_store import encode_entry
from labseq.data.reader import Run, open_run
from labseq.errors import ConfigError, DeviceError, RecordingError, StopRequested
from labseq.guard import stop_on_signals
from labseq.messages import error_text, format_error, visible
from labseq.model import RunRecord, ShotRecord
from labseq.model.records import RunStatus
from labseq.realtime import real_time
from labseq.recording import clear_active, data_root, find_dead_run, mark_active
from labseq.recording.folders import NOTES_FILE, NOTIFY_FILE, SOURCES_FILE, STOP_FILE, later_day
from labseq.recording.index import IndexRow
from labseq.recording.writer import RunWriter
from labseq.roles import RunObserver
from labseq.safety.locks import lock_devices
from labseq.sequencer.clock import ClockJumps
from labseq.sequencer.lab import Lab, describe
from labseq.sequencer.run import Sequencer, State
from labseq.session.alarms import Alarms
from labseq.session.check import check
from labseq.session.checks import Checks
from labseq.session.prepared import PreparedRun
from labseq.session.provenance import code_of, run_record
from labseq.session.sources import RunCode
from labseq.watchdog import WATCHDOG_LOG, Watchdog

if TYPE_CHECKING:
    from labseq.sequencer.shot import ShotSettings
    from labseq.session.asked import AskedShots, ShotResult
    from labseq.session.precision import Precision
    from labseq.session.resume import ResumableRun


P = ParamSpec("P")


@contextmanager
def only_new_garbage() -> Generator[None]:
    """Exclude existing objects from garbage collection, which would take 0.1 s of a shot."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


class Shots:
    """Takes the shots of a run, each at its point, which ``run.points`` chooses.

    Args:
        run: The run.
        lab: The devices, not open, at the first point.
        first: The first point.
        writer: Records the shots.
        watchdog: Switches the outputs off if this process dies or hangs.

    Attributes:
        sequencer: Takes each shot. The caller opens it and shuts it down.
    """

    def __init__(
        self, run: PreparedRun, lab: Lab, first: Point, writer: RunWriter, watchdog: Watchdog
    ) -> None:
        self._run = run
        self._point = first
        self._writer = writer
        assembly = run.assembly
        self._gives_alarms = assembly.sequence.alarms
        self._alarms = Alarms(assembly.hardware.profile.alarms, self._warn_of)
        self._clock_jumps = ClockJumps()
        self.sequencer = Sequencer(
            lab,
            first.steps,
            run.stop_flag,
            self,
            run.observers,
            seed=run.seed,
            policy=run.assembly.policy,
            parameters=self._parameters(first),
            watchdog=watchdog,
            place_of=writer.place_of,
            settings_for=self._settings_for(lab, first),
        )

    def _settings_for(self, lab: Lab, first: Point) -> Callable[[Mapping[str, str]], ShotSettings] | None:
        """Makes the settings of a shot from the values of a leader. None if it may set none."""
        if (led := self._run.assembly.led) is None:
            return None
        from labseq.session.led import LedShots  # most runs have no leader

        return LedShots(self._run, led, lab, self._parameters(first))

    def _warn_of(self, alarm: str, text: str) -> None:
        self._run.observers.event("warning", {"text": text, "alarm": alarm})

    def write_shot(self, shot: ShotRecord) -> IndexRow:
        """Write a shot with the clock jumps during it. Look for alarms while its frames are in memory."""
        if jumps := self._clock_jumps.since_last():
            shot.readings |= jumps
            about = {"shot": shot.shot_index, "attempt": shot.attempt}
            self._run.observers.event("clock_jumped", {**about, **jumps})
        row = self._writer.write_shot(shot)
        if self._gives_alarms:
            self._alarms.look(shot)
        return row

    def take_all(self, checks: Checks, precision: Precision | None) -> None:
        """Take the shots until none is left, the points end, or the fits are precise enough.

        Args:
            checks: Checks each shot. It may end the run, or skip the rest of a point.
            precision: Judges the fits. None if the run takes all its shots.

        Raises:
            StopRequested: The run was asked to end.
            CheckFailedError: A value is outside the limits of a check that stops the run.
            AlarmError: An alarm has lasted too long.
            LabseqError: Another error that ended the run before its last shot.
        """
        points, history = self._run.points, self._run.history
        last, why = checks.left_open
        if why:  # an earlier process may have died before it could record the skipped shots
            self._skip(history.later_at_its_point(last), why)
        while (point := points.next(history)) is not None:
            if (self._writer.run_dir / STOP_FILE).exists():  # `labseq stop` in another process
                raise StopRequested(signal.SIGTERM, after_shot=True)
            shot = history.to_take[0]
            self._move_to(point)
            failure = self.sequencer.take(shot)
            self._run.analyses.look()
            history.add(self._writer.run_dir, self._writer.last_row)
            if why := failure or checks.after(self._writer.last_row):
                self._skip([*([shot] if failure else []), *history.later_at_its_point(shot)], why)
            self._alarms.raise_if_lasting()
            if precision is not None and (why := precision.after(self._writer.last_row)):
                if history.to_take:
                    self._writer.ended_early = why
                    self._run.observers.event("ended_early", {"why": why, "n_left": len(history.to_take)})
                return

    def _move_to(self, point: Point) -> None:
        """Change the settings that differ between the present point and the next."""
        if point is self._point:
            return
        from labseq.assembly.points import rebuild_lab  # only scans have several points

        lab, reopened = rebuild_lab(self.sequencer.lab, self._point, point, self._run.seed)
        if lab.planner is not self.sequencer.lab.planner:
            self._run.choose_planner(lab, point)  # not in the shot, whose atoms would wait
        self.sequencer.change(lab, point.steps, self._parameters(point), reopened)
        self._point = point

    def _parameters(self, point: Point) -> dict[str, Any]:
        """The settings at a point that differ from the files, address -> value."""
        changes = {address: change["value"] for address, change in self._writer.run.overrides.items()}
        return {**changes, **point.parameters}

    def _skip(self, shots: Sequence[int], why: str) -> None:
        if not shots:
            return
        self._writer.skip(shots, why)
        self._run.history.skip(shots)
        which = f"shot {shots[0]} is" if len(shots) == 1 else f"{len(shots)} shots are"
        self._run.warn(f"{which} skipped: {why}")
        self._run.observers.event("shots_skipped", {"shots": [*shots], "why": why})


class Session(PreparedRun):
    """Context manager that opens a sequence, runs it, and leaves every device safe.

    Example:
        with labseq.Session.open("sequences/compact_225.yaml", shots=5) as session:
            run = session.run()
    """

    def __init__(
        self,
        assembly: Assembly,
        options: Options,
        observer: RunObserver | None,
        earlier: ResumableRun | None = None,
        warnings: Sequence[str] = (),
    ) -> None:
        before, done = (None, ()) if earlier is None else (earlier.run, earlier.done)
        root = earlier.root if earlier else options.output or data_root()
        super().__init__(assembly, observer, paced=options.realtime, root=root, run=before, done=done)
        self.options = options
        self._notes = _notes_file(options.note, options.tags)
        self.earlier = earlier
        self._warnings = warnings
        self.run_dir: Path | None = None
        # before devices are opened, because some vendors' libraries change the working folder
        self._cwd, self._profile_key = Path.cwd(), assembly.hardware.key
        self._lost = ""
        self._asked: AskedShots | None = None

    @classmethod
    def open(
        cls,
        sequence: str | Path,
        *,
        profile: str | Path | None = None,
        shots: int | None = None,
        seed: int | None = None,
        overrides: Sequence[str] = (),
        output: str | Path | None = None,
        dry_run: DryRun = "off",
        realtime: bool = False,
        note: str = "",
        tags: Sequence[str] = (),
        observer: RunObserver | None = None,
    ) -> Session:
        """Read and check sequence and profile, without opening anything.

        Args:
            sequence: The sequence file, or the name of a sequence in ./sequences or in labseq.
            profile: See :class:`Options`, also for all other options.
            shots: Number of shots.
            seed: Seed of the run.
            overrides: ``"address=value"`` strings.
            output: Folder for the data.
            dry_run: "off", "full" or "fast".
            realtime: Let virtual time pass at the speed of real time.
            note: A note about the run, for people, kept in its folder.
            tags: Words to find the run by.
            observer: Receives every event.

        Raises:
            ConfigError: Sequence, profile or an option has an error. The message names file, line and column.
            UnknownPluginError: A named plugin does not exist.
            PluginLoadError: A named plugin failed to load.
        """
        folder = None if output is None else path_of(output, "output")
        options = Options(profile, shots, seed, overrides, folder, dry_run, realtime, note, tags)
        return cls(assemble(path_of(sequence, "sequence"), options), options, observer)

    @classmethod
    def resume(
        cls,
        run: str | Path,
        *,
        shots: int | None = None,
        accept_changes: bool = False,
        realtime: bool = False,
        observer: RunObserver | None = None,
    ) -> Session:
        """Read back a run in order to take its missing shots, or more shots than it was begun with.

        It uses the sequence, the profile, the calibrations and the options that the run began with,
        even if the files have changed. Until the session is closed, no other process can resume the run.

        Args:
            run: The run's folder or any file in it, or its name or number.
            shots: New number of shots of the run, more than it was begun with. The run may be complete. A
                scan begins again with its first point after its last shot.
            accept_changes: Whether to continue although code, plugins or settings have changed. run.json
                records the changes.
            realtime: Let virtual time pass at the speed of real time.
            observer: Receives every event.

        Raises:
            ConfigError: The run is complete or in progress, or something has changed since it began.
            RecordingError: It is not a run, is damaged, of a newer labseq, or cannot be written to.
        """
        from labseq.session.resume import reopened

        assembly, options, earlier = reopened(
            path_of(run, "run"), shots, accept_changes=accept_changes, realtime=realtime
        )
        return cls(assembly, options, observer, earlier, earlier.warnings)

    @classmethod
    def rerun(
        cls,
        run: str | Path,
        *,
        same_seed: bool = False,
        shots: int | None = None,
        output: str | Path | None = None,
        realtime: bool = False,
        note: str = "",
        tags: Sequence[str] = (),
        observer: RunObserver | None = None,
    ) -> Session:
        """Prepare a new run with the sequence, the profile and the options of an earlier one.

        It uses the files' content from the start of the earlier run, even if the files have changed. Plugins
        and calibrations are current. Any difference from the earlier run is a warning.

        Args:
            run: The earlier run, as its folder or any file in it, its name or number.
            same_seed: Whether to take its seed, too.
            shots, output, realtime, note, tags, observer: See :meth:`open`. By default the note names the
                earlier run.

        Raises:
            ConfigError: There is no such run, or today it would have an error.
            RecordingError: The run is damaged, or its own files have been changed.
        """
        from labseq.session.resume import taken_again

        folder = None if output is None else path_of(output, "output")
        given = Options(shots=shots, output=folder, realtime=realtime, note=note, tags=tags)
        assembly, options, warnings = taken_again(path_of(run, "run"), given, same_seed=same_seed)
        return cls(assembly, options, observer, warnings=warnings)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the run of :meth:`shot`, and let other processes resume the run. Legal at any time."""
        if self._asked is not None:
            self._asked.end()
        if self.earlier is not None:
            self.earlier.release()

    def shot(self, values: Mapping[str, Any] | None = None) -> ShotResult:
        """Take the next shot. The first call opens the devices, and :meth:`close` makes them safe.

        Between the calls the run waits in a thread. It ends after as many shots as the sequence says.

        Args:
            values: Address -> value for this shot, as allowed by the sequence in `leader: {may_set: [...]}`.

        Raises:
            ConfigError: No shot is left, or a value is wrong or not allowed. Nothing was switched.
            LabseqError: The error that ended the run. Devices are safe, and the data is on disk.
        """
        if self._asked is None:
            from labseq.session.asked import AskedShots  # most runs take their shots by themselves

            self._asked = AskedShots(self)
        return self._asked.take(values or {})

    def run(self) -> Run:
        """Take all shots.

        Returns:
            The finished run, read back from disk.

        Raises:
            ConfigError: A device would refuse a step. Nothing was opened.
            StopRequested: Ctrl-C or SIGTERM. Devices are safe, and the data is on disk.
            LabseqError: The error that ended the run. Devices are safe, and the data is on disk.
        """
        if self.run_dir is not None:
            raise ConfigError("a session runs once; open another for the next run")
        if (data_root() / NOTIFY_FILE).is_file():
            from labseq.session.notices import Notices  # loads modules that other runs do not need

            self.observers.add(Notices.read())
        for text in self._warnings:
            self.warn(text)
        reading = self._reading_code()
        hardware, purpose = self.assembly.hardware, f"a run of {self.assembly.sequence.name}"
        with (
            stop_on_signals(self.stop_flag),
            lock_devices(hardware, purpose, self.warn) as describe_locks,
            closing(self.observers),
        ):
            # first of all, because constructing and compiling may fail
            if (dead := find_dead_run(hardware.key, hardware.identities)) is not None:
                from labseq.safety.safe import make_safe_after_crash

                make_safe_after_crash(dead, hardware, self.stop_flag, self.observers)
            first = self.points.next(self.history)
            if first is None:  # its process died between the last shot and the end of the run
                self._begin(first, reading)[1].finish("complete")
            else:
                lab, warnings = self._checked(first)
                with self._folder(first, reading, describe_locks) as (record, writer):
                    for text in dict.fromkeys([*warnings, *hardware.host.notes]):
                        self.warn(text)
                    self._take_shots(lab, first, record, writer)
                    if self.assembly.search is not None:
                        self._try(self._report_best, writer.run_dir)
        assert self.run_dir is not None
        return open_run(self.run_dir)

    def _checked(self, first: Point) -> tuple[Lab, list[str]]:
        """Check the run and compile its kernels. Returns the devices of the first shot, and warnings."""
        warnings = [str(problem) for problem in check(self, runs=True).warnings]
        points = {point.lab_key: point for point in self.points.known(self.history).values()}
        points.pop(first.lab_key, None)
        # built again, as the rehearsal used up random numbers and changed the states of simulated devices
        self.warm(lab := self.build_lab(first))
        for point in points.values():  # a kernel that is compiled between two shots would hold up the run
            self.warm(self.build_lab(point))
        return lab, warnings

    def _take_shots(self, lab: Lab, first: Point, record: RunRecord, writer: RunWriter) -> None:
        """Open the devices, take the shots, and leave every device safe."""
        log, pulse = writer.run_dir / WATCHDOG_LOG, self.stop_flag.pulse
        watchdog = Watchdog(f"the run {writer.run_dir}", log, pulse, self._end_without_watchdog)
        shots = Shots(self, lab, first, writer, watchdog)
        settings, target = self.assembly.sequence.policy.checks, self.assembly.target
        self.choose_planner(lab, first)
        before = () if self.earlier is None else self.earlier.rows
        # at the end, in reverse order, devices are made safe, analyses are waited for, the mark is removed
        with (
            only_new_garbage(),
            nullcontext() if lab.clock.virtual else real_time(),
            self._marked_active(writer.run_dir, shots.sequencer),
            self._analyses_finished(writer),
            self._devices(shots.sequencer, record, writer),
        ):
            checks = Checks(settings, writer.run_dir, before, target, self.analyses, self.warn)
            shots.take_all(checks, self._precision(writer.run_dir, before))

    def _precision(self, run_dir: Path, before: Sequence[IndexRow]) -> Precision | None:
        """Ends the run early, once the fits are precise. None if its sequence does not ask for it."""
        if not any("stop_when" in measure for measure in self.assembly.resolved["measure"]):
            return None
        from labseq.session.precision import Precision  # loads modules that other runs do not need

        return Precision(self.assembly, run_dir, before, self.stop_flag, self.warn)

    @contextmanager
    def _folder(
        self, first: Point, reading: Future[RunCode], describe_locks: Callable[[str], None]
    ) -> Generator[tuple[RunRecord, RunWriter]]:
        """Make the run's folder, and record there how the block ends."""
        record, writer = self._begin(first, reading)
        describe_locks(f"the run {writer.run_dir}")
        error: BaseException | None = None
        with self.observers.logged_by(writer.event):
            if self.earlier is None and (day := later_day(writer.run_dir)):
                self.warn(
                    f"the clock may be wrong, because {visible(str(self.root))} has later runs, of {day}"
                )
            try:
                yield record, writer
            except BaseException as failure:
                error = failure
                raise
            finally:
                status, text = _ending(error)
                self._try(writer.finish, status, text)
                self.observers.event("run_finished", {"record": record, "status": status, "error": text})

    @contextmanager
    def _marked_active(self, run_dir: Path, sequencer: Sequencer) -> Generator[None]:
        """Mark that devices may be on, so that the next run makes them safe if this process dies."""
        profile = self.assembly.hardware
        try:
            # without real devices nothing can be left on, and a mark that fails must not end the run
            with nullcontext() if profile.identities else suppress(RecordingError):
                mark_active(self._profile_key, profile.identities, run_dir)
            yield
        finally:
            if sequencer.state is State.CLOSED and not sequencer.unsafe:
                self._try(clear_active, self._profile_key, profile.identities)

    @contextmanager
    def _analyses_finished(self, writer: RunWriter) -> Generator[None]:
        """Give the analyses time for the last shots."""
        try:
            yield
        finally:
            if not writer.is_given_up:
                self._try(self.analyses.finish)

    @contextmanager
    def _devices(self, sequencer: Sequencer, record: RunRecord, writer: RunWriter) -> Generator[None]:
        """Open the devices. However the block ends, they are made safe and closed first.

        Raises:
            DeviceError: The watchdog was lost, or a device is not safe after the block has ended well.
        """
        about = {"record": record, "run_dir": str(writer.run_dir), "n_before": writer.n_written}
        try:
            self.observers.event("run_starting", about)
            sequencer.open()
            writer.set_devices(describe(sequencer.lab, sequencer.guard))
            self.analyses.start(writer.run_dir)
            self.observers.event("run_started", about)
            yield
        except BaseException as error:
            sequencer.shut_down()
            if self._lost:
                raise DeviceError("watchdog", self._lost) from error
            raise
        if unsafe := sequencer.shut_down(ended_well=True):
            reasons = "; ".join(str(failure) for failure in unsafe.values())
            raise DeviceError(next(iter(unsafe)), f"not in its safe state after the run: {reasons}")

    def _end_without_watchdog(self, why: str) -> None:
        """Make the run end. Called by the thread of the heartbeat."""
        self._lost = why
        self.stop_flag.request(signal.SIGTERM)

    def _reading_code(self) -> Future[RunCode]:
        """Read the sources of the plugins and ask git, which takes 0.1 s, while the run is checked."""
        threads = ThreadPoolExecutor(1)
        code = threads.submit(code_of, self.assembly, self._cwd)
        threads.shutdown(wait=False)
        return code

    def _begin(self, first: Point | None, reading: Future[RunCode]) -> tuple[RunRecord, RunWriter]:
        """Create the run's folder, or reopen a resumed run's folder. ``first`` is its next point, if any."""
        changes, earlier, code = self.options.changes(), self.earlier, reading.result()
        if not code.is_of(self.assembly.hardware.host):  # a constructed planner may use another plugin
            code = code_of(self.assembly, self._cwd)
        record = run_record(self.assembly, self.seed, changes, self._cwd, code)
        if earlier is None:
            calibrations = self.assembly.hardware.calibrations.items()
            extra_files = {f"calibration_{kind}.json": encode_entry(entry) for kind, entry in calibrations}
            extra_files |= self._notes | {SOURCES_FILE: code.archive}
            writer = RunWriter.create(self.root, record, extra_files, self.stop_flag)
        else:
            first_shot = None if first is None else self.history.to_take[0]
            writer = earlier.reopen(record, code, first_shot, self.stop_flag)
        self.run_dir = writer.run_dir
        return record, writer

    def _report_best(self, run_dir: Path) -> None:
        """Record the best point of an adaptive scan, with its value and the suggested values."""
        from labseq.data.best import best_point  # only adaptive scans have one

        best = best_point(open_run(run_dir))
        if best is not None:
            self.observers.event("scan_result", best.as_json())

    def _try(self, act: Callable[P, None], *args: P.args, **kwargs: P.kwargs) -> None:
        """Write to disk at the end of a run. A full disk must not hide the error that ended the run."""
        try:
            act(*args, **kwargs)
        except Exception as failure:  # noqa: BLE001 - nothing hides the error that ended the run
            self.warn(error_text(failure))


def _notes_file(note: str, tags: Sequence[str]) -> dict[str, bytes]:
    """The note about a run and its tags as a file for the run's folder. {} without any.

    Raises:
        ConfigError: The note or a tag is too long.
    """
    if not (note or tags):
        return {}
    from labseq.recording.notes import Notes

    return {NOTES_FILE: Notes.of(note, tags).encoded()}


def _ending(error: BaseException | None) -> tuple[RunStatus, str]:
    """The status in which a run ended, and the reason."""
    if error is None:
        return "complete", ""
    if isinstance(error, StopRequested):
        return "stopped", str(error)
    status: RunStatus = "stopped" if isinstance(error, KeyboardInterrupt) else "failed"
    return status, format_error(error)
