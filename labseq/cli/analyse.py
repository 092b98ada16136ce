"""``labseq analyse``: what analyses have not come to."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from labseq.cli.output import say
from labseq.cli.replay import MAX_REPORTED
from labseq.cli.show import chosen_run
from labseq.cli.words import plural
from labseq.config import Document, split_overrides
from labseq.config.wording import clean
from labseq.errors import ConfigError, Problem
from labseq.recording import Run
from labseq.session.analysing import USE, AnalysisOutcome, analyses_of, analyse_missing


def analyse_run(path: Path | None, use: str | None, overrides: Sequence[str], *, anew: bool) -> int:
    """Analyse the shots of a run that have no result yet, and say what came of it.

    Args:
        path: The run's folder or any file in it; None for the newest run.
        use: One analysis; None for those of the run's sequence.
        overrides: ``"key=value"`` strings: settings of that one.
        anew: Whether to analyse all shots again.

    Returns:
        The exit code: 1 if there is no result of a shot.

    Raises:
        LabseqError: Something that was asked for is wrong, or the results cannot be written.
    """
    run = chosen_run(path)
    failed = False
    for settings in _wanted(run, use, overrides):
        done = analyse_missing(run, settings, anew=anew)
        _report(done)
        failed = failed or bool(done.failures)
    return int(failed)


def _wanted(run: Run, use: str | None, overrides: Sequence[str]) -> list[dict[str, Any]]:
    """The settings of each analysis that is meant.

    Raises:
        ConfigError: None is meant, or an option is wrong.
    """
    own = analyses_of(run)
    if use is not None:
        settings = next((one for one in own if one[USE] == use), {USE: use})
        return [{**settings, **_changes(overrides)}]
    if overrides:
        what, hint = "it is not said of which analysis this is a setting", "name it with --use"
        raise ConfigError(Problem(what, clean(f"--set {overrides[0]}"), hint=hint))
    if not own:
        what, hint = "the run's sequence asks for no analysis", "name one with --use"
        raise ConfigError(Problem(what, clean(str(run.path)), hint=hint))
    return own


def _changes(overrides: Sequence[str]) -> dict[str, Any]:
    """The values of ``--set``.

    Raises:
        ConfigError: One is not of the form key=value, or its value is no YAML.
    """
    for_sequence, for_profile = split_overrides(overrides)
    if for_profile:
        what = "an analysis has no part of the profile"
        raise ConfigError(Problem(what, for_profile[0].source, expected="key=value"))
    parents = {one.address.rpartition(".")[0] for one in for_sequence}
    return Document.parse("{}", "the command line").override_all(for_sequence, may_add=parents).data


def _report(done: AnalysisOutcome) -> None:
    before = f", {done.n_before} had a result already" if done.n_before else ""
    say(f"{done.name}: {plural(done.n_done, 'shot')} analysed{before}; see {done.path}")
    told = [f"{done.name}: shot {shot + 1} failed: {text}" for shot, text in done.failures.items()]
    more = len(told) - MAX_REPORTED
    say(*told[:MAX_REPORTED], *([f"and {more} more shots failed"] if more > 0 else []), stream=sys.stderr)
