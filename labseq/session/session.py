"""A session: one sequence on one profile, from the files to the data."""

from __future__ import annotations

import gc
import itertools
import secrets
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import ParamSpec, Self

from labseq.calibrations import encode_entry
from labseq.errors import ConfigError, DeviceError, LabseqError, StopRequested
from labseq.model import RunRecord, TimelineEntry
from labseq.model.records import RunStatus
from labseq.recording import (
    Run,
    RunWriter,
    clear_active,
    data_root,
    died,
    mark_active,
    marker_roots,
    open_run,
)
from labseq.roles import RunObserver
from labseq.sequencer import Guard, PacedClock, RealClock, Sequencer, StopFlag, VirtualClock
from labseq.sequencer.lab import Lab, describe
from labseq.sequencer.run import lay_out
from labseq.session.assembly import Assembly, assemble
from labseq.session.choosing import DryRun
from labseq.session.commands import check_commands
from labseq.session.labs import build_lab
from labseq.session.observers import Observers
from labseq.session.options import Options, path_of
from labseq.session.provenance import gather_provenance
from labseq.session.safe import secure_bench
from labseq.session.scan import Point
from labseq.session.scan_run import Course
from labseq.session.signals import stop_on_signals
from labseq.session.warming import warm

P = ParamSpec("P")


