"""`labseq show`: prints the data of a run, as a summary or in tables."""

from __future__ import annotations

import math
import shutil
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from labseq.analysis.scanned import ScanReport, ScanRequest, scan_report
from labseq.cli.summary import MAX_ROWS, Summary
from labseq.console.events import outcome, scanned_values
from labseq.console.output import say
from labseq.console.report import Column, print_report, table
from labseq.console.runs import chosen_run
from labseq.console.text import percent, settings_text, time_text
from labseq.data.quantities import WITH_TARGET, measured_by, quantity_of
from labseq.data.reader import Run
from labseq.data.shot import Shot
from labseq.errors import ConfigError, LabseqError, Problem
from labseq.messages import clean, visible
from labseq.model.image_quantities import OF_IMAGES, parse_name

if TYPE_CHECKING:
    from labseq.analysis.timing import RunTiming, StageStatistics


@dataclass(frozen=True, slots=True)
class Tables:
    """The tables to print. Without any, the summary is printed."""

    shots: bool = False
    timing: bool = False
    scan: ScanRequest | None = None
    devices: bool = False

    @property
    def any(self) -> bool:
        """Whether at least one table is chosen."""
        return self.shots or self.timing or self.scan is not None or self.devices


def show_run(
    path: Path | None, *, as_json: bool, tables: Tables | None = None, where: Sequence[str] | None = None
) -> None:
    """Print the summary or tables of a run, by default the newest, or of its shots that meet conditions."""
    wanted = tables or Tables()
    try:
        run = chosen_run(path, where)
        report = RunTables.of(run, wanted) if wanted.any else Summary.of(run)
    except LabseqError as error:
        if as_json:
            print_report(Summary().ended_by(error), as_json=True)
        raise
    if not wanted.any and not as_json:
        say(*shot_table(shot_rows(run, run.shots), most=MAX_ROWS), "")
    print_report(report, as_json=as_json)


@dataclass(frozen=True, slots=True)
class ShotRow:
    """A shot, or an attempt at one that did not complete.

    Attributes:
        scanned: Address -> scanned value, in the units of the sequence.
        outcome: The result in words.
        measured: Measured quantity -> its value, SI, without the quantities that have columns of their own.
    """

    index: int
    attempt: int
    status: str
    error: str
    scanned: Mapping[str, str]
    outcome: str
    measured: Mapping[str, float]
    success: bool | None
    filling_fraction: float
    seen_defect_free_cycle: int
    n_cycles: int
    n_batches: int
    n_atom_moves: int
    n_missing_atoms: int
    duration_s: float
    stage_s: Mapping[str, float]
    parameters: Mapping[str, Any]
    file: str


def shot_rows(run: Run, shots: Sequence[Shot]) -> list[ShotRow]:
    """The rows of some shots of a run."""
    addresses = [str(address) for address in run.scan.get("addresses", ())]
    quantities = [quantity_of(run, name) for name in measured_by(run) if name not in WITH_TARGET]
    computed = {"index", "scanned", "outcome", "measured"}
    names = [field.name for field in fields(ShotRow) if field.name not in computed]
    return [
        ShotRow(
            index=shot.index,
            scanned=dict(zip(addresses, scanned_values(run.scan, shot.index, shot.parameters), strict=True)),
            outcome=_outcome(shot, run),
            measured={quantity.name: quantity.of_shot(shot) for quantity in quantities},
            **{name: getattr(shot.row, name) for name in names},
        )
        for shot in shots
    ]


def _outcome(shot: Shot, run: Run) -> str:
    if shot.status != "complete":
        return f"attempt {shot.attempt} {shot.status}: {clean(shot.row.error)}"
    return outcome(shot.success, shot.seen_defect_free_cycle, shot.filling_fraction, run.target.n_atoms)


def shot_table(shots: Sequence[ShotRow], *, details: bool = False, most: int = 0) -> list[str]:
    """A row per shot. With details also scanned values and batches."""
    first = shots[0] if shots else None
    is_judged = any(not math.isnan(shot.filling_fraction) for shot in shots)
    moves = any(shot.n_cycles for shot in shots)
    columns: list[Column[ShotRow]] = [
        Column("shot", lambda shot: shot.index, right=True),
        *(Column(clean(a), _scanned(a), right=True) for a in (first.scanned if first and details else ())),
        Column("outcome", lambda shot: shot.outcome),
        *(Column(clean(name), _measured(name), right=True) for name in (first.measured if first else ())),
    ]
    if is_judged:
        columns.append(Column("filling", lambda shot: percent(shot.filling_fraction), right=True))
    if moves:
        columns.append(Column("cycles", lambda shot: shot.n_cycles, right=True))
        if details:
            columns.append(Column("batches", lambda shot: shot.n_batches, right=True))
        columns.append(Column("atom moves", lambda shot: shot.n_atom_moves, right=True))
    columns.append(Column("shot time", lambda shot: time_text(shot.duration_s), right=True))
    return table(shots, columns, most)


def _measured(name: str) -> Callable[[ShotRow], str]:
    def text(shot: ShotRow) -> str:
        value, kind = shot.measured[name], parse_name(name).kind
        return percent(value) if kind in OF_IMAGES else "-" if math.isnan(value) else f"{value:.6g}"

    return text


