"""What a card was told, and what it has played in the runs that are over."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from labseq_spcm.simulator.dds_cores import CoreOutputs
from labseq_spcm.simulator.output import SampleSpan
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


class Log:
    """The writes of late, in order.

    Those of one call are kept as they came, and told apart only when somebody looks.

    Args:
        size: How many writes are kept, about.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._n = 0
        self._calls: deque[tuple[float, Sequence[int], Sequence[Number]]] = deque()

    def add(self, time_s: float, registers: Sequence[int], values: Sequence[Number]) -> None:
        """Note the writes of one call."""
        self._calls.append((time_s, registers, values))
        self._n += len(registers)
        while self._n - len(self._calls[0][1]) >= self._size:
            self._n -= len(self._calls.popleft()[1])

    def clear(self) -> None:
        """Forget everything."""
        self._calls.clear()
        self._n = 0

    def __len__(self) -> int:
        return self._n

    def __iter__(self) -> Iterator[LogEntry]:
        for time_s, registers, values in self._calls:
            for register, value in zip(registers, values, strict=True):
                yield LogEntry(time_s, register, value)


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
        chords: What the DDS put out, in time's order.
    """

    def __init__(self) -> None:
        self.samples: list[Record] = []
        self.chords: list[CoreOutputs] = []

    def keep(self, stretches: Iterable[Stretch], channels: Sequence[int], sample_rate_hz: float) -> None:
        """Add what a run has played."""
        self.samples += [Record(stretch, channels, sample_rate_hz) for stretch in stretches]

    def forget(self, before_s: float) -> None:
        """Drop what ended before a time."""
        self.samples = [record for record in self.samples if record.span(record.channels[0]).end_s > before_s]
        self.chords = [chord for chord in self.chords if chord.end_s > before_s]
