"""A session: one sequence on one profile, from the files to the data."""

from __future__ import annotations

import gc
import secrets
import signal
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, nullcontext, suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, ParamSpec, Self

from labseq.errors import ConfigError, DeviceError, LabseqError, RecordingError
from labseq.guard import StopFlag, stop_on_signals
from labseq.messages import error_text, visible
from labseq.model import RunRecord
from labseq.realtime import real_time
from labseq.recording import Run, RunWriter, clear_active, data_root, mark_active, open_run
from labseq.recording.best import best_point
from labseq.recording.folders import later_day
from labseq.roles import RunObserver
from labseq.sequencer.lab import Lab, describe
from labseq.sequencer.run import Sequencer
from labseq.session.analyses_beside import AnalysesBeside
from labseq.session.assembly import Assembly, assemble
from labseq.session.check import check
from labseq.session.chosen import DryRun
from labseq.session.lab import build_lab, clock_for, warm
from labseq.session.locks import lock_devices
from labseq.session.observers import Observers
from labseq.session.options import Options, path_of
from labseq.session.policies import Checks
from labseq.session.provenance import copies, ending, run_record
from labseq.session.safe import make_safe_after_crash
from labseq.session.scan import Point
from labseq.session.scan_run import OwnShots, scan_run_of
from labseq.watchdog import WATCHDOG_LOG, Watchdog

if TYPE_CHECKING:
    from labseq.session.resume import ResumableRun


P = ParamSpec("P")


