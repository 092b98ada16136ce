"""What a simulated card plays, for a simulated world that listens."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from labseq.plugin import RfSamples, RfSpan, RfTones

if TYPE_CHECKING:
    from labseq_spcm.simulator import SimulatedCard, Span

FULL_SCALE: Final = 32767
"""Sample that stands for the amplitude that is set."""


class CardOutputs:
    """The two connectors of a simulated card.

    Implements ``labseq.RfSource``. What was heard is forgotten.

    Args:
        card: The card.
        row_channel: Channel that drives the row axis; the other drives the columns.
    """

    def __init__(self, card: SimulatedCard, row_channel: int) -> None:
        self._card = card
        self._channels = row_channel, 1 - row_channel
        self._heard_s = -math.inf

    def played(self, until_s: float) -> tuple[list[RfSpan], list[RfSpan]]:
        """What the row output and the column output played since the last call, in time's order."""
        rows, columns = (self._since(channel, until_s) for channel in self._channels)
        self._card.forget(until_s)
        self._heard_s = max(self._heard_s, until_s)
        return rows, columns

    def _since(self, channel: int, until_s: float) -> list[RfSpan]:
        spans = (
            span.between(max(span.start_s, self._heard_s), min(span.end_s, until_s))
            for span in self._card.played(channel)
            if span.end_s > self._heard_s and span.start_s < until_s
        )
        return [_heard(span) for span in spans if span.end_s > span.start_s]


def _heard(span: Span) -> RfSpan:
    from labseq_spcm.simulator import SampleSpan

    if isinstance(span, SampleSpan):
        return RfSamples(span.start_s, span.sample_rate_hz, span.values(), span.amplitude_v / FULL_SCALE)
    values = [
        (
            tone.frequency_hz,
            tone.frequency_slope,
            tone.amplitude * span.amplitude_v,
            tone.amplitude_slope * span.amplitude_v,
            tone.phase_rad - math.pi / 2,  # the card's tones are sines
        )
        for tone in span.tones
    ]
    return RfTones(span.start_s, span.end_s, *np.array(values, np.float64).reshape(-1, 5).T)
