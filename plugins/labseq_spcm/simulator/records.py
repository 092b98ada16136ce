"""What a card was told, and what it has played in the runs that are over."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from labseq_spcm.simulator.output import SampleSpan, ToneSpan
from labseq_spcm.simulator.replay import Stretch
from labseq_spcm.simulator.rules import Number


@dataclass(frozen=True, slots=True)
class LogEntry:
    """One write to a register, refused or not.

    Attributes:
        time_s: When, on the session's clock.
        register: Its number.
        value: What was written.
    """

    time_s: float
    register: int
    value: Number


@dataclass(frozen=True, slots=True)
class Record:
    """A stretch of samples with what is needed to understand it.

    Attributes:
        stretch: The samples.
        channels: The channels that were active, in the order of the columns.
        sample_rate_hz: The sample rate.
    """

    stretch: Stretch
    channels: Sequence[int]
    sample_rate_hz: float

    def span(self, channel: int) -> SampleSpan:
        """What one channel played of it; the amplitude is left to the amplifier."""
        column = self.stretch.samples[:, self.channels.index(channel)]
        return SampleSpan(self.stretch.start_s, self.sample_rate_hz, column, 0, self.stretch.n_samples, 0.0)


class Records:
    """All that was played and not yet forgotten.

    Attributes:
        samples: Stretches of samples, in time's order.
        tones: DDS tones with their channel, in time's order.
    """

    def __init__(self) -> None:
        self.samples: list[Record] = []
        self.tones: list[tuple[int, ToneSpan]] = []

    def keep(self, stretches: Iterable[Stretch], channels: Sequence[int], sample_rate_hz: float) -> None:
        """Add what a run has played."""
        self.samples += [Record(stretch, channels, sample_rate_hz) for stretch in stretches]

    def forget(self, before_s: float) -> None:
        """Drop what ended before a time."""
        self.samples = [record for record in self.samples if record.span(record.channels[0]).end_s > before_s]
        self.tones = [(channel, span) for channel, span in self.tones if span.end_s > before_s]
