"""``labseq calibrate``: measure, and say what was found."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from shlex import quote
from typing import Any, Final

from labseq.cli.calibration import difference_table, quantity
from labseq.cli.output import columns, stdout_to_stderr, say
from labseq.cli.show import as_line
from labseq.cli.telling import LASTING, event_text
from labseq.config.wording import clean, did_you_mean, listing
from labseq.errors import ConfigError, Problem
from labseq.model import RunRecord
from labseq.session.calibrate import METHODS, CalibrationRequest, Outcome, calibrate

N_MARKS: Final = 10
"""How often the progress of a run is told."""


def calibrate_kind(kind: str, request: CalibrationRequest, *, as_json: bool) -> None:
    """Make a calibration, keep it, and put it to use unless it is worse.

    Args:
        kind: What is calibrated.
        request: For what, and of what.
        as_json: Whether to print the outcome as one line of JSON, alone on stdout.

    Raises:
        ConfigError: Something in the request is wrong; or the calibration is worse than the one in
            use, and was kept only.
        LabseqError: Nothing came of it.
    """
    method = METHODS.get(kind)
    if method is None:
        what, hint = f"'{clean(kind)}' cannot be calibrated", did_you_mean(kind, METHODS)
        raise ConfigError(Problem(what, expected=listing(METHODS), hint=hint))
    answer = stdout_to_stderr() if as_json else None
    outcome = calibrate(method, request, _Progress())
    if answer is None:
        say(*summary_lines(outcome))
    else:
        answer(as_line(_values_of(outcome)))
    if outcome.refused:
        entry = outcome.stored.entry
        what = f"{entry.kind} {entry.id} is kept but not in use: {outcome.refused}"
        options = f"--force --profile {quote(request.profile)}"
        options += "" if request.dry_run == "off" else " --dry-run"
        hint = f"look at it, then 'labseq calibration use {entry.id} {options}'"
        raise ConfigError(Problem(what, hint=hint))


def summary_lines(outcome: Outcome) -> list[str]:
    """What was found, how far it is from what was in use, and where it is kept."""
    entry, picture = outcome.stored.entry, outcome.stored.picture
    state = "in use from the next run on" if not outcome.refused else "not in use"
    figures = [(name, quantity(value, name)) for name, value in entry.quality.items()]
    lines = [f"{entry.kind} {entry.id}: {state}", *outcome.summary_lines]
    lines += ["", *columns(figures)] if figures else []
    if outcome.before is not None:
        lines += ["", f"against {outcome.before.id}, which was in use:", *difference_table(outcome.changes)]
    lines += ["", f"kept as {outcome.stored.path}", *([f"look at {picture}"] if picture else [])]
    return [*lines, *(f"warning: {text}" for text in outcome.warnings)]


def _values_of(outcome: Outcome) -> dict[str, Any]:
    entry, picture = outcome.stored.entry, outcome.stored.picture
    return {
        "kind": entry.kind,
        "id": entry.id,
        "in_use": not outcome.refused,
        "refused": outcome.refused or None,
        "quality": {name: None if math.isnan(value) else value for name, value in entry.quality.items()},
        "before": None if outcome.before is None else outcome.before.id,
        "file": str(outcome.stored.path),
        "picture": None if picture is None else str(picture),
        "run_dir": None if outcome.run is None else str(outcome.run.path),
        "warnings": list(outcome.warnings),
    }


class _Progress:
    """Implements ``RunObserver`` with a line for every tenth of the shots; the detector is blind in them."""

    def __init__(self) -> None:
        self._run: RunRecord | None = None
        self._n_done = 0

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Print what lasts, and how far it is."""
        if name == "run_starting":
            self._run = values["record"]
        if name in LASTING and (text := event_text(name, values, self._run)):
            say(text, stream=sys.stderr)
        if name == "shot_finished" and self._run is not None:
            self._n_done += 1
            n, before = (k * N_MARKS // self._run.n_shots for k in (self._n_done, self._n_done - 1))
            if n > before:
                say(f"{self._n_done} of {self._run.n_shots} shots", stream=sys.stderr)