class Session:
    """Opens a sequence, runs it, and leaves every device safe; a context manager.

    Example::

        with labseq.Session.open("sequences/compact_225.yaml", shots=5) as session:
            run = session.run()
    """

    def __init__(self, assembly: Assembly, options: Options, observer: RunObserver | None = None) -> None:
        self.assembly = assembly
        self.options = options
        self.seed = assembly.sequence.seed
        if self.seed is None:
            self.seed = secrets.randbits(63)
        self.course = Course(assembly, self.seed)
        self.run_dir: Path | None = None
        # What the hardware is known by; a dry run touches none, and says nothing about it.
        profile = assembly.bench.hardware_key  # now: vendors' libraries change the folder
        self._profile_key = profile if options.dry_run == "off" else f"{profile} (dry run)"
        self.stop_flag = StopFlag()
        self._observers = Observers(assembly.bench.host, observer)
        self._sequencer: Sequencer | None = None

    @classmethod
    def open(
        cls,
        sequence: str | Path,
        *,
        profile: str | None = None,
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
            sequence: The sequence file.
            profile: See :class:`Options`, as for all others.
            shots: Number of shots.
            seed: Seed of the run.
            overrides: ``"address=value"`` strings.
            output: Folder for the data.
            dry_run: "off", "full" or "fast".
            realtime: Let virtual time take as long as it says.
            observer: Told everything that happens.

        Raises:
            ConfigError: Sequence, profile or an option is wrong; names file, line and column.
            UnknownPluginError: A plugin that is named does not exist.
            PluginLoadError: A plugin that is named failed to load.
        """
        folder = None if output is None else path_of(output, "output")
        options = Options(profile, shots, seed, tuple(overrides), folder, dry_run, realtime)
        assembly = assemble(
            path_of(sequence, "sequence"),
            profile=profile,
            overrides=overrides,
            given=options.own(),
            dry_run=dry_run,
        )
        return cls(assembly, options, observer)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Make every device safe and close it; legal at any time."""
        self._shut_down()

    def timeline(self) -> list[tuple[str, list[TimelineEntry]]]:
        """What a shot will do: name of each step and its bars."""
        lab, guard = self.build_lab(), Guard(self.stop_flag)
        timeline = [
            (name, guard.call("step", lab.timeouts.call_s, lay_out, step, number, name, lab.step_context))
            for number, (name, step) in enumerate(self.assembly.steps)
        ]
        guard.end()
        return timeline

    def run(self) -> Run:
        """Take all shots.

        Returns:
            The finished run, read back from disk.

        Raises:
            ConfigError: A step sends a command that its device does not know; nothing was opened.
            StopRequested: Ctrl-C or SIGTERM; devices are safe, the data is on disk.
            LabseqError: Whatever ended the run; devices are safe, the data is on disk.
        """
        if self.run_dir is not None:
            raise ConfigError("a session runs once; open another for the next run")
        roots = marker_roots(self.options.output or data_root())
        for text in self.assembly.warnings:
            self._observers.event("warning", {"text": text})
        check_commands(self.assembly, self.course.each(), self.build_lab)
        with stop_on_signals(self.stop_flag):
            self._secure_after_crash(roots)
            labs = (self.build_lab(point) for point in self.course.each_lab())
            lab = next(labs)
            for one in itertools.chain([lab], labs):
                self.warm(one)
            gc.collect()
            gc.freeze()  # what is loaded by now stays: going through it all would take 0.1 s of a shot
            return self._run(lab, roots)

    def build_lab(self, point: Point | None = None) -> Lab:
        """Construct every role's object on the clock that the run will have; nothing is opened.

        Args:
            point: Of the scan; None for the first one.
        """
        assert self.seed is not None
        if not self.assembly.virtual_time:
            clock = RealClock(self.stop_flag)
        elif self.options.realtime:
            clock = PacedClock(self.stop_flag)
        else:
            clock = VirtualClock(self.stop_flag)
        return build_lab(point or self.assembly.at(0), self.assembly.target, clock, self.seed)

    def warm(self, lab: Lab, *, devices: bool = True) -> None:
        """Compile what a lab will need; see :func:`labseq.session.warming.warm`."""
        warm(lab, self.stop_flag, self._observers, devices=devices)

    def _run(self, lab: Lab, roots: Sequence[Path]) -> Run:
        record = self._record(lab)
        calibrations = self.assembly.bench.calibrations
        copies = {f"calibration_{kind}.json": encode_entry(e) for kind, e in calibrations.items()}
        writer = RunWriter.create(roots[0], record, copies)
        self.run_dir = writer.run_dir
        self._observers.log = writer.event
        error: BaseException | None = None
        try:
            self._take_shots(lab, roots, writer, record)
        except BaseException as failure:  # noqa: BLE001 - raised again once the run is over
            error = failure
        unsafe = self._shut_down()
        if error is None and unsafe:
            reasons = "; ".join(str(failure) for failure in unsafe.values())
            error = DeviceError(next(iter(unsafe)), f"not in its safe state after the run: {reasons}")
        self._finish(writer, record, error)
        if not unsafe:
            self._try(clear_active, roots, self._profile_key)
        self._observers.end()
        if error is not None:
            raise error
        return open_run(writer.run_dir)

    def _take_shots(self, lab: Lab, roots: Sequence[Path], writer: RunWriter, record: RunRecord) -> None:
        spec = self.assembly.sequence
        about = {"record": record, "run_dir": str(writer.run_dir)}
        first, changes = self.course.first, self.options.changes()
        sequencer = self._sequencer = Sequencer(
            lab,
            first.steps,
            self.stop_flag,
            writer,
            self._observers,
            seed=record.seed,
            attempts=spec.attempts,
            parameters={**changes, **first.parameters},
        )
        mark_active(roots, self._profile_key, writer.run_dir)
        self._observers.event("run_starting", about)
        sequencer.open()
        writer.set_devices(describe(lab, sequencer.guard))
        self._observers.event("run_started", about)
        self.course.run(sequencer, lab, changes)

    def _shut_down(self) -> Mapping[str, LabseqError]:
        return self._sequencer.shut_down() if self._sequencer is not None else {}

    def _finish(self, writer: RunWriter, record: RunRecord, error: BaseException | None) -> None:
        status: RunStatus = "complete"
        if error is not None:
            status = "stopped" if isinstance(error, StopRequested | KeyboardInterrupt) else "failed"
        text = "" if error is None else f"{type(error).__name__}: {error}"
        if isinstance(error, StopRequested):
            text = str(error)
        self._try(writer.finish, status, text)
        self._observers.event("run_finished", {"record": record, "status": status, "error": text})

    def _try(self, act: Callable[P, None], *args: P.args, **kwargs: P.kwargs) -> None:
        """Do what a full disk may prevent; that must not hide how the run ended."""
        try:
            act(*args, **kwargs)
        except LabseqError as failure:
            self._observers.event("warning", {"text": str(failure)})

    def _secure_after_crash(self, roots: Sequence[Path]) -> None:
        """If the last run on this profile died, its devices may still be on.

        They are made safe before anything else is constructed or compiled, which may fail.
        """
        dead = died(roots, self._profile_key)
        if dead is None:
            return
        text = f"the last run on this profile ({dead}) died; its devices are made safe first"
        self._observers.event("warning", {"text": text})
        failures = secure_bench(self.assembly.bench, self.stop_flag, self._observers).failures
        if failures:
            raise failures[0]
        self._try(clear_active, roots, self._profile_key)
        self.stop_flag.check()

    def _record(self, lab: Lab) -> RunRecord:
        assembly, spec = self.assembly, self.assembly.sequence
        assert self.seed is not None
        chosen = [*assembly.bench.chosen.values(), assembly.planner]
        origins = {item.entry.origin for item in chosen}
        plugins = tuple(
            {"name": info.name, "origin": info.origin, "version": info.version}
            for info in assembly.bench.host.infos
            if info.name in origins
        )
        return RunRecord(
            name=spec.name,
            n_shots=spec.shots,
            seed=self.seed,
            simulated=assembly.virtual_time,
            t_start_utc=datetime.now(UTC).isoformat(timespec="microseconds"),
            target=assembly.target,
            sequence_text=assembly.document.text,
            profile_text=assembly.bench.document.text,
            sequence_path=str(assembly.document.path),
            profile_path=str(assembly.bench.document.path),
            resolved=assembly.resolved,
            overrides=self.options.changes(),
            devices={},
            plugins=plugins,
            provenance=gather_provenance(assembly.document.path.resolve().parent),
            record_frames=spec.record_frames,
            grid_spacing_m=lab.grid.spacing_m,
            lattice=lab.grid.lattice,
            scan=self.course.record(),
            calibrations={kind: entry.id for kind, entry in lab.calibrations.items()},
        )
