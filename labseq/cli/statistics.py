"""What came of a run's shots, in tables and lines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from labseq.cli.output import columns
from labseq.cli.words import count_of, plural
from labseq.model.estimate import Estimate
from labseq.recording.rates import Rate
from labseq.recording.statistics import CycleStatistics, Statistics

MAX_DEFECTS: Final = 6
"""From this number of defects on shots are counted together."""
NOT_JUDGED: Final = "not judged: no image step after the last rearrangement"


def cycle_table(statistics: Statistics) -> list[str]:
    """A row per cycle, judged on the image that ended it; nothing without cycles."""
    if not statistics.cycles:
        return []
    header = ("cycle", "shots", "defect-free", "filling", "atom moves", "batches", "left out")
    lines = columns([header, *map(_cycle_row, statistics.cycles)], right=range(len(header)))
    if statistics.cycles[-1].n_shots < statistics.cycles[0].n_shots:
        lines.append("each cycle on its own image, without the shots that had ended before it")
    else:
        lines.append("each cycle on its own image")
    return lines


def _cycle_row(cycle: CycleStatistics) -> tuple[str, ...]:
    return (
        str(cycle.cycle),
        str(cycle.n_shots),
        rate_text(cycle.defect_free),
        share_text(cycle.filling),
        str(cycle.n_atom_moves),
        str(cycle.n_batches),
        str(cycle.n_left_out),
    )


def rate_text(rate: Rate) -> str:
    """A rate in per cent, with its interval.

    Example:
        >>> rate_text(Rate(7, 20)), rate_text(Rate(0, 0))
        ('35.0 % (25.3 to 46.2)', '-')
    """
    if not rate.n_trials:
        return "-"
    low, high = rate.interval
    return f"{100 * rate.value:.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def counted_text(rate: Rate) -> str:
    """A rate with what it was counted of, and its interval.

    Example:
        >>> counted_text(Rate(7, 20)), counted_text(Rate(0, 0))
        ('7 of 20 (35.0 %), 25.3 to 46.2 %', '0 of 0')
    """
    if not rate.n_trials:
        return count_of(0, 0)
    low, high = rate.interval
    return f"{count_of(rate.n, rate.n_trials)}, {100 * low:.1f} to {100 * high:.1f} %"


def share_text(fraction: Estimate) -> str:
    """A mean fraction in per cent.

    Example:
        >>> share_text(Estimate(0.97664, 0.0004))
        '97.66(4) %'
    """
    text = str(fraction.scaled(100.0))
    return text if text == "-" else f"{text} %"


def statistics_rows(statistics: Statistics) -> list[tuple[str, str]]:
    """What came of the shots: name and value of each line."""
    one = statistics
    judged = bool(one.defect_free.n_trials)
    rows = [
        ("defect-free", counted_text(one.defect_free) if judged or not one.n_shots else NOT_JUDGED),
        ("seen defect-free", count_of(one.seen.n, one.seen.n_trials)),
        ("filling", share_text(one.filling)),
    ]
    if one.defects:
        rows.append(("defects", histogram_text(one.defects)))
    elif one.cycles and not judged:
        rows.append(("defects", f"{histogram_text(one.cycles[-1].defects)}, after cycle {len(one.cycles)}"))
    if one.too_short.n:
        rows.append(("window", f"too short in {count_of(one.too_short.n, one.too_short.n_trials)}"))
    if one.losses:
        causes = [f"{cause.replace('_', ' ')} {loss}" for cause, loss in one.losses.items() if loss.value]
        rows.append(("lost in a shot", ", ".join(causes) or "no atoms"))
    if not math.isnan(one.defects_true.value):
        rows.append(("true defects", f"{one.defects_true} in a shot, {one.defects_seen} on its last image"))
    if one.unreadable:
        which = ", ".join(str(index + 1) for index in one.unreadable[:5])
        more = ", ..." if len(one.unreadable) > 5 else ""
        damaged = f"{plural(len(one.unreadable), 'shot')} cannot be read and {_are(one.unreadable)} left out"
        rows.append(("warning", f"{damaged} of cycles and defects: {which}{more}"))
    return rows


def histogram_text(counts: Sequence[int]) -> str:
    """How many shots have how many defects; the highest numbers together if there are many.

    Example:
        >>> histogram_text((7, 5, 0, 2))
        'none in 7, 1 in 5, 3 in 2 shots'
        >>> histogram_text((1,) * 12)
        'none in 1, 1 in 1, 2 in 1, 3 in 1, 4 in 1, 5 in 1, 6 or more in 6 shots'
    """
    apart = len(counts) if len(counts) <= MAX_DEFECTS + 1 else MAX_DEFECTS
    parts = [f"{n or 'none'} in {count}" for n, count in enumerate(counts[:apart]) if count]
    if rest := sum(counts[apart:]):
        parts.append(f"{apart} or more in {rest}")
    return f"{', '.join(parts)} shots"


def _are(items: Sequence[object]) -> str:
    return "is" if len(items) == 1 else "are"
