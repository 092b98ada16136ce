"""``labseq bench latency``: from the end of the exposure to the light, stage by stage."""

from __future__ import annotations

import sys

from labseq.cli.bench_output import progress_of
from labseq.cli.files import json_writer
from labseq.cli.output import columns, say, report_compiling
from labseq.cli.words import percent, plural
from labseq.session.bench_latency import LatencyRequest, measure_latency
from labseq.session.bench_latency_report import GOAL_S, LatencyReport, Stage
from labseq.units import format_quantity


def bench_latency(request: LatencyRequest, json: str | None = None) -> None:
    """Measure and tell.

    Args:
        request: What is to be measured.
        json: Name of the file for everything as JSON; "-" for stdout, which then holds nothing else.

    Raises:
        ConfigError: Something in the request is wrong, or the file cannot be written.
        PluginLoadError: A plugin that is named failed to load.
        LabseqError: Whatever ended a shot.
    """
    write = json_writer(json)
    with progress_of("loadings") as progress:
        report = measure_latency(request, announce=report_compiling, progress=progress)
    say(*table(report), "", *light_table(report), "", *notes(report))
    say(*(f"warning: {text}" for text in report.warnings), stream=sys.stderr)
    write(report.as_dict())


def table(report: LatencyReport) -> list[str]:
    """From a frame in memory to the first chunk of samples."""
    rows = [("stage", "median", "99 %", "share")]
    for stage in (*report.stages, report.total):
        share = percent(stage.median_s / report.total.median_s, 0)
        rows.append((stage.name, _time(stage.median_s), _time(stage.p99_s), share))
    return columns(rows, right=(1, 2, 3))


def light_table(report: LatencyReport) -> list[str]:
    """From the end of the exposure to the output; what the hardware takes is modelled."""
    parts = (
        Stage("camera read-out", 0.0, 0.0, report.readout_s),
        report.planned,
        report.prepare,
        report.start,
        Stage("trigger", 0.0, 0.0, report.trigger_s),
    )
    rows = [("to the light", "here", "99 %", "modelled")]
    rows += [(s.name, _or_none(s.median_s), _or_none(s.p99_s), _or_none(s.modelled_s)) for s in parts]
    here_s = sum(stage.median_s for stage in parts)
    rows.append(("end of exposure to light", _time(here_s), "-", _time(report.to_light_s - here_s)))
    return columns(rows, right=(1, 2, 3))


def notes(report: LatencyReport) -> list[str]:
    """What was measured, where, and what the tables cannot say."""
    device = f"{report.device}, mode {report.mode}" if report.mode else report.device
    load = "" if report.load is None else f", load {report.load:.2g}"
    playing, rate = format_quantity(report.playing_s, "time"), report.sample_rate_hz
    planner = f"{report.planner}, degree of parallelism {report.degree_of_parallelism}"
    return [
        f"frame to first chunk: {_time(report.total.median_s)}; the goal is {_time(GOAL_S)}",
        f"{plural(report.n_loadings, 'loading')}, seed {report.seed}; {plural(report.n_cores, 'core')}{load}",
        f"{planner}: {report.n_batches:g} batches, played in {playing}",
        f"profile {report.profile}: {device}; first chunk at {format_quantity(rate, 'frequency')}",
        "prepare: the driver's own rendering included, and the work of a simulated device",
    ]


def _time(duration_s: float) -> str:
    return format_quantity(duration_s, "time")


def _or_none(duration_s: float) -> str:
    return _time(duration_s) if duration_s else "-"
