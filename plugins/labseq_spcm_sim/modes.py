"""The modes that play samples: STD_SINGLE from the on-board memory, FIFO_SINGLE as a stream."""

from __future__ import annotations

import ctypes
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from labseq_spcm_sim import fifo_kernels as k, registers as r
from labseq_spcm_sim.output import ROUNDING
from labseq_spcm_sim.setup import OUTPUT_FIFO_BYTES, Refusal, refuse

Samples = NDArray[np.int16]

PAGE: Final = 4096


@dataclass(frozen=True, slots=True)
class Buffer:
    """A transfer buffer in the memory of the PC.

    Attributes:
        address: Where it starts.
        n_bytes: Its length.
        notify_bytes: Granularity in which the card reports what it has transferred; 0: all at once.
    """

    address: int
    n_bytes: int
    notify_bytes: int

    def check(self, kind: int, direction: int, offset: int) -> None:
        """Refuse what the driver refuses, and a buffer that is not aligned to a page."""
        if kind != r.SPCM_BUF_DATA:
            raise refuse(kind, f"the buffer type {r.SPCM_BUF_DATA}")
        if direction != r.SPCM_DIR_PCTOCARD:
            raise Refusal(r.ERR_DIRMISMATCH, "a generator card takes data from the PC only")
        if offset:
            raise Refusal(r.ERR_FNCNOTSUPPORTED, "the simulator models only transfers without an offset")
        if self.notify_bytes % PAGE:
            text = f"notify size {self.notify_bytes} is not a multiple of {PAGE} bytes"
            raise Refusal(r.ERR_NOTIFYSIZE, text)
        if self.n_bytes <= 0 or self.n_bytes % 2:
            raise refuse(self.n_bytes, "a whole number of samples")
        if not self.address or self.address % PAGE:
            raise Refusal(r.ERR_INVALIDPARAM, f"the buffer must be aligned to {PAGE} bytes")

    def fetch(self, start: int, n_bytes: int) -> Samples:
        """Some of its samples, int16 (n_bytes / 2,), from byte ``start`` on and around its end."""
        whole = (ctypes.c_char * self.n_bytes).from_address(self.address)
        samples = np.frombuffer(memoryview(whole), np.int16)
        first = start % self.n_bytes // 2
        head = samples[first : first + n_bytes // 2]
        missing = n_bytes // 2 - len(head)
        return np.concatenate([head, samples[:missing]]) if missing else head


class Memory:
    """The on-board memory and the bus to it.

    Args:
        bus_bytes_per_s: Speed of the bus.

    Attributes:
        uploads: Arrival and content of uploads that have not arrived yet, in order.
    """

    def __init__(self, bus_bytes_per_s: float) -> None:
        self._bus_bytes_per_s = bus_bytes_per_s
        self._uploaded: list[Samples] = []  # the latest first; those behind it are longer
        self._idle_s = -math.inf
        self.uploads: deque[tuple[float, Samples]] = deque()

    def send(self, now_s: float, data: Samples) -> None:
        """Put data for the beginning of the memory on the bus."""
        self._idle_s = max(now_s, self._idle_s) + data.nbytes / self._bus_bytes_per_s
        self.uploads.append((self._idle_s, data))

    def store(self, data: Samples) -> None:
        """Data arrive; a replay that has begun keeps the old content."""
        self._uploaded = [data, *(older for older in self._uploaded if len(older) > len(data))]

    def read(self, n_samples: int, n_channels: int) -> Samples:
        """The content, int16 (n_samples, n_channels); zeros where nothing was ever written."""
        n = n_samples * n_channels
        found = np.zeros(0, np.int16)
        for data in self._uploaded:
            if len(found) < n:
                found = np.concatenate([found, data[len(found) : n]]) if len(found) else data[:n]
        missing = n - len(found)
        return (np.pad(found, (0, missing)) if missing else found).reshape(n_samples, n_channels)


@dataclass(frozen=True, slots=True)
class Stretch:
    """Samples of all active channels that were played in a row.

    Attributes:
        start_s: When the first one was at the output.
        samples: int16 (n, n_channels); repeats.
        n_samples: How many were played, per channel.
    """

    start_s: float
    samples: Samples
    n_samples: int


class Run(Protocol):
    """One run of the card in one of its modes, from its start to its stop."""

    @property
    def finished(self) -> bool:
        """Whether it has played everything."""
        ...

    @property
    def failed(self) -> bool:
        """Whether it stopped because data were missing."""
        ...

    def advance(self, now_s: float) -> None:
        """Do everything that is due."""
        ...

    def trigger(self, out_s: float) -> None:
        """A trigger that reaches the output at ``out_s``."""
        ...

    def played(self, now_s: float) -> list[Stretch]:
        """The samples played up to now."""
        ...


def cut(stretches: list[Stretch], sample_rate_hz: float, now_s: float) -> list[Stretch]:
    """Only what has been played by now."""
    parts: list[Stretch] = []
    for stretch in stretches:
        n_samples = min(stretch.n_samples, math.floor((now_s - stretch.start_s) * sample_rate_hz + ROUNDING))
        if n_samples > 0:
            parts.append(replace(stretch, n_samples=n_samples))
    return parts


class Replay:
    """STD_SINGLE: plays the memory, after the first trigger.

    Args:
        content: Returns the memory, int16 (n, n_channels), as it is when the replay begins.
        sample_rate_hz: Sample rate.
        loops: How often the memory is played; 0: until the stop.
    """

    failed = False

    def __init__(self, content: Callable[[], Samples], sample_rate_hz: float, loops: int) -> None:
        self._content = content
        self._rate = sample_rate_hz
        self._loops = loops
        self._end_s = math.inf
        self._stretches: list[Stretch] = []
        self.finished = False

    def advance(self, now_s: float) -> None:
        """End the replay when all loops were played."""
        self.finished = now_s >= self._end_s

    def trigger(self, out_s: float) -> None:
        """Begin; later triggers have no effect."""
        if not self._stretches:
            samples = self._content()
            n_samples = len(samples) * self._loops if self._loops else 2**62
            self._end_s = out_s + n_samples / self._rate
            self._stretches.append(Stretch(out_s, samples, n_samples))

    def played(self, now_s: float) -> list[Stretch]:
        """The samples played so far."""
        return cut(self._stretches, self._rate, now_s)


def runs(blocks: Samples) -> list[tuple[int, int]]:
    """Cut blocks, int16 (n, samples), into runs of equal ones and runs in which neighbours differ."""
    same = np.zeros(len(blocks) + 1, np.bool_)
    same[1:-1] = (blocks[1:, :8] == blocks[:-1, :8]).all(axis=1)  # most that are not differ at once
    for at in same.nonzero()[0]:
        same[at] = np.array_equal(blocks[at], blocks[at - 1])
    alone = ~same[:-1] & ~same[1:]
    cuts = ~same[1:-1] & ~(alone[1:] & alone[:-1])
    edges = [0, *(cuts.nonzero()[0] + 1).tolist(), len(blocks)]
    return [*pairwise(edges)]


class Fifo:
    """A ring buffer in the PC, the bus, the on-board memory as a FIFO, and the output.

    Bytes are handed over by the user, transferred by the bus while there is room on the
    card, and consumed by the output from the trigger on. Until they are transferred the user
    may change them. When the output finds none it stops: an underrun.

    Args:
        words: Where its state is, for code in C; see ``fifo_kernels``.
        buffer: The ring.
        frame_bytes: Bytes of one sample of all active channels.
        sample_rate_hz: Sample rate.
        room_bytes: How much of the on-board memory is used.
        bus_bytes_per_s: Speed of the bus.
    """

    def __init__(
        self,
        words: NDArray[np.int64],
        buffer: Buffer,
        frame_bytes: int,
        sample_rate_hz: float,
        room_bytes: int,
        bus_bytes_per_s: float,
    ) -> None:
        self._buffer = buffer
        self._frame = frame_bytes
        self._rate = sample_rate_hz
        self._pieces: list[tuple[int, Stretch]] = []
        self._words, self._real = words, words.view(np.float64)
        words[k.ADDRESS], words[k.N_BYTES], words[k.NOTIFY] = (
            buffer.address,
            buffer.n_bytes,
            buffer.notify_bytes,
        )
        words[k.FRAME] = frame_bytes
        words[k.HANDED] = words[k.DMA] = words[k.FAILED] = words[k.FINISHED] = 0
        words[k.N_ENTRIES] = words[k.N_READ] = words[k.HAS_LEFT_OUT] = words[k.LATCHED] = 0
        self._real[k.RATE : k.NOW] = sample_rate_hz, room_bytes, bus_bytes_per_s, math.inf, 0.0, 0.0
        self._real[k.NOW], self._real[k.PLAY] = -math.inf, math.inf

    @property
    def failed(self) -> bool:
        """Whether the output found no data."""
        return bool(self._words[k.FAILED])

    @property
    def finished(self) -> bool:
        """Whether everything was played."""
        return bool(self._words[k.FINISHED])

    @property
    def play_s(self) -> float:
        """When the output starts; inf if that is not known."""
        return float(self._real[k.PLAY])

    def set_length(self, n_samples: int) -> None:
        """The card is started, with the number of samples per channel to play; 0: until the stop."""
        self._real[k.TOTAL] = n_samples * self._frame if n_samples else math.inf
        self._real[k.ROOM] += OUTPUT_FIFO_BYTES

    def hand_over(self, n_bytes: int) -> None:
        """The user has filled bytes, which the card may now fetch."""
        if not 0 <= n_bytes <= self.user_bytes:
            raise refuse(n_bytes, f"0 to {self.user_bytes} bytes")
        if n_bytes % self._frame:
            raise refuse(n_bytes, f"a multiple of {self._frame} bytes")
        self._words[k.HANDED] += n_bytes

    def _take_kept(self) -> None:
        """Take over what was fetched beside Python.

        Raises:
            RuntimeError: The memory for it was full.
        """
        words, entry, data = self._words, np.zeros(4, np.int64), np.empty(0, np.uint8)
        while k.take(words, entry, data) or entry[3]:
            if entry[3] > len(data):
                data = np.empty(entry[3], np.uint8)
                continue
            self._keep(int(entry[0]), int(entry[1]), data[: entry[3]].view(np.int16))
        if words[k.HAS_LEFT_OUT]:
            raise RuntimeError("the simulated card has not kept all that it played; read it more often")

    def _keep(self, start: int, n_bytes: int, data: Samples) -> None:
        """Remember samples that will be played, no silence, and of equal blocks only the first.

        Args:
            start: Their place in the stream, in bytes.
            n_bytes: How many are played; ``data`` is repeated.
            data: Samples.
        """
        size = self._buffer.notify_bytes
        if size and n_bytes == data.nbytes and not n_bytes % size:
            blocks = data.reshape(-1, size // 2)
            for first, end in runs(blocks):
                is_one = end - first > 1 and np.array_equal(blocks[first], blocks[first + 1])
                part = blocks[first : first + 1 if is_one else end]
                self._keep_piece(start + first * size, (end - first) * size, part)
        else:
            self._keep_piece(start, n_bytes, data)

    def _keep_piece(self, start: int, n_bytes: int, data: Samples) -> None:
        """The same for equal blocks, or for blocks of which each differs from the one before."""
        words = data.view(np.uint64) if data.nbytes % 8 == 0 else data.view(np.uint16)
        if not words.max():  # several times faster than any()
            return
        data = data.reshape(-1, self._frame // 2)
        first, n_samples = start // self._frame, n_bytes // self._frame
        if n_bytes > data.nbytes and self._pieces:
            before, last = self._pieces[-1]
            if before + last.n_samples == first and np.array_equal(last.samples, data):
                self._pieces[-1] = before, replace(last, n_samples=last.n_samples + n_samples)
                return
        self._pieces.append((first, Stretch(0.0, data.copy(), n_samples)))

    def switch_dma(self, on: bool, now_s: float) -> None:
        """Whether the bus fetches what was handed over."""
        self.advance(now_s)
        self._words[k.DMA] = on

    @property
    def is_transferring(self) -> bool:
        """Whether the bus fetches what is handed over."""
        return bool(self._words[k.DMA])

    @property
    def user_bytes(self) -> int:
        """Bytes that are free for the user, in whole notify sizes."""
        return int(k.user_bytes(self._words))

    @property
    def levels(self) -> tuple[float, float]:
        """Bytes that were handed over and wait in the computer, and that wait on the card."""
        fetched = float(self._real[k.FETCHED])
        return float(self._words[k.HANDED]) - fetched, fetched - float(self._real[k.PLAYED])

    @property
    def block_ready(self) -> bool:
        """Whether there is room for a block, or all was transferred."""
        is_idle = self._real[k.FETCHED] >= self._words[k.HANDED]
        return self.user_bytes >= max(1, self._buffer.notify_bytes) or bool(is_idle)

    def advance(self, now_s: float) -> None:
        """Let bytes flow up to now; of those that are fetched, only now the content is decided."""
        n_bytes = int(k.advance(self._words, now_s))
        if n_bytes > 0:
            start = int(self._words[k.LATCHED])
            self._keep(start, n_bytes, self._buffer.fetch(start, n_bytes))
            self._words[k.LATCHED] = start + n_bytes

    def trigger(self, out_s: float) -> None:
        """The first trigger starts the output."""
        self._real[k.PLAY] = min(self._real[k.PLAY], out_s)

    def played(self, now_s: float) -> list[Stretch]:
        """The samples that were output so far."""
        self._take_kept()
        n_samples, play_s = math.floor((self._real[k.PLAYED] + k.SMALL) / self._frame), self.play_s
        stretches = [
            Stretch(play_s + first / self._rate, piece.samples, min(piece.n_samples, n_samples - first))
            for first, piece in self._pieces
            if first < n_samples
        ]
        return cut(stretches, self._rate, now_s)

    def forget(self, before_s: float) -> None:
        """Drop the data that were played before a time."""
        self._take_kept()
        if self.play_s < before_s:
            n_samples = (before_s - self.play_s) * self._rate
            self._pieces = [piece for piece in self._pieces if piece[0] + piece[1].n_samples > n_samples]
