"""`labseq bench`: run a benchmark, print its tables, write its files."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from labseq.bench.comparison import BARE_MOTION, BenchRequest, read_request
from labseq.bench.latency import GOAL_S, LatencyReport, LatencyRequest, Stage, measure_latency
from labseq.bench.planners import compare
from labseq.bench.rendering import WaveformReport, bench_waveform
from labseq.bench.report import Report, Row, save_histogram
from labseq.bench.work import loading_seed
from labseq.console.output import (
    STDOUT,
    check_different,
    check_writable,
    json_writer,
    report_compiling,
    say,
    write_text,
)
from labseq.console.text import columns, percent, plural
from labseq.errors import PlanError
from labseq.pictures.plans import check_picture
from labseq.units import format_quantity

_STEPS: Final = 10
"""Number of progress lines without a terminal."""


@contextmanager
def progress_of(what: str) -> Generator[Callable[[int, int], None]]:
    """A progress bar on stderr if that is a terminal, else a line for every tenth; ``what`` is counted."""
    if not sys.stderr.isatty():
        reported = 0

        def report_progress(done: int, wanted: int) -> None:
            nonlocal reported
            if done * _STEPS // wanted > reported:
                reported = done * _STEPS // wanted
                say(f"{done} of {wanted} {what}", stream=sys.stderr)

        yield report_progress
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    parts = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*parts, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, wanted: bar.update(task, completed=done, total=wanted)


_TEXT_COLUMNS: Final = {"planner", "target", "grid"}


def table(report: Report) -> list[str]:
    """A row per planner and condition; a condition has a column only if it varies."""
    if not report.rows:
        return ["no plan was made"]
    rows = [_cells(row, report) for row in report.rows]
    header = list(rows[0])
    right = [i for i, name in enumerate(header) if name not in _TEXT_COLUMNS]
    return columns([header, *([row[name] for name in header] for row in rows)], right)


def notes(report: Report) -> list[str]:
    """Notes below the table: missing atoms, wrong plans."""
    lines = [_extent(report)]
    if any(row.scans for row in report.rows):
        lines.append("scans: what the paper of the planner counts instead of batches, and their duration")
    lines += _shortages(report)
    for row in report.rows:
        lines += _failure(report, row)
    return ["", *lines]


def _cells(row: Row, report: Report) -> dict[str, str]:
    conditions = report.comparison.conditions
    rows, cols = row.condition.shape
    cells: dict[str, str] = {"planner": row.planner_entry.label}
    if len({condition.shape for condition in conditions}) > 1:
        cells["grid"] = f"{rows}x{cols}"
    if len({condition.target for condition in conditions}) > 1:
        cells |= {"target": row.condition.target, "atoms": str(row.n_target_atoms)}
    cells |= {
        "DOP": str(row.degree_of_parallelism),
        "batches": str(row.n_batches),
        "atoms moved": str(row.n_atoms_moved),
        "distance/mm": str(row.distance_m.scaled(1e3)),
        "motion/ms": str(row.motion_s.scaled(1e3)),
    }
    if any(other.scans for other in report.rows):
        cells |= {"scans": str(row.n_scans), "scans/ms": str(row.scan_s.scaled(1e3))}
    return cells | {
        "planning": _time(row.planning_median_s),
        "99 %": _time(row.planning_p99_s),
        "filled": percent(row.filling_fraction.value, 2),
        "met": percent(row.target_met.value, 2),
        "/bound": str(row.ratio_to_bound),
    }


def _time(duration_s: float) -> str:
    return "-" if math.isnan(duration_s) else format_quantity(duration_s, "time")


def _nonzero_time(duration_s: float) -> str:
    return _time(duration_s) if duration_s else "-"


def _extent(report: Report) -> str:
    comparison, n_conditions = report.comparison, len(report.comparison.conditions)
    text = plural(comparison.n_loadings, "loading")
    text += f" for each of {n_conditions} conditions" if n_conditions > 1 else ""
    if report.ended_by is not None:
        text = f"INCOMPLETE: {report.n_done} of {report.n_wanted} loadings"
    if report.rows and n_conditions == 1:
        text += f"; bound {report.rows[0].bound} batches"
    return f"{text}; seed {comparison.seed}; {format_quantity(report.duration_s, 'time')}"


def _shortages(report: Report) -> list[str]:
    short = {row.condition: row for row in report.rows if row.n_short}
    return [
        f"{row.n_short} of {row.n_loadings} loadings hold fewer atoms than {condition.target} has sites"
        for condition, row in short.items()
    ]


def _failure(report: Report, row: Row) -> list[str]:
    failure = row.first_failure
    if failure is None:
        return []
    what = f"{row.n_failed} of {row.n_loadings} plans are wrong; the first, of loading {failure.loading}"
    return [
        f"{row.planner_entry.label}: {what}: {failure.message}",
        f"  see it with: {_again(report, row, failure.loading)}",
    ]


def _again(report: Report, row: Row, loading: int) -> str:
    """The command that plans one loading again."""
    condition, comparison = row.condition, report.comparison
    rows, cols = condition.shape
    seed = loading_seed(comparison.seed, loading)
    if condition.motion != BARE_MOTION:  # which takes a profile
        return f"numpy.random.default_rng({seed}).random(({rows}, {cols})) < {condition.loading:g}"
    words = ["labseq", "plan", f"random:{rows}x{cols}@{condition.loading:g}", "--seed", str(seed)]
    words += ["--target", condition.target, "--planner", row.planner_entry.planner]
    if "degree_of_parallelism" in row.settings and condition.degree_of_parallelism is not None:
        words += ["--dop", str(condition.degree_of_parallelism)]
    for key, value in (*comparison.settings, *row.planner_entry.settings):
        words += ["--set", f"{key}={value}"]
    return shlex.join(words)


def bench_planners(
    request: BenchRequest,
    workers: int | None = None,
    *,
    json: str | None = None,
    csv: Path | None = None,
    png: Path | None = None,
) -> None:
    """Compare planners, print the table and write the files, also if it was stopped.

    Args:
        request: The comparison.
        workers: Number of processes; None for one per core, if there is enough work.
        json: Name of the file for everything as JSON; "-" for stdout, which then holds nothing else.
        csv: The file for the table as CSV.
        png: The file for the picture.

    Raises:
        ConfigError: The request has an error, or a file cannot be written.
        PluginLoadError: A named plugin failed to load.
        PlanError: A planner failed, or a plan breaks a rule, for some loadings.
        StopRequested: It was stopped; the results so far were printed.
    """
    comparison = read_request(request)
    check_different(json, csv, png)
    if png is not None:
        check_picture(png, (1, 1))
    for path in filter(None, (csv, png)):
        check_writable(path)
    write = json_writer(json)
    with progress_of("loadings") as progress:
        report = compare(comparison, workers, announce=report_compiling, progress=progress)
    say(*table(report), *notes(report))
    if report.rows:
        if csv is not None:
            write_text(csv, report.as_csv())
        if png is not None:
            save_histogram(png, report)
    files = [name for name in (csv, png, None if json == STDOUT else json) if name is not None]
    if report.rows and files:
        say(f"written: {', '.join(map(str, files))}")
    write(report.as_dict())
    if report.ended_by is not None:
        raise report.ended_by
    _raise_failures(report)


def _raise_failures(report: Report) -> None:
    failed = [row for row in report.rows if row.n_failed]
    if failed:
        n, of = sum(row.n_failed for row in failed), sum(row.n_loadings for row in failed)
        names = ", ".join(dict.fromkeys(f"'{row.planner_entry.planner}'" for row in failed))
        raise PlanError(f"{n} of {of} plans of {names} are wrong; they are not counted in the table")


def bench_latency(request: LatencyRequest, json: str | None = None) -> None:
    """Measure the latency from a frame to the first light, print it, and write it as JSON."""
    write = json_writer(json)
    with progress_of("loadings") as progress:
        report = measure_latency(request, announce=report_compiling, progress=progress)
    say(*latency_table(report), "", *light_table(report), "", *latency_notes(report))
    say(*(f"warning: {text}" for text in report.warnings), stream=sys.stderr)
    write(report.as_dict())


def latency_table(report: LatencyReport) -> list[str]:
    """From a frame in memory to the first chunk of samples."""
    rows = [("stage", "median", "99 %", "share")]
    for stage in (*report.stages, report.total):
        share = percent(stage.median_s / report.total.median_s, 0)
        rows.append((stage.name, _time(stage.median_s), _time(stage.p99_s), share))
    return columns(rows, right=(1, 2, 3))


def light_table(report: LatencyReport) -> list[str]:
    """From the end of the exposure to the output; the times of the hardware are modelled."""
    parts = (
        Stage("camera read-out", 0.0, 0.0, report.readout_s),
        report.planned,
        report.prepare,
        report.start,
        Stage("trigger", 0.0, 0.0, report.trigger_s),
    )
    rows = [("to the light", "this computer", "99 %", "modelled")]
    rows += [
        (s.name, _nonzero_time(s.median_s), _nonzero_time(s.p99_s), _nonzero_time(s.modelled_s))
        for s in parts
    ]
    here_s = sum(stage.median_s for stage in parts)
    rows.append(("end of exposure to light", _time(here_s), "-", _time(report.to_light_s - here_s)))
    return columns(rows, right=(1, 2, 3))


def latency_notes(report: LatencyReport) -> list[str]:
    """Notes below the tables: the measured stages, and the computer."""
    device = f"{report.device}, mode {report.mode}" if report.mode else report.device
    load = "" if report.load is None else f", load {report.load:.2g}"
    playing, rate = format_quantity(report.playing_s, "time"), report.sample_rate_hz
    planner = f"{report.planner}, degree of parallelism {report.degree_of_parallelism}"
    median, goal = (format_quantity(s, "time") for s in (report.total.median_s, GOAL_S))
    return [
        f"frame to first chunk: {median}; the goal is {goal}",
        f"{plural(report.n_loadings, 'loading')}, seed {report.seed}; {plural(report.n_cores, 'core')}{load}",
        f"{planner}: {report.n_batches:g} batches, played in {playing}",
        f"profile {report.profile}: {device}; first chunk at {format_quantity(rate, 'frequency')}",
        "prepare includes the driver's own rendering and the work of a simulated device",
    ]


def bench_rendering(repeats: int, json: str | None = None) -> None:
    """Measure the speed of rendering, print it, and write it as JSON."""
    write = json_writer(json)
    report = bench_waveform(repeats, announce=report_compiling)
    say(*rendering_table(report), "", *ratios(report), "", _rendering_extent(report))
    write(report.as_dict())


def rendering_table(report: WaveformReport) -> list[str]:
    """A row per measurement."""
    rows = [("two channels", "Gsample/s", "playing/rendering", "goal")]
    for row in report.rows:
        goal = "-" if row.goal is None else f">= {row.goal:g}"
        rows.append((row.name, f"{row.gigasamples_per_s:.3g}", f"{row.playing_over_rendering:.3g}", goal))
    return columns(rows, right=(1, 2, 3))


def ratios(report: WaveformReport) -> list[str]:
    """A row per ratio of rendering times."""
    rows = [("rendering times", "ratio", "goal")]
    for ratio in report.ratios:
        sign = "<=" if ratio.at_most else ">="
        rows.append((ratio.name, f"{ratio.value:.3g}", f"{sign} {ratio.goal:g}"))
    return columns(rows, right=(1, 2))


def _rendering_extent(report: WaveformReport) -> str:
    rate = format_quantity(report.sample_rate_hz, "frequency")
    return f"{rate}, two threads; the best of {report.repeats}"
