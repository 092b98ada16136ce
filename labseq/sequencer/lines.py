"""The program of the digital lines around a step."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Sequence

import numpy as np

from labseq.model import TimelineEntry
from labseq.model.lines import IDLE, NO_PULSES, LineProgram, LineSpec, Pulses, Span, lines_of, margin_s

TIMES_APART_S = 1e-9
"""Edges closer together than this count as one edge, in seconds."""


def line_program(
    specs: Sequence[LineSpec], kind: str, duration_s: float, pulses: Pulses = NO_PULSES
) -> LineProgram:
    """Lay out the edges of all lines around one step.

    The step begins after the longest lead, and the program ends after the longest lag, of the lines that the
    step turns on. Lines that are on between steps but not in this step switch off when it is fired.

    Args:
        specs: The lines.
        kind: Kind of the step.
        duration_s: Duration of the step itself, in seconds.
        pulses: Pulses that the step itself makes, in addition to the lines that its kind turns on.

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
    # a pulse may outlast its step
    over_s = max([over_s, *(begin_s - spec.lead_s + spec.pulse_s for spec in taking_part if spec.pulse_s)])
    spans = [
        [
            *_span(spec, kind, begin_s, end_s),
            *((begin_s + a, begin_s + b) for a, b in pulses.get(spec.name, ())),
        ]
        for spec in specs
    ]
    times = _apart([0.0, *(t for of_line in spans for span in of_line for t in span), over_s])
    states = [[False] * len(specs) for _ in times]  # small arrays take longer than lists, and atoms may wait
    for column, (spec, of_line) in enumerate(zip(specs, spans, strict=True)):
        is_idle = IDLE in spec.on and not spec.pulse_s
        if is_idle and kind in spec.on:  # on before, in and after it
            of_line = [(0.0, over_s)]
        for start, stop in of_line:
            edges = bisect_left(times, start - TIMES_APART_S), bisect_left(times, stop - TIMES_APART_S)
            for state in states[slice(*edges)]:
                state[column] = True
        states[-1][column] = is_idle
    changes = [i for i, state in enumerate(states) if i == 0 or state != states[i - 1]]
    t_s = np.array([times[i] for i in changes])
    on = np.array([states[i] for i in changes], np.bool_).reshape(len(changes), len(specs))
    return LineProgram(kind, tuple(spec.name for spec in specs), t_s, on, begin_s, over_s)


def idle_program(specs: Sequence[LineSpec]) -> LineProgram:
    """The state of the lines between steps."""
    return line_program(specs, IDLE, 0.0)


def off_program(specs: Sequence[LineSpec]) -> LineProgram:
    """A program that switches all lines off at once."""
    names = tuple(spec.name for spec in specs)
    return LineProgram("off", names, np.zeros(1), np.zeros((1, len(specs)), np.bool_), 0.0, 0.0)


def own_duration_s(specs: Sequence[LineSpec], bar: TimelineEntry) -> float:
    """The length of a bar without read-out and the margins of the lines, in seconds."""
    return bar.exposure_s or max(0.0, bar.duration_s - margin_s(specs, bar.kind))


def trigger_line(specs: Iterable[LineSpec], role: str) -> LineSpec | None:
    """The line that triggers a role, or None if none does."""
    return next((spec for spec in specs if spec.triggers == role), None)


def blinding_lines(specs: Iterable[LineSpec], kind: str) -> list[str]:
    """Names of the lines whose light would harm a camera with EM gain in such a step."""
    return [spec.name for spec in specs if spec.blinding and kind in spec.on]


def _span(spec: LineSpec, kind: str, begin_s: float, end_s: float) -> tuple[Span, ...]:
    """When the kind of step turns a line on."""
    if kind not in spec.on or kind == IDLE:
        return ()
    start_s = begin_s - spec.lead_s
    return ((start_s, start_s + spec.pulse_s if spec.pulse_s else end_s + spec.lag_s),)


def _apart(times: Iterable[float]) -> list[float]:
    """Sorted times, without times too close to the previous one. 0 stays 0."""
    kept: list[float] = []
    for t in sorted(times):
        if not kept or t - kept[-1] > TIMES_APART_S:
            kept.append(t)
    return kept
