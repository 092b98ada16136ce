"""``labseq bench waveform``: how fast tones become samples."""

from __future__ import annotations

from labseq.cli.files import json_writer
from labseq.cli.output import columns, say, report_compiling
from labseq.session.bench_waveform import WaveformReport, bench_waveform
from labseq.units import format_quantity


def bench_rendering(repeats: int, json: str | None = None) -> None:
    """Measure and tell.

    Args:
        repeats: How often everything is rendered.
        json: Name of the file for everything as JSON; "-" for stdout, which then holds nothing else.

    Raises:
        ConfigError: The file cannot be written.
    """
    write = json_writer(json)
    report = bench_waveform(repeats, announce=report_compiling)
    say(*table(report), "", *ratios(report), "", _extent(report))
    write(report.as_dict())


def table(report: WaveformReport) -> list[str]:
    """A line per measurement."""
    rows = [("two channels", "Gsample/s", "playing/rendering", "goal")]
    for row in report.rows:
        goal = "-" if row.goal is None else f">= {row.goal:g}"
        rows.append((row.name, f"{row.gigasamples_per_s:.3g}", f"{row.playing_over_rendering:.3g}", goal))
    return columns(rows, right=(1, 2, 3))


def ratios(report: WaveformReport) -> list[str]:
    """A line per ratio of rendering times."""
    rows = [("rendering times", "ratio", "goal")]
    for ratio in report.ratios:
        sign = "<=" if ratio.at_most else ">="
        rows.append((ratio.name, f"{ratio.value:.3g}", f"{sign} {ratio.goal:g}"))
    return columns(rows, right=(1, 2))


def _extent(report: WaveformReport) -> str:
    rate = format_quantity(report.sample_rate_hz, "frequency")
    return f"{rate}, two threads; the best of {report.repeats}"
