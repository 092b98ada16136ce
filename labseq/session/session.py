"""A session: one sequence on one profile, from the files to the data."""

from __future__ import annotations

import secrets
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from labseq import motion
from labseq.config import Override
from labseq.errors import ConfigError, LabseqError, StopRequested
from labseq.kernels.compile import announcing
from labseq.model import RunRecord, TimelineEntry
from labseq.model.records import RunStatus
from labseq.recording import Run, RunWriter, clear_active, data_root, died, mark_active, open_run
from labseq.roles import RunObserver, Warmable
from labseq.sequencer import PacedClock, RealClock, Sequencer, StopFlag, VirtualClock
from labseq.sequencer.lab import Lab, describe
from labseq.session.assembly import Assembly, assemble, build_lab
from labseq.session.choosing import DryRun
from labseq.session.observers import Observers
from labseq.session.provenance import gather_provenance
from labseq.session.safe import secure
from labseq.session.signals import stop_on_signals


@dataclass(frozen=True, slots=True)
class Options:
    """What a user may change when opening a session.

    Attributes:
        profile: Name or path of the profile, instead of the sequence's own.
        shots: Number of shots, instead of the sequence's own.
        seed: Seed, instead of the sequence's own or a fresh one.
        overrides: ``"address=value"`` strings, as given to ``--set``; they win.
        output: Folder for the data, instead of LABSEQ_DATA or ``./data``.
        dry_run: "off", "full" or "fast".
        realtime: Let virtual time take as long as it says.
    """

    profile: str | None = None
    shots: int | None = None
    seed: int | None = None
    overrides: Sequence[str] = ()
    output: Path | None = None
    dry_run: DryRun = "off"
    realtime: bool = False

    def own(self) -> list[Override]:
        """``shots`` and ``seed`` as overrides that know which option they came from."""
        given = {"shots": self.shots, "seed": self.seed}
        return [
            Override(key, str(value), f"--{key} {value}") for key, value in given.items() if value is not None
        ]

    def changes(self) -> dict[str, Any]:
        """Everything that differs from the files, for the record: address -> value."""
        changed: dict[str, Any] = {override.address: override.value for override in self.own()}
        changed |= dict(item.split("=", 1) for item in self.overrides)
        if self.profile is not None:
            changed["profile"] = self.profile
        if self.dry_run != "off":
            changed["dry_run"] = self.dry_run
        return changed


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
        self.run_dir: Path | None = None
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
        folder = Path(output) if output is not None else None
        options = Options(profile, shots, seed, tuple(overrides), folder, dry_run, realtime)
        assembly = assemble(
            Path(sequence), profile=profile, overrides=overrides, given=options.own(), dry_run=dry_run
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
        if self._sequencer is not None:
            self._sequencer.shut_down()

    def timeline(self) -> list[tuple[str, list[TimelineEntry]]]:
        """What a shot will do: name of each step and its bars."""
        context = self.build_lab().step_context
        return [(name, list(step.plan_timeline(context))) for name, step in self.assembly.steps]

    def run(self) -> Run:
        """Take all shots.

        Returns:
            The finished run, read back from disk.

        Raises:
            StopRequested: Ctrl-C or SIGTERM; devices are safe, the data is on disk.
            LabseqError: Whatever ended the run; devices are safe, the data is on disk.
        """
        if self.run_dir is not None:
            raise ConfigError("a session runs once; open another for the next run")
        root = self.options.output or data_root()
        for text in self.assembly.bench.warnings:
            self._observers.event("warning", {"text": text})
        with stop_on_signals(self.stop_flag):
            lab = self.build_lab()
            self.warm(lab)
            return self._run(lab, root)

    def build_lab(self) -> Lab:
        """Construct every role's object on the clock that the run will have; nothing is opened."""
        assert self.seed is not None
        if not self.assembly.virtual_time:
            clock = RealClock(self.stop_flag)
        elif self.options.realtime:
            clock = PacedClock(self.stop_flag)
        else:
            clock = VirtualClock(self.stop_flag)
        return build_lab(self.assembly, clock, self.seed)

    def warm(self, lab: Lab) -> None:
        """Compile before the first shot: a compile in mid-shot would cost the atoms."""
        start_s, compiled = time.monotonic(), list[str]()

        def announce(module: str) -> None:
            compiled.append(module)
            self._observers.event("compiling", {"module": module})

        with announcing(announce):
            motion.warm()
            for part in (lab.planner, lab.detector):
                if isinstance(part, Warmable):
                    part.warm()
                self.stop_flag.check()
        if compiled:
            self._observers.event("compiled", {"duration_s": time.monotonic() - start_s})

    def _run(self, lab: Lab, root: Path) -> Run:
        assembly, spec = self.assembly, self.assembly.sequence
        profile_key = str(assembly.bench.document.path.resolve())
        self._secure_after_crash(lab, root, profile_key)
        record = self._record(lab)
        writer = RunWriter.create(root, record)
        self.run_dir = writer.run_dir
        self._observers.log = writer.event
        sequencer = self._sequencer = Sequencer(
            lab,
            assembly.steps,
            self.stop_flag,
            writer,
            self._observers,
            seed=record.seed,
            attempts=spec.attempts,
            parameters=self.options.changes(),
        )
        status: RunStatus = "failed"
        error: BaseException | None = None
        try:
            mark_active(root, profile_key, writer.run_dir)
            self._observers.event("run_starting", {"record": record, "run_dir": str(writer.run_dir)})
            sequencer.open()
            writer.set_devices(describe(lab, sequencer.guard))
            self._observers.event("run_started", {"record": record, "run_dir": str(writer.run_dir)})
            sequencer.run(range(spec.shots))
            status = "complete"
        except BaseException as failure:
            error = failure
            status = "stopped" if isinstance(failure, StopRequested | KeyboardInterrupt) else "failed"
            raise
        finally:
            all_safe = sequencer.shut_down()
            self._finish(writer, record, status, error)
            if all_safe:
                clear_active(root, profile_key)
        return open_run(writer.run_dir)

    def _finish(
        self, writer: RunWriter, record: RunRecord, status: RunStatus, error: BaseException | None
    ) -> None:
        text = "" if error is None else f"{type(error).__name__}: {error}"
        if isinstance(error, StopRequested):
            text = str(error)
        try:
            writer.finish(status, text)
        except LabseqError as failure:  # a full disk must not hide what came before
            self._observers.event("warning", {"text": str(failure)})
        self._observers.event("run_finished", {"record": record, "status": status, "error": text})

    def _secure_after_crash(self, lab: Lab, root: Path, profile_key: str) -> None:
        """If the last run on this profile died, its devices may still be on."""
        dead = died(root, profile_key)
        if dead is None:
            return
        text = f"the last run on this profile ({dead}) died; its devices are made safe first"
        self._observers.event("warning", {"text": text})
        secure(lab.safe_order(), lab.timeouts, lab.simulation, self._observers)
        clear_active(root, profile_key)

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
        )
