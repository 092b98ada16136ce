"""Digital lines, which switch light and send triggers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.model.grid import read_only

IDLE: Final = "idle"
"""The kind of the time between steps, and before and after a shot."""


@dataclass(frozen=True, slots=True)
class LineSpec:
    """A line, and when it is on.

    Attributes:
        name: Its name, "cooling".
        channel: Its output on the timing box.
        on: Kinds of step during which it is on; :data:`IDLE` among them for the time between.
        lead_s: How long before such a step it is turned on, in seconds.
        lag_s: How long after it it is turned off, in seconds.
        pulse_s: Length of a pulse at the beginning of such a step, in seconds, in the place of a line
            that is on throughout; 0 for none.
        triggers: The role whose trigger input it is wired to, "camera", "mobile_tweezers"; "" for none.
        blinding: Whether its light would harm a camera with EM gain.
        active_low: Whether the output is low while the line is on.
        turns_off: The role whose light is off while the line is on, "static_tweezers"; "" for none.
    """

    name: str
    channel: int
    on: frozenset[str]
    lead_s: float = 0.0
    lag_s: float = 0.0
    pulse_s: float = 0.0
    triggers: str = ""
    blinding: bool = False
    active_low: bool = False
    turns_off: str = ""


def lines_of(specs: Iterable[LineSpec], kind: str) -> list[LineSpec]:
    """The lines that a kind of step turns on; none for idle, which has no leads and lags."""
    return [spec for spec in specs if kind in spec.on and kind != IDLE]


def margin_s(specs: Iterable[LineSpec], kind: str) -> float:
    """Time by which the leads and lags of its lines prolong a step, in seconds."""
    taking_part = lines_of(specs, kind)
    lead_s = max((spec.lead_s for spec in taking_part), default=0.0)
    return lead_s + max((spec.lag_s for spec in taking_part if not spec.pulse_s), default=0.0)


@dataclass(frozen=True, slots=True)
class LinesFacts:
    """Facts about a timing box that are known before it is opened.

    Attributes:
        channels: Numbers of its outputs.
        resolution_s: Step of its clock: edges fall on multiples of it.
        shortest_s: Least time between two edges.
        max_edges: Most edges of a program.
        latency_s: From the call of ``fire`` to the first edge.
    """

    channels: tuple[int, ...]
    resolution_s: float = 0.0
    shortest_s: float = 0.0
    max_edges: int = 2**31
    latency_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class LineProgram:
    """The states of all lines during one step.

    Attributes:
        kind: Kind of the step, "image".
        lines: Their names, n_lines of them.
        t_s: float64 (n_edges,), times of the edges from the firing on, in seconds, rising from 0.
        on: bool (n_edges, n_lines), the state from each edge on; the last one stays.
        begin_s: When the step itself begins, after all leads.
        duration_s: When all is over, lags included; the last edge is not later.
    """

    kind: str
    lines: tuple[str, ...]
    t_s: NDArray[np.float64]
    on: NDArray[np.bool_]
    begin_s: float
    duration_s: float

    def __post_init__(self) -> None:
        t_s = read_only(np.asarray(self.t_s, np.float64), np.float64, (-1,), "t_s")
        on = read_only(np.asarray(self.on, np.bool_), np.bool_, (len(t_s), len(self.lines)), "on")
        if len(t_s) == 0 or t_s[0] != 0.0 or not (np.diff(t_s) > 0).all():
            raise ValueError("the edges of a line program begin at 0 and rise")
        object.__setattr__(self, "t_s", t_s)
        object.__setattr__(self, "on", on)

    def spans(self, line: str) -> list[tuple[float, float]]:
        """Intervals in which a line is on, as (start, end) in seconds from the start of the program.

        The last state is counted until the end of the program.
        """
        column = self.on[:, self.lines.index(line)]
        ends = [*self.t_s[1:].tolist(), max(self.duration_s, float(self.t_s[-1]))]
        spans: list[tuple[float, float]] = []
        for start, end, is_on in zip(self.t_s.tolist(), ends, column.tolist(), strict=True):
            if is_on and spans and spans[-1][1] == start:
                spans[-1] = (spans[-1][0], end)
            elif is_on and end > start:
                spans.append((start, end))
        return spans

    def rising(self, line: str) -> list[float]:
        """Times at which a line switches on, in seconds from the start of the program; 0 if it starts on."""
        return [start for start, _ in self.spans(line)]
