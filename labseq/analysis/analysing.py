"""`labseq analyse`: runs analyses on the shots of a run."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from labseq.analysis.scanned import ScanRequest, scan_report
from labseq.config.addresses import split_overrides
from labseq.config.document import Document
from labseq.console.output import say
from labseq.console.runs import chosen_run
from labseq.console.text import first_of, plural
from labseq.data.reader import Run
from labseq.errors import ConfigError, Problem
from labseq.messages import clean, visible
from labseq.session.analyses import AnalysisOutcome, analyse_missing, analyses_of
from labseq.session.analysis_processes import USE


def analyse_run(
    path: Path | None,
    use: str | None,
    overrides: Sequence[str],
    request: ScanRequest | None = None,
    where: Sequence[str] | None = None,
    *,
    again: bool,
) -> int:
    """Analyse the shots of a run that have no result yet, print how many, and then print the scan.

    Args:
        path: The run's folder. None for the newest run.
        use: Name of one analysis, or None for all that the sequence lists.
        overrides: "key=value" for the settings of this analysis.
        request: What to print of the scan. None to print no scan.
        where: Conditions on the shots that are printed.
        again: Whether to analyse all shots again.

    Returns:
        The exit code: 1 if the analysis of a shot failed.
    """
    run = chosen_run(path)
    analyses, failed = _analyses_to_run(run, use, overrides, may_be_none=request is not None), False
    for settings in analyses:
        outcome = analyse_missing(run, settings, again=again)
        _report(outcome)
        failed = failed or bool(outcome.failures)
    if request is not None:
        say(*([""] if analyses else []), *scan_report(run.select(*where or ()), request).as_text())
    return int(failed)


def _analyses_to_run(
    run: Run, use: str | None, overrides: Sequence[str], *, may_be_none: bool
) -> list[dict[str, Any]]:
    """The settings of each analysis to run."""
    analyses = analyses_of(run)
    if use is not None:
        settings = next((analysis for analysis in analyses if analysis[USE] == use), {USE: use})
        return [{**settings, **_changes(overrides)}]
    if overrides:
        problem, hint = "the analysis with this setting is not given", "name it with --use"
        raise ConfigError(Problem(problem, clean(f"--set {overrides[0]}"), hint=hint))
    if not analyses and not may_be_none:
        problem, hint = "the run's sequence has no analysis", "name one with --use"
        raise ConfigError(Problem(problem, visible(str(run.path)), hint=hint))
    return analyses


def _changes(overrides: Sequence[str]) -> dict[str, Any]:
    """The values of ``--set`` as settings."""
    for_sequence, for_profile = split_overrides(overrides)
    if for_profile:
        problem = "an analysis has no settings in the profile"
        raise ConfigError(Problem(problem, for_profile[0].source, expected="key=value"))
    return Document.of_options(for_sequence, "the command line").data


def _report(outcome: AnalysisOutcome) -> None:
    before = f", {outcome.n_before} already had a result" if outcome.n_before else ""
    say(f"{outcome.name}: {plural(outcome.n_done, 'shot')} analysed{before}; see {outcome.path}")
    failures = [f"{outcome.name}: shot {shot} failed: {text}" for shot, text in outcome.failures.items()]
    say(*first_of(failures, "more shots failed"), stream=sys.stderr)
