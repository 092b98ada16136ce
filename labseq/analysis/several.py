"""`labseq compare` and `labseq trend`: print and draw several runs."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from labseq.analysis.comparison import Comparison, Trend
from labseq.console.output import say
from labseq.console.report import print_report
from labseq.console.runs import chosen_run
from labseq.pictures.figures import check_place


def compare_runs(paths: Sequence[Path], name: str | None, output: Path | None, *, as_json: bool) -> None:
    """Print runs beside one another, and draw their scans one over the other."""
    comparison = Comparison.of([chosen_run(path) for path in paths], name)
    _print_and_draw(comparison, output, as_json=as_json)


def show_trend(
    name: str, data: Path | None, conditions: Mapping[str, Any], output: Path | None, *, as_json: bool
) -> None:
    """Print a number of many runs, and draw it over the time."""
    _print_and_draw(Trend.of(name, data, conditions), output, as_json=as_json)


def _print_and_draw(report: Comparison | Trend, output: Path | None, *, as_json: bool) -> None:
    if output is not None:
        check_place(output)
    print_report(report, as_json=as_json)
    if output is not None:
        report.picture().save(output)
        say(f"written: {output}", stream=sys.stderr)
