"""`labseq show`: prints the data of a run, as a summary or in tables."""

from __future__ import annotations

import math
import shutil
import textwrap
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from labseq.analysis.scanned import ScanRequest, scan_report
from labseq.cli.summary import MAX_ROWS, json_summary, summary_lines
from labseq.console.errors import lines_of
from labseq.console.events import outcome, scanned_values
from labseq.console.output import as_line, say
from labseq.console.report import aligned
from labseq.console.runs import chosen_run
from labseq.console.text import percent, settings_text
from labseq.data import Run, Shot
from labseq.errors import ConfigError, LabseqError, Problem
from labseq.messages import clean, visible
from labseq.units import format_quantity

if TYPE_CHECKING:
    from labseq.analysis.timing import RunTiming, StageStatistics

SHOT_KEYS: Final = (
    *("attempt", "status", "error", "success", "filling_fraction", "seen_defect_free_cycle", "n_cycles"),
    *("n_batches", "n_atom_moves", "n_missing_atoms", "stage_s", "parameters", "file"),
)
"""Keys of a shot's line in the index that ``--json`` prints."""


@dataclass(frozen=True, slots=True)
class Tables:
    """The tables to print; the summary if none is chosen."""

    shots: bool = False
    timing: bool = False
    scan: ScanRequest | None = None
    devices: bool = False

    @property
    def any(self) -> bool:
        """Whether at least one table is chosen."""
        return self.shots or self.timing or self.scan is not None or self.devices


def show_run(path: Path | None, *, as_json: bool, tables: Tables | None = None) -> None:
    """Print the summary or tables of a run; without a path, of the newest."""
    wanted = tables or Tables()
    try:
        run = chosen_run(path)
        values = (_json_tables(run, wanted) if wanted.any else json_summary(run)) if as_json else {}
    except LabseqError as error:
        if as_json:
            say(as_line(json_summary(None) | {"error": "\n".join(lines_of(error))}))
        raise
    if as_json:
        say(as_line(values))
    elif wanted.any:
        say(*_table_lines(run, wanted))
    else:
        say(*shot_table(run, most=MAX_ROWS), "", *summary_lines(run))


def _table_lines(run: Run, wanted: Tables) -> list[str]:
    """The chosen tables, with an empty line between them."""
    choices = (
        (wanted.shots, lambda: shot_table(run, details=True)),
        (wanted.timing, lambda: timing_table(run)),
        (wanted.scan is not None, lambda: scan_table(run, wanted.scan or ScanRequest())),
        (wanted.devices, lambda: devices_table(run)),
    )
    found = [table() for is_wanted, table in choices if is_wanted]
    return [line for table in found for line in ("", *table)][1:]


def _json_tables(run: Run, wanted: Tables) -> dict[str, Any]:
    values: dict[str, Any] = {"run_dir": str(run.path), "status": run.status}
    if wanted.shots:
        values["shot_list"] = [
            {"index": shot.index, **{name: getattr(shot.row, name) for name in SHOT_KEYS}}
            for shot in _all_attempts(run)
        ]
    if wanted.timing:
        values["timing"] = _json_timing(run)
    if wanted.scan is not None:
        values |= {"points": []} if _all_skipped(run) else scan_report(run, wanted.scan).as_json()
    if wanted.devices:
        values["devices"] = _devices(run)
    return values


def shot_table(run: Run, *, details: bool = False, most: int = 0) -> list[str]:
    """A row per shot; with details also scanned values, batches, and attempts that did not complete."""
    addresses: list[str] = [str(one) for one in run.scan.get("addresses", ())] if details else []
    header = ["shot", *map(clean, addresses), "outcome", "filling", "cycles", "atom moves", "shot time"]
    rows = [_shot_row(shot, run, details=details) for shot in (_all_attempts(run) if details else run.shots)]
    at = 1 + len(addresses)
    if details:
        header.insert(at + 3, "batches")
    return aligned([header, *rows], right=[i for i in range(len(header)) if i != at], most=most)


def _all_attempts(run: Run) -> list[Shot]:
    return sorted((*run.shots, *run.attempts), key=lambda shot: (shot.index, shot.attempt))


