"""A shot's timeline as rows of text: its steps, and when each line is on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from labseq.cli.output import columns
from labseq.model import TimelineEntry
from labseq.units import format_quantity

BAR_WIDTH: Final = 30

Timeline = Sequence[tuple[str, Sequence[TimelineEntry]]]


def timeline_table(timeline: Timeline, block: str, width: int = BAR_WIDTH) -> list[str]:
    """A row per bar of the timeline: step, start, length, and the bar itself.

    Args:
        timeline: Name of each step and its bars.
        block: What bars are made of.
        width: Characters of the longest bar; 0 for none.
    """
    total_s = sum(bar.duration_s for _, bars in timeline for bar in bars)
    rows = [("step", "", "start", "at most", "")]
    start_s = 0.0
    for number, (name, bars) in enumerate(timeline):
        for i, bar in enumerate(bars):
            label = bar.label if bar.label != name else ""
            length = format_quantity(bar.duration_s, "time")
            drawn = _bar(start_s, bar.duration_s, total_s, block, width)
            step = f"{number} {name}" if i == 0 else ""
            rows.append((step, label, format_quantity(start_s, "time"), length, drawn))
            start_s += bar.duration_s
    return columns(rows, right=(2, 3))


def _bar(start_s: float, duration_s: float, total_s: float, block: str, width: int) -> str:
    if not total_s or not width:
        return ""
    first, last = (round(width * t / total_s) for t in (start_s, start_s + duration_s))
    first = min(first, width - 1)
    return " " * first + block * max(1, last - first)


def lines_table(
    lines: Mapping[str, Sequence[tuple[float, float]]], total_s: float, block: str, width: int = BAR_WIDTH
) -> list[str]:
    """A row per line: for how long it is on, and a bar for when.

    Args:
        lines: Name -> (start, end) of each time that it is on, in seconds.
        total_s: Duration of the shot, in seconds.
        block: What bars are made of.
        width: Characters of the longest bar; 0 for none.
    """
    if not lines:
        return []
    rows = [("line", "", "times on", "at most", "")]
    for name, spans in lines.items():
        lit_s = sum(end_s - start_s for start_s, end_s in spans)
        drawn = [" "] * width
        for start_s, end_s in spans:
            for place, mark in enumerate(_bar(start_s, end_s - start_s, total_s, block, width)):
                drawn[place] = mark if mark != " " else drawn[place]
        rows.append((name, "", str(len(spans)), format_quantity(lit_s, "time"), "".join(drawn).rstrip()))
    return columns(rows, right=(2, 3))
