"""Listening to the outputs of the mobile tweezers' driver."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from labseq.plugin import RfSource, RfSpan
from labseq_virtual.envelope import active_spans

ROUNDING_S: Final = 1e-8
"""How near to a cut a sound must begin to be the same sound."""


@dataclass(frozen=True, slots=True, eq=False)
class RfPulse:
    """A time in which light is on, from silence to silence.

    Attributes:
        start_s: When the first output begins to sound.
        end_s: When the last one has ended.
        rows: What the row output played, in time's order.
        columns: What the column output played.
        continued: Whether the light was on when the episode before was cut off.
    """

    start_s: float
    end_s: float
    rows: tuple[RfSpan, ...]
    columns: tuple[RfSpan, ...]
    continued: bool


class PulseReceiver:
    """Hears what a driver's outputs play, and parts it at the silences.

    Args:
        source: The outputs.
        silence_s: Shortest silence that ends an episode.
    """

    def __init__(self, source: RfSource, silence_s: float) -> None:
        self._source = source
        self._silence_s = silence_s
        self._cut_s = -math.inf

    def receive_until(self, until_s: float) -> Iterator[RfPulse]:
        """What was played until a time, in episodes; the last one is cut off there if it must be.

        Args:
            until_s: The time; what the source plays later is left for the next call.
        """
        heard = self._source.played(until_s)
        cut_s, self._cut_s = self._cut_s, until_s
        times = [times for spans in heard for span in spans for times in active_spans(span)]
        for start_s, end_s in _joined(times, self._silence_s):
            rows, columns = (_between(spans, start_s, end_s) for spans in heard)
            yield RfPulse(start_s, end_s, rows, columns, start_s < cut_s + ROUNDING_S)


def _between(spans: Sequence[RfSpan], start_s: float, end_s: float) -> tuple[RfSpan, ...]:
    return tuple(span for span in spans if span.end_s > start_s and span.start_s < end_s)


def _joined(times: list[tuple[float, float]], silence_s: float) -> list[tuple[float, float]]:
    """Times in order, with the silences that are too short left out."""
    joined: list[tuple[float, float]] = []
    for start_s, end_s in sorted(times):
        if joined and start_s - joined[-1][1] < silence_s:
            joined[-1] = joined[-1][0], max(joined[-1][1], end_s)
        else:
            joined.append((start_s, end_s))
    return joined
