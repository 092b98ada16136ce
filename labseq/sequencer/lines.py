"""The program of the digital lines around a step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from labseq.model import TimelineEntry
from labseq.model.lines import IDLE, LineProgram, LineSpec, lines_of, margin_s

TIMES_APART_S = 1e-9
"""Edges closer together than this count as one edge, in seconds."""


def line_program(specs: Sequence[LineSpec], kind: str, duration_s: float) -> LineProgram:
    """Lay out the edges of all lines around one step.

    The step begins after the longest lead, and the program ends after the longest lag, of the lines that
    the step turns on. Lines that are on between steps but not in this one switch off when it is
    fired.

    Args:
        specs: The lines.
        kind: Kind of the step.
        duration_s: Duration of the step itself, in seconds.

    Example:
        >>> light = LineSpec("imaging", 4, ("image",), lead_s=1e-3, lag_s=2e-3)
        >>> program = line_program([light], "image", 45e-3)
        >>> program.t_s.tolist(), program.on[:, 0].tolist(), program.begin_s
        ([0.0, 0.048], [True, False], 0.001)
    """
    taking_part = lines_of(specs, kind)
    begin_s = max((spec.lead_s for spec in taking_part), default=0.0)
    end_s = begin_s + duration_s
    over_s = end_s + max((spec.lag_s for spec in taking_part if not spec.pulse_s), default=0.0)
    over_s = max([over_s, *(begin_s - spec.lead_s + spec.pulse_s for spec in taking_part if spec.pulse_s)])
    spans = {spec.name: _span(spec, kind, begin_s, end_s) for spec in specs}
    times = _apart([0.0, *(t for span in spans.values() if span is not None for t in span), over_s])
    states = np.array([[_is_on(spec, kind, spans, t, over_s) for spec in specs] for t in times], np.bool_)
    states = states.reshape(len(times), len(specs))
    changes = np.concatenate([[True], (states[1:] != states[:-1]).any(axis=1)])
    names = tuple(spec.name for spec in specs)
    return LineProgram(kind, names, np.array(times)[changes], states[changes], begin_s, over_s)


def idle_program(specs: Sequence[LineSpec]) -> LineProgram:
    """The state of the lines between steps."""
    return line_program(specs, IDLE, 0.0)


def off_program(specs: Sequence[LineSpec]) -> LineProgram:
    """A program that switches all lines off at once."""
    names = tuple(spec.name for spec in specs)
    return LineProgram("off", names, np.zeros(1), np.zeros((1, len(specs)), np.bool_), 0.0, 0.0)


def spans_on(
    specs: Sequence[LineSpec], bars: Iterable[TimelineEntry]
) -> dict[str, list[tuple[float, float]]]:
    """When each line is on in the longest possible shot, for a picture of it.

    Args:
        specs: The lines.
        bars: The shot's timeline.

    Returns:
        Name -> (start, end) of each time that it is on, in seconds from the start of the shot.
    """
    found: dict[str, list[tuple[float, float]]] = {spec.name: [] for spec in specs}
    start_s = 0.0
    for bar in bars:
        program = (
            line_program(specs, bar.kind, own_duration_s(specs, bar)) if bar.kind else idle_program(specs)
        )
        for spec in specs:
            spans = [(start_s + a, start_s + b) for a, b in program.spans(spec.name)]
            if IDLE in spec.on and bar.duration_s > program.duration_s:
                spans.append((start_s + program.duration_s, start_s + bar.duration_s))
            _join(found[spec.name], spans)
        start_s += bar.duration_s
    return found


def own_duration_s(specs: Sequence[LineSpec], bar: TimelineEntry) -> float:
    """The length of a bar without read-out and the margins of the lines, in seconds."""
    return bar.exposure_s or max(0.0, bar.duration_s - margin_s(specs, bar.kind))


def trigger_line(specs: Iterable[LineSpec], role: str) -> LineSpec | None:
    """The line that triggers a role; None if none does."""
    return next((spec for spec in specs if spec.triggers == role), None)


def blinding_lines(specs: Iterable[LineSpec], kind: str) -> list[str]:
    """Names of the lines whose light would harm a camera with EM gain in such a step."""
    return [spec.name for spec in specs if spec.blinding and kind in spec.on]


def _join(spans: list[tuple[float, float]], more: Iterable[tuple[float, float]]) -> None:
    """Add spans in order of time; spans that touch become one."""
    for start_s, end_s in more:
        if spans and start_s - spans[-1][1] < TIMES_APART_S:
            spans[-1] = (spans[-1][0], end_s)
        else:
            spans.append((start_s, end_s))


def _span(spec: LineSpec, kind: str, begin_s: float, end_s: float) -> tuple[float, float] | None:
    if kind not in spec.on or kind == IDLE:
        return None
    start_s = begin_s - spec.lead_s
    return (start_s, start_s + spec.pulse_s) if spec.pulse_s else (start_s, end_s + spec.lag_s)


def _is_on(
    spec: LineSpec, kind: str, spans: Mapping[str, tuple[float, float] | None], t_s: float, over_s: float
) -> bool:
    is_idle = IDLE in spec.on and not spec.pulse_s
    span = spans[spec.name]
    if t_s >= over_s - TIMES_APART_S:
        return is_idle
    if span is None:
        return kind == IDLE and is_idle
    if is_idle:  # on before, in and after it
        return True
    return span[0] - TIMES_APART_S <= t_s < span[1] - TIMES_APART_S


def _apart(times: Sequence[float]) -> list[float]:
    """Sorted times, without any that are too close to the one before; 0 stays 0."""
    found: list[float] = []
    for t in sorted(times):
        if not found or t - found[-1] > TIMES_APART_S:
            found.append(t)
    return found
