"""Line programs as the edges of the box, and which programs the box stores."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from labseq.plugin import LimitError, LineProgram, LineSpec, format_quantity
from labseq_ttl.protocol import EDGES, LONGEST, SHORTEST, SLOTS, TICK_S, Edge

MAX_EDGES: Final = EDGES - 1
"""Edges of a program. One more marks its end."""


def edges_of(program: LineProgram, specs: Sequence[LineSpec], device: str) -> tuple[Edge, ...]:
    """The edges of a program.

    An edge without a change marks its end, so that the box itself reports when it is over.
    """
    what = f"{device}: `{program.kind}`"
    if len(program.t_s) > MAX_EDGES:
        raise LimitError(f"{what}: number of edges", len(program.t_s), f"at most {MAX_EDGES}")
    ticks = np.rint(program.t_s / TICK_S)
    masks = [mask_of(row, specs) for row in program.on.tolist()]
    apart = np.diff(ticks)
    for i in np.flatnonzero((apart < SHORTEST) | (apart > LONGEST)).tolist():
        shortest, longest = (format_quantity(n * TICK_S, "time") for n in (SHORTEST, LONGEST))
        limit = f"at least {shortest}" if apart[i] < SHORTEST else f"at most {longest}"
        between = f"time between the edges {_edge(program, i)} and {_edge(program, i + 1)}"
        came = format_quantity(float(program.t_s[i + 1] - program.t_s[i]), "time")
        raise LimitError(f"{what}: {between}", came, limit, "change a lead, a lag or a pulse")
    end = float(np.rint(program.duration_s / TICK_S)) - float(ticks[-1])
    steps = [0, *apart.astype(int).tolist()]
    if SHORTEST <= end <= LONGEST:
        steps, masks = [*steps, int(end)], [*masks, masks[-1]]
    return tuple(zip(steps, masks, strict=True))


class Slots:
    """The slots of the box, and the programs that they hold."""

    def __init__(self) -> None:
        self._slot_of: dict[tuple[Edge, ...], int] = {}  # the last used slot comes last

    def find(self, edges: tuple[Edge, ...]) -> int | None:
        """The slot of a program, which is used now, None if no slot holds it."""
        slot = self._slot_of.pop(edges, None)
        if slot is not None:
            self._slot_of[edges] = slot
        return slot

    def free(self) -> int:
        """A slot for a new program, if all are full the slot that was not used for the longest time."""
        if len(self._slot_of) < SLOTS:
            return min({*range(SLOTS)} - {*self._slot_of.values()})
        return self._slot_of.pop(next(iter(self._slot_of)))

    def fill(self, slot: int, edges: tuple[Edge, ...]) -> None:
        """A program was written to a slot."""
        self._slot_of[edges] = slot

    def clear(self) -> None:
        """The box has lost them all."""
        self._slot_of.clear()


def mask_of(row: Sequence[bool], specs: Sequence[LineSpec]) -> int:
    """The lines that are on, with bit n for channel n. ``open`` refuses other channels."""
    channels = [spec.channel for spec, is_on in zip(specs, row, strict=True) if is_on]
    return sum(1 << channel for channel in channels if isinstance(channel, int))


def _edge(program: LineProgram, i: int) -> str:
    """Describe an edge by the lines that change, and its time."""
    now = program.on[i]
    before = program.on[i - 1] if i else np.zeros_like(now)
    names = ", ".join(f"'{line}'" for line, new in zip(program.lines, now != before, strict=True) if new)
    return f"of {names or 'no line'} at {format_quantity(float(program.t_s[i]), 'time', 7)}"
