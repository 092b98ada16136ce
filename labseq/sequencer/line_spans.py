"""When each line is on in a whole shot, for the picture of `labseq check`. A run does not need it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from labseq.model import LineSpec, TimelineEntry
from labseq.model.lines import IDLE
from labseq.sequencer.lines import TIMES_APART_S, idle_program, line_program, own_duration_s


def spans_on(
    specs: Sequence[LineSpec], bars: Iterable[TimelineEntry]
) -> dict[str, list[tuple[float, float]]]:
    """When each line is on in the longest possible shot, for a picture of it.

    Args:
        specs: The lines.
        bars: The shot's timeline.

    Returns:
        Name -> (start, end) of each time that it is on, in seconds from the start of the shot. Lines that
        only pulses turn on are left out if there is no such pulse.
    """
    found: dict[str, list[tuple[float, float]]] = {spec.name: [] for spec in specs}
    start_s = 0.0
    for bar in bars:
        program = (
            line_program(specs, bar.kind, own_duration_s(specs, bar), bar.pulses)
            if bar.kind
            else idle_program(specs)
        )
        for spec in specs:
            spans = [(start_s + a, start_s + b) for a, b in program.spans(spec.name)]
            if IDLE in spec.on and bar.duration_s > program.duration_s:
                spans.append((start_s + program.duration_s, start_s + bar.duration_s))
            _join(found[spec.name], spans)
        start_s += bar.duration_s
    return {spec.name: found[spec.name] for spec in specs if spec.on or found[spec.name]}


def _join(spans: list[tuple[float, float]], more: Iterable[tuple[float, float]]) -> None:
    """Add spans in order of time. Spans that touch become one."""
    for start_s, end_s in more:
        if spans and start_s - spans[-1][1] < TIMES_APART_S:
            spans[-1] = (spans[-1][0], end_s)
        else:
            spans.append((start_s, end_s))