class Session:
    """Opens a sequence, runs it, and leaves every device safe; a context manager.

    Example::

        with labseq.Session.open("sequences/compact_225.yaml", shots=5) as session:
            run = session.run()
    """

    def __init__(
        self,
        assembly: Assembly,
        options: Options,
        observer: RunObserver | None = None,
        earlier: ResumableRun | None = None,
    ) -> None:
        self.assembly = assembly
        self.options = options
        self.earlier = earlier
        seed = assembly.sequence.seed if earlier is None else earlier.run.seed
        self.seed = secrets.randbits(63) if seed is None else seed
        self.run_dir: Path | None = None
        # Before devices are opened: some vendors' libraries change the working folder.
        self._folder, self._profile_key = Path.cwd(), assembly.hardware.key
        self.stop_flag = StopFlag()
        before, done = (None, ()) if earlier is None else (earlier.run, earlier.done)
        self._observers = Observers(assembly.hardware.host, observer)
        self._analyses = self._analyses_beside(before)
        self._observers.after_shot = self._analyses.look
        self.scan_run = scan_run_of(assembly, self.seed, self.stop_flag, before, done, self._analyses)
        self._hold: Callable[[str], None] = lambda _: None
        self._sequencer: Sequencer | None = None
        self._lost = ""

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
        observer: RunObserver | None = None,
    ) -> Session:
        """Read and check sequence and profile; nothing is opened yet.

        Args:
            sequence: The sequence file, or the name of one in ./sequences or of one that comes with labseq.
            profile: See :class:`Options`, as for all others.
            shots: Number of shots.
            seed: Seed of the run.
            overrides: ``"address=value"`` strings.
            output: Folder for the data.
            dry_run: "off", "full" or "fast".
            realtime: Let virtual time pass at the speed of real time.
            observer: Receives every event.

        Raises:
            ConfigError: Sequence, profile or an option has an error; names file, line and column.
            UnknownPluginError: A plugin that is named does not exist.
            PluginLoadError: A plugin that is named failed to load.
        """
        folder = None if output is None else path_of(output, "output")
        options = Options(profile, shots, seed, overrides, folder, dry_run, realtime)
        return cls(assemble(path_of(sequence, "sequence"), options), options, observer)

    @classmethod
    def resume(
        cls,
        run: str | Path,
        *,
        accept_changes: bool = False,
        realtime: bool = False,
        observer: RunObserver | None = None,
    ) -> Session:
        """Read back a run that ended before its last shot, in order to take the missing shots.

        It uses the sequence, the profile, the calibrations and the options that the run began with,
        even if the files have changed. Until the session is closed, no other process can resume the run.

        Args:
            run: The run's folder or any file in it.
            accept_changes: Whether to continue although code, plugins or settings have changed; run.json
                records the changes.
            realtime: Let virtual time pass at the speed of real time.
            observer: Receives every event.

        Raises:
            ConfigError: The run is complete or in progress, or something has changed since it began.
            RecordingError: It is no run, is damaged, of a newer labseq, or cannot be written to.
        """
        from labseq.session.resume import reopened

        assembly, options, earlier = reopened(
            path_of(run, "run"), accept_changes=accept_changes, realtime=realtime
        )
        return cls(assembly, options, observer, earlier)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Make every device safe and close it; legal at any time."""
        self._shut_down()
        if self.earlier is not None:
            self.earlier.release()

    def run(self) -> Run:
        """Take all shots.

        Returns:
            The finished run, read back from disk.

        Raises:
            ConfigError: A device would refuse a step; nothing was opened.
            StopRequested: Ctrl-C or SIGTERM; devices are safe, the data is on disk.
            LabseqError: The error that ended the run; devices are safe, the data is on disk.
        """
        if self.run_dir is not None:
            raise ConfigError("a session runs once; open another for the next run")
        root = self.options.output or data_root()
        root = root if self.earlier is None else self.earlier.root
        root = root.absolute()  # some vendors' libraries change the folder
        for text in () if self.earlier is None else self.earlier.warnings:
            self._warn(text)
        with ExitStack() as stack:
            stack.enter_context(stop_on_signals(self.stop_flag))
            hardware, what = self.assembly.hardware, f"a run of {self.assembly.sequence.name}"
            self._hold = stack.enter_context(lock_devices(hardware, what, self._warn))
            make_safe_after_crash(hardware, self.stop_flag, self._observers)
            if not self.scan_run.shots:  # its process died between the last shot and the end of the run
                _, writer = self._begin(root)
                writer.finish("complete")
                return open_run(writer.run_dir)
            warnings = [str(problem) for problem in check(self, runs=True).warnings]
            first, *others = self.scan_run.known_labs()
            self.warm(lab := self.build_lab(first))
            for point in others:
                self.warm(self.build_lab(point))
            gc.freeze()  # loaded modules stay: searching them for garbage would take 0.1 s of a shot
            stack.callback(gc.unfreeze)
            return self._run(lab, root, warnings)

    def build_lab(self, point: Point | None = None) -> Lab:
        """Construct the object of every role with the run's clock; no device is opened.

        Args:
            point: Point of the scan; None for the first one.
        """
        clock = clock_for(self.stop_flag, virtual=self.assembly.virtual_time, paced=self.options.realtime)
        return build_lab(point or self.assembly.first_point, self.assembly.target, clock, self.seed)

    def warm(self, lab: Lab, *, devices: bool = True) -> None:
        """Compile the kernels of a lab; see :func:`labseq.session.lab.warm`."""
        warm(lab, self.stop_flag, self._observers, devices=devices)

    def _run(self, lab: Lab, root: Path, warnings: Sequence[str]) -> Run:
        record, writer = self._begin(root)
        for text in dict.fromkeys([*warnings, *self.assembly.hardware.host.notes]):
            self._warn(text)
        error: BaseException | None = None
        try:
            with nullcontext() if lab.clock.virtual else real_time():
                self._take_shots(lab, writer, record)
        except BaseException as failure:  # noqa: BLE001 - raised again once the run is over
            error = DeviceError("watchdog", self._lost) if self._lost else failure
        unsafe = self._shut_down(ended_well=error is None)
        if not writer.is_given_up:
            self._try(self._analyses.finish)
        if error is None and self.scan_run.is_adaptive:
            self._try(self._report_best, writer.run_dir)
        if error is None and unsafe:
            reasons = "; ".join(str(failure) for failure in unsafe.values())
            error = DeviceError(next(iter(unsafe)), f"not in its safe state after the run: {reasons}")
        self._finish(writer, record, error)
        if not unsafe:
            self._try(clear_active, self._profile_key, self.assembly.hardware.identities)
        self._observers.end()
        if error is not None:
            raise error
        return open_run(writer.run_dir)

    def _take_shots(self, lab: Lab, writer: RunWriter, record: RunRecord) -> None:
        about = {"record": record, "run_dir": str(writer.run_dir), "n_before": writer.n_written}
        log, pulse = writer.run_dir / WATCHDOG_LOG, self.stop_flag.pulse
        watchdog = Watchdog(f"the run {writer.run_dir}", log, pulse, self._end_without_watchdog)
        first, policy = self.scan_run.first, self.assembly.policy
        own = OwnShots(lab, first, record, policy, self.stop_flag, writer, self._observers, watchdog)
        sequencer = self._sequencer = own.sequencer
        profile = self.assembly.hardware
        with nullcontext() if profile.identities else suppress(RecordingError):
            mark_active(self._profile_key, profile.identities, writer.run_dir)
        self._observers.event("run_starting", about)
        sequencer.open()
        writer.set_devices(describe(lab, sequencer.guard))
        self._analyses.start(writer.run_dir)
        self._observers.event("run_started", about)
        before = () if self.earlier is None else self.earlier.rows
        settings, target = self.assembly.sequence.policy.checks, self.assembly.target
        checks = Checks(settings, writer.run_dir, before, target, self._analyses, self._warn)
        self.scan_run.run(own, writer, checks, self._observers.event)

    def _end_without_watchdog(self, why: str) -> None:
        """Have the run end; called by the thread of the heartbeat."""
        self._lost = why
        self.stop_flag.request(signal.SIGTERM)

    def _analyses_beside(self, run: Run | None) -> AnalysesBeside:
        """The analyses of the sequence, and what the run needs of their results."""
        checks, search = self.assembly.sequence.policy.checks, self.assembly.search
        needed = {check.value: "" for check in checks}
        needed |= {check.value: "for a check that stops it" for check in checks if check.then == "stop"}
        if search is not None:
            needed[search.adaptive.quantity] = "to choose the next point"
        analyses = self.assembly.resolved["analysis"]
        return AnalysesBeside(analyses, needed, self._observers, self.stop_flag, run)

    def _begin(self, root: Path) -> tuple[RunRecord, RunWriter]:
        """Create the run's folder, or reopen that of a resumed run."""
        changes, scan, earlier = self.options.changes(), self.scan_run.record(), self.earlier
        record = run_record(self.assembly, self.seed, changes, scan, self._folder)
        if earlier is None:
            extra_files = copies(self.assembly.hardware.calibrations)
            writer = RunWriter.create(root, record, extra_files, self.stop_flag)
        else:
            writer = earlier.reopen(record, next(iter(self.scan_run.shots), None), self.stop_flag)
        self.run_dir = writer.run_dir
        self._observers.log = writer.event
        if earlier is None and (day := later_day(writer.run_dir)):
            text = (
                f"{visible(str(root))} has runs of {day}: this run is listed before them; is the clock right?"
            )
            self._warn(text)
        self._hold(f"the run {writer.run_dir}")
        return record, writer

    def _report_best(self, run_dir: Path) -> None:
        """Record the best point of an adaptive scan, with its value and the suggested one."""
        best = best_point(open_run(run_dir))
        if best is not None:
            self._observers.event("scan_result", best.as_dict())

    def _warn(self, text: str) -> None:
        self._observers.event("warning", {"text": text})

    def _shut_down(self, *, ended_well: bool = False) -> Mapping[str, LabseqError]:
        return self._sequencer.shut_down(ended_well=ended_well) if self._sequencer is not None else {}

    def _finish(self, writer: RunWriter, record: RunRecord, error: BaseException | None) -> None:
        status, text = ending(error)
        self._try(writer.finish, status, text)
        self._observers.event("run_finished", {"record": record, "status": status, "error": text})

    def _try(self, act: Callable[P, None], *args: P.args, **kwargs: P.kwargs) -> None:
        """Write to disk at the end of a run; a full disk must not hide the error that ended the run."""
        try:
            act(*args, **kwargs)
        except Exception as failure:  # noqa: BLE001 - nothing hides the error that ended the run
            self._warn(error_text(failure))
