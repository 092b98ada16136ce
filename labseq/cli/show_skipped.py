"""What a run has left out, and why."""

from __future__ import annotations

from typing import Any, Final

from labseq.cli.words import plural
from labseq.config.wording import clean
from labseq.recording import Run

_MAX: Final = 5
"""Reasons, and shots of each, that are told one by one."""


def skipped_rows(run: Run) -> list[tuple[str, str]]:
    """A row for each reason why shots were skipped, with the shots, counted from 1."""
    groups = _by_reason(run)
    rows = [("skipped", f"{_numbers(shots)}: {clean(why)}") for why, shots in groups[:_MAX]]
    return (
        rows
        if len(groups) <= _MAX
        else [*rows, ("", f"and for {plural(len(groups) - _MAX, 'other reason')}")]
    )


def json_skipped(run: Run) -> list[dict[str, Any]]:
    """The same, JSON-ready; shots are counted from 0."""
    return [{"shots": shots, "why": why} for why, shots in _by_reason(run)]


def _by_reason(run: Run) -> list[tuple[str, list[int]]]:
    found: dict[str, list[int]] = {}
    for shot, why in sorted(run.skipped.items()):
        found.setdefault(why, []).append(shot)
    return [*found.items()]


def _numbers(shots: list[int]) -> str:
    told = ", ".join(str(shot + 1) for shot in shots[:_MAX])
    return f"shot {told}" if len(shots) == 1 else f"shots {told}" + (", ..." if len(shots) > _MAX else "")