def _scanned(address: str) -> Callable[[ShotRow], str]:
    return lambda shot: shot.scanned[address]


@dataclass(frozen=True, slots=True)
class SkippedScan:
    """A scan whose points were all skipped."""

    n_shots: int

    def as_json(self) -> dict[str, Any]:
        """No points."""
        return {"points": []}

    def as_text(self) -> list[str]:
        """The reason why there is no table."""
        return [f"no point of the scan has a shot, because all {self.n_shots} shots were skipped"]


@dataclass(frozen=True, slots=True)
class RunTables:
    """The requested tables of a run, None for the others.

    Attributes:
        shot_list: The shots, with attempts that did not complete.
        timing: The stages of the shots.
        scan: The points of the scan.
        devices: Name of each device -> its description at the start of the run.
    """

    run_dir: Path
    status: str
    shot_list: Sequence[ShotRow] | None
    timing: RunTiming | None
    scan: ScanReport | SkippedScan | None
    devices: Mapping[str, Mapping[str, Any]] | None

    @classmethod
    def of(cls, run: Run, wanted: Tables) -> RunTables:
        """Read the requested tables.

        Raises:
            ConfigError: A table has no data, or the request for the scan cannot be met.
        """
        attempts = sorted((*run.shots, *run.attempts), key=lambda shot: (shot.index, shot.attempt))
        return cls(
            run_dir=run.path,
            status=run.status,
            shot_list=shot_rows(run, attempts) if wanted.shots else None,
            timing=_read_timing(run) if wanted.timing else None,
            scan=None if wanted.scan is None else _read_scan(run, wanted.scan),
            devices=_devices(run) if wanted.devices else None,
        )

    def as_json(self) -> dict[str, Any]:
        """The requested tables. The points of a scan are keys at the same level."""
        values = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "scan"}
        wanted = {name: value for name, value in values.items() if value is not None}
        return wanted | (self.scan.as_json() if self.scan else {})

    def as_text(self) -> list[str]:
        """The tables, with an empty line between them."""
        tables = [
            None if self.shot_list is None else shot_table(self.shot_list, details=True),
            None if self.timing is None else timing_table(self.timing),
            None if self.scan is None else self.scan.as_text(),
            None if self.devices is None else devices_table(self.devices),
        ]
        return [line for lines in tables if lines is not None for line in ("", *lines)][1:]


def _read_scan(run: Run, request: ScanRequest) -> ScanReport | SkippedScan:
    if run.scan and run.skipped and not run.shots:
        return SkippedScan(run.n_shots)
    return scan_report(run, request)


def _read_timing(run: Run) -> RunTiming:
    """The durations of the stages of a run's shots. For a long run, of a selection of shots.

    Raises:
        ConfigError: The run has no shots that can be read.
    """
    from labseq.analysis.overview import PART_SHOTS, evenly
    from labseq.analysis.timing import timing_of

    timing = timing_of(run, evenly(run.shots, PART_SHOTS))
    if not timing.n_read:
        what = "the run has no readable file of a shot yet"
        raise ConfigError(Problem(what, visible(str(run.path)), expected="at least one"))
    return timing


def timing_table(timing: RunTiming) -> list[str]:
    """A row per stage, with its budget and durations."""
    clock = "modelled" if timing.simulated else "measured"
    columns: list[Column[StageStatistics]] = [
        Column("stage", lambda stage: clean(stage.stage)),
        Column("a shot", lambda stage: f"{stage.n_per_shot:.3g}", right=True),
        Column("budget", lambda stage: time_text(stage.budget_s), right=True),
        Column(f"{clock} p50", lambda stage: time_text(stage.session_s.p50), right=True),
        Column("p99", lambda stage: time_text(stage.session_s.p99), right=True),
        Column("host p50", lambda stage: time_text(stage.host_s.p50), right=True),
        Column("p99", lambda stage: time_text(stage.host_s.p99), right=True),
        Column("share", lambda stage: percent(stage.share), right=True),
        Column("over budget", _over_budget, right=True),
    ]
    if not timing.simulated:  # both clocks are the same
        del columns[5:7]
    p50, p99 = time_text(timing.shot_s.p50), time_text(timing.shot_s.p99)
    shots = f"{timing.n_read} of {timing.n_shots} shots"
    return [*table(timing.stages, columns), "", f"shot: {p50} (p50), {p99} (p99), of {shots}"]


def _over_budget(stage: StageStatistics) -> str:
    return "-" if math.isnan(stage.budget_s) else f"{stage.n_over} of {stage.n}"


def devices_table(devices: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The description of each device at the start of the run."""
    width = max(20, shutil.get_terminal_size().columns - 2)
    lines: list[str] = []
    for name, described in devices.items():
        settings = {key: value for key, value in described.items() if key != "model"}
        lines.append(visible(f"{name}: {described.get('model', 'model unknown')}"))
        lines += [f"  {line}" for line in textwrap.wrap(visible(settings_text(settings)), width)]
    return lines or ["the devices were not opened"]


def _devices(run: Run) -> dict[str, dict[str, Any]]:
    devices: Any = run.record.get("devices") or {}
    return {str(name): dict(about) if isinstance(about, Mapping) else {} for name, about in devices.items()}  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