def _shot_row(shot: Shot, run: Run, *, details: bool) -> tuple[str, ...]:
    row = shot.row
    result = outcome(shot.success, shot.seen_defect_free_cycle, shot.filling_fraction, run.target.n_atoms)
    if shot.status != "complete":
        result = f"attempt {shot.attempt} {shot.status}: {clean(row.error)}"
    counts = ("n_cycles", "n_batches", "n_atom_moves") if details else ("n_cycles", "n_atom_moves")
    return (
        str(shot.index),
        *(scanned_values(run.scan, shot.index, shot.parameters) if details else ()),
        result,
        percent(shot.filling_fraction),
        *(str(getattr(row, name)) for name in counts),
        _time(row.duration_s),
    )


def scan_table(run: Run, request: ScanRequest) -> list[str]:
    """A row per point of the scan, or a map; and the fits.

    Raises:
        ConfigError: The run has no scan, or no shots yet; or the request cannot be met.
    """
    if _all_skipped(run):
        return [f"no point of the scan has a shot: {len(run.skipped)} of {run.n_shots} were skipped"]
    return scan_report(run, request).as_text()


def _all_skipped(run: Run) -> bool:
    return bool(run.record.get("scan")) and bool(run.skipped) and not run.shots


def timing_table(run: Run) -> list[str]:
    """A row per stage: its budget and its durations."""
    timing = _read_timing(run)
    clocks = ("modelled", "host") if run.simulated else ("measured",)
    heads = [head for clock in clocks for head in (f"{clock} p50", "p99")]
    header = ("stage", "a shot", "budget", *heads, "share", "over budget")
    rows = [_stage_row(stage, n_clocks=len(clocks)) for stage in timing.stages]
    lines = aligned([header, *rows], right=range(1, len(header)))
    p50_s, p99_s = (format_quantity(s, "time") for s in timing.shot_s)
    return [*lines, "", f"shot: {p50_s} (p50), {p99_s} (p99), of {timing.n_read} of {len(run.shots)} shots"]


def _read_timing(run: Run) -> RunTiming:
    """The durations of the stages of a run's shots; for a long run, of a selection of shots.

    Raises:
        ConfigError: It has no shots that can be read.
    """
    from labseq.analysis.overview import PART_SHOTS, evenly
    from labseq.analysis.timing import timing_of

    timing = timing_of(run, evenly(run.shots, PART_SHOTS))
    if not timing.n_read:
        what = "the run has no shots yet whose files can be read"
        raise ConfigError(Problem(what, visible(str(run.path)), expected="at least one"))
    return timing


def _stage_row(stage: StageStatistics, *, n_clocks: int) -> tuple[str, ...]:
    clocks = (stage.session_s, stage.host_s)[:n_clocks]
    return (
        clean(stage.stage),
        f"{stage.n_per_shot:.3g}",
        _time(stage.budget_s),
        *(_time(s) for clock in clocks for s in clock),
        percent(stage.share),
        "-" if math.isnan(stage.budget_s) else f"{stage.n_over} of {stage.n}",
    )


def _time(value_s: float) -> str:
    return "-" if math.isnan(value_s) else format_quantity(value_s, "time")


def _json_timing(run: Run) -> dict[str, Any]:
    def quantiles(pair: tuple[float, float]) -> dict[str, float]:
        return dict(zip(("p50", "p99"), pair, strict=True))

    timing = _read_timing(run)
    stages = [
        asdict(stage) | {"session_s": quantiles(stage.session_s), "host_s": quantiles(stage.host_s)}
        for stage in timing.stages
    ]
    return {"n_read": timing.n_read, "shot_s": quantiles(timing.shot_s), "stages": stages}


def devices_table(run: Run) -> list[str]:
    """The description of each device at the start of the run."""
    width = max(20, shutil.get_terminal_size().columns - 2)
    lines: list[str] = []
    for name, described in _devices(run).items():
        settings = {key: value for key, value in described.items() if key != "model"}
        lines.append(visible(f"{name}: {described.get('model', 'model unknown')}"))
        lines += [f"  {line}" for line in textwrap.wrap(visible(settings_text(settings)), width)]
    return lines or ["the devices were not opened"]


def _devices(run: Run) -> dict[str, dict[str, Any]]:
    found: Any = run.record.get("devices") or {}
    return {str(name): dict(one) if isinstance(one, Mapping) else {} for name, one in found.items()}  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
