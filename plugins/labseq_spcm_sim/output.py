"""The output of the card, with spans of samples and the amplifier."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from labseq_spcm_sim.setup import CardModel

FULL_SCALE = 32767
"""Sample value of the full amplitude."""
ROUNDING = 0.01
"""Fraction of a sample that is a rounding error of time."""


@dataclass(frozen=True, slots=True)
class SampleSpan:
    """Samples that one channel played without a break.

    Attributes:
        start_s: When the first sample was at the output, on the session's clock.
        sample_rate_hz: Sample rate.
        samples: int16 (n,), one period of the played samples, which repeats.
        first: Index in ``samples`` of the first sample played.
        n_samples: How many samples were played.
        amplitude_v: Voltage into 50 Ohm of a sample of 32767.
    """

    start_s: float
    sample_rate_hz: float
    samples: NDArray[np.int16]
    first: int
    n_samples: int
    amplitude_v: float

    @property
    def end_s(self) -> float:
        """When the last sample ended."""
        return self.start_s + self.n_samples / self.sample_rate_hz

    def values(self) -> NDArray[np.int16]:
        """The samples as played, int16 (n_samples,)."""
        if self.first + self.n_samples <= len(self.samples):
            return self.samples[self.first : self.first + self.n_samples]
        return self.samples[np.arange(self.first, self.first + self.n_samples) % len(self.samples)]

    def between(self, start_s: float, end_s: float) -> SampleSpan:
        """The samples of the span that were at the output within a time."""
        first, last = (self._at(time_s) for time_s in (start_s, end_s))
        return replace(
            self,
            start_s=self.start_s + first / self.sample_rate_hz,
            first=(self.first + first) % max(1, len(self.samples)),
            n_samples=last - first,
        )

    def _at(self, time_s: float) -> int:
        """Index of the first sample of the span that starts at or after a time."""
        samples = (time_s - self.start_s) * self.sample_rate_hz
        return math.ceil(min(max(samples - ROUNDING, 0), self.n_samples))


@dataclass(slots=True)
class Amplifier:
    """The output stage of one channel, with its relay, its amplitude, and the relay between its two paths.

    The settings act at once, also while the card plays. When an amplitude needs the other
    path, the output is off for some time.

    Attributes:
        model: The card.
        changes: (time, volts) of each change of the output's amplitude, where 0 is off.
    """

    model: CardModel
    amplitude_mv: int = 1000
    enabled: bool = False
    changes: list[tuple[float, float]] = field(default_factory=lambda: [(-math.inf, 0.0)])
    _high: bool = True
    _ready_s: float = -math.inf

    def set_amplitude(self, amplitude_mv: int, now_s: float) -> None:
        """Change the amplitude, with the relay if necessary."""
        low, high = self.model.low_path_mv
        needs_high = amplitude_mv > high if not self._high else amplitude_mv >= low
        if needs_high != self._high:
            self._high = needs_high
            self._ready_s = now_s + self.model.relay_s
        self.amplitude_mv = amplitude_mv
        self._record(now_s)

    def enable(self, on: bool, now_s: float) -> None:
        """Close or open the output relay, which takes some time to settle after it closes."""
        if on and not self.enabled:
            self._ready_s = max(self._ready_s, now_s + self.model.output_relay_s)
        self.enabled = on
        self._record(now_s)

    def _record(self, now_s: float) -> None:
        volts = self.amplitude_mv / 1000 if self.enabled else 0.0
        self.changes = [change for change in self.changes if change[0] < now_s]
        if now_s < self._ready_s:
            self.changes += [(now_s, 0.0), (self._ready_s, volts)]
        else:
            self.changes.append((now_s, volts))

    def cut(self, span: SampleSpan) -> list[SampleSpan]:
        """The parts of a span that reached the connector, with their voltages."""
        ends = [*(start_s for start_s, _ in self.changes[1:]), math.inf]
        parts: list[SampleSpan] = []
        for (start_s, volts), end_s in zip(self.changes, ends, strict=True):
            if volts and start_s < span.end_s and end_s > span.start_s:
                parts.append(replace(span.between(start_s, end_s), amplitude_v=volts))
        return parts

    def forget(self, before_s: float) -> None:
        """Drop the changes that no longer matter after a time."""
        last = max((i for i, (start_s, _) in enumerate(self.changes) if start_s <= before_s), default=0)
        self.changes = self.changes[last:]
