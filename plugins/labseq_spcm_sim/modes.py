"""The modes that play samples, STD_SINGLE from the on-board memory and FIFO_SINGLE as a stream."""

from __future__ import annotations

import ctypes
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from labseq_spcm_sim import registers as r
from labseq_spcm_sim.faults import Faults, LateCounter
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
        notify_bytes: Granularity in which the card reports transferred bytes, 0 for all at once.
    """

    address: int
    n_bytes: int
    notify_bytes: int

    def check(self, kind: int, direction: int, offset: int) -> None:
        """Refuse a buffer as the driver does, also if it is not aligned to a page."""
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

    Attributes:
        uploads: Arrival and content of uploads that have not arrived yet, in order.
    """

    def __init__(self) -> None:
        self._uploaded: list[Samples] = []  # the latest first, and longer ones behind it
        self._idle_s = -math.inf
        self.uploads: deque[tuple[float, Samples]] = deque()

    def send(self, now_s: float, data: Samples, bytes_per_s: float) -> None:
        """Put data for the beginning of the memory on the bus, at a speed."""
        self._idle_s = max(now_s, self._idle_s) + data.nbytes / bytes_per_s
        self.uploads.append((self._idle_s, data))

    def drop(self) -> None:
        """Drop data that have not arrived."""
        self.uploads.clear()

    def store(self, data: Samples) -> None:
        """Store arriving data. A replay that has begun keeps the old content."""
        self._uploaded = [data, *(older for older in self._uploaded if len(older) > len(data))]

    def read(self, n_samples: int, n_channels: int) -> Samples:
        """The content, int16 (n_samples, n_channels), zeros where nothing was ever written."""
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
        samples: int16 (n, n_channels), which repeats.
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
    """The samples played by now."""
    parts: list[Stretch] = []
    for stretch in stretches:
        n_samples = min(stretch.n_samples, math.floor((now_s - stretch.start_s) * sample_rate_hz + ROUNDING))
        if n_samples > 0:
            parts.append(replace(stretch, n_samples=n_samples))
    return parts


class Replay:
    """STD_SINGLE, which plays the memory after the first trigger.

    Args:
        content: Returns the memory, int16 (n, n_channels), as it is when the replay begins.
        sample_rate_hz: Sample rate.
        loops: How often the memory is played, 0 for until the stop.
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
        """Begin. Later triggers have no effect."""
        if not self._stretches:
            samples = self._content()
            n_samples = len(samples) * self._loops if self._loops else 2**62
            self._end_s = out_s + n_samples / self._rate
            self._stretches.append(Stretch(out_s, samples, n_samples))

    def played(self, now_s: float) -> list[Stretch]:
        """The samples played so far."""
        return cut(self._stretches, self._rate, now_s)


ROUNDING_BYTES: Final = 1e-3
"""Bytes that are a rounding error of time."""


def is_silent(data: Samples) -> bool:
    """Whether all samples are 0."""
    words = data.view(np.uint64) if data.nbytes % 8 == 0 else data.view(np.uint16)
    return not words.max()  # several times faster than any()


class Fifo:
    """FIFO_SINGLE with a ring buffer in the PC, the bus, the on-board memory as a FIFO, and the output.

    Bytes are handed over by the user, fetched by the bus while there is room on the card, and played from
    the trigger on. The bus reads a whole block when it fetches the first byte of it. Until then the user may
    change it. When the output finds none it stops with an underrun.

    Args:
        buffer: The ring.
        frame_bytes: Bytes of one sample of all active channels.
        sample_rate_hz: Sample rate.
        room_bytes: How much of the on-board memory is used.
        bus_bytes_per_s: Speed of the bus.
        faults: The card's differences from the default.
        keeps: Whether played samples are kept for :meth:`played`.

    Attributes:
        handed: Bytes handed over so far.
        fetched: Bytes that the bus has fetched.
        n_played: Bytes that the output has played.
        total: Bytes to play until the end, inf for until the stop.
        play_s: When the output starts, inf if that is not known.
        is_transferring: Whether the bus fetches handed-over bytes.
        finished: Whether everything was played.
        failed: Whether the output found no data.
    """

    def __init__(
        self,
        buffer: Buffer,
        frame_bytes: int,
        sample_rate_hz: float,
        room_bytes: float,
        bus_bytes_per_s: float,
        faults: Faults = Faults(),  # noqa: B008 - frozen
        *,
        keeps: bool = True,
    ) -> None:
        self._buffer, self._frame, self._rate, self._keeps = buffer, frame_bytes, sample_rate_hz, keeps
        self._room, self._bus = room_bytes - faults.fifo_short_bytes, bus_bytes_per_s
        self._copies, self._reported = faults.copies_samples, LateCounter(faults.position_lag_s)
        self._pieces: list[tuple[int, Stretch]] = []
        self._latched = 0
        self._now_s = -math.inf
        self.handed = 0
        self.fetched = self.n_played = 0.0
        self.total = self.play_s = math.inf
        self.is_transferring = self.finished = self.failed = False

    def set_length(self, n_samples: int) -> None:
        """Set the number of samples per channel to play at the start, 0 for until the stop."""
        self.total = n_samples * self._frame if n_samples else math.inf
        self._room += OUTPUT_FIFO_BYTES

    def hand_over(self, n_bytes: int) -> None:
        """The user has filled bytes, which the card may now fetch."""
        room = self.user_bytes + max(0, self._buffer.n_bytes - self.handed)
        if not 0 <= n_bytes <= room:
            raise refuse(n_bytes, f"0 to {room} bytes")
        if n_bytes % self._frame:
            raise refuse(n_bytes, f"a multiple of {self._frame} bytes")
        self.handed += n_bytes
        if self._copies:
            self._latch()

    def switch_dma(self, on: bool, now_s: float) -> None:
        """Let the bus fetch handed-over bytes, or stop it."""
        self.advance(now_s)
        self.is_transferring = on

    def trigger(self, out_s: float) -> None:
        """The first trigger starts the output."""
        self.play_s = min(self.play_s, out_s)

    @property
    def user_bytes(self) -> int:
        """Bytes that are free for the user, in whole notify sizes, as far as the card has reported it.

        A new buffer counts as full (manual, "Buffer handling"), so none are free until some were fetched.
        """
        fetched = math.floor(self._reported.at(self._now_s) + ROUNDING_BYTES)
        notified = fetched - fetched % max(1, self._buffer.notify_bytes)
        return notified - max(0, self.handed - self._buffer.n_bytes)

    @property
    def levels(self) -> tuple[float, float]:
        """Bytes that were handed over and wait in the computer, and that wait on the card."""
        return self.handed - self.fetched, self.fetched - self.n_played

    @property
    def block_ready(self) -> bool:
        """Whether there is room for a block, or all was transferred."""
        is_done = 0 < self.handed <= self.fetched
        return self.user_bytes >= max(1, self._buffer.notify_bytes) or is_done

    def advance(self, now_s: float) -> None:
        """Let bytes flow up to now."""
        if self._now_s == -math.inf:
            self._now_s = now_s
            self._reported.add(now_s, 0.0)
        while self._now_s < now_s and not self.failed and not self.finished:
            self._flow(now_s)
        self._now_s = max(self._now_s, now_s)
        self._latch()

    def _flow(self, now_s: float) -> None:
        """Let bytes flow until something changes (the start, the end of the data, full, empty, or now)."""
        drain = self._rate * self._frame if self._now_s >= self.play_s else 0.0
        waiting, fill = self.levels
        speed = 0.0
        if self.is_transferring and waiting > ROUNDING_BYTES:
            speed = self._bus if fill < self._room - ROUNDING_BYTES else min(self._bus, drain)
        if drain > speed and fill <= ROUNDING_BYTES:
            self.failed = True
            return
        step_s, end_s = now_s - self._now_s, now_s
        for span, per_s in (
            (self.play_s - self._now_s, 1.0 if self._now_s < self.play_s else 0.0),
            (waiting, speed),
            (self._room - fill, speed - drain),
            (fill, drain - speed),
            (self.total - self.n_played, drain),
        ):
            if per_s > 0.0 and span / per_s < step_s:
                step_s = span / per_s
                end_s = max(self._now_s + step_s, math.nextafter(self._now_s, math.inf))
        self._now_s = end_s
        self.fetched = min(float(self.handed), self.fetched + speed * step_s)
        self._reported.add(self._now_s, self.fetched)
        self.n_played = min(self.fetched, self.n_played + drain * step_s)
        self.finished = self.n_played >= self.total - ROUNDING_BYTES

    def _latch(self) -> None:
        """Keep the blocks that the bus has begun to fetch, where the user's changes now come too late."""
        block = self._buffer.notify_bytes or self._frame
        begun = min(math.ceil((self.fetched - ROUNDING_BYTES) / block) * block, self.handed)
        begun = self.handed if self._copies else begun
        start, self._latched = self._latched, max(self._latched, begun)
        if self._keeps and begun > start and not is_silent(self._buffer.fetch(start, begun - start)):
            step = self._buffer.notify_bytes or begun - start
            for at in range(start, begun, step):
                self._keep(at, self._buffer.fetch(at, min(step, begun - at)))

    def _keep(self, start: int, data: Samples) -> None:
        """Keep samples from a place in the stream, in bytes, without silence, and equal blocks only once."""
        if is_silent(data):
            return
        data = data.reshape(-1, self._frame // 2)
        first = start // self._frame
        if self._pieces:
            before, last = self._pieces[-1]
            follows = before + last.n_samples == first and np.array_equal(last.samples[:8], data[:8])
            if follows and np.array_equal(last.samples, data):  # most that differ do so from the start
                self._pieces[-1] = before, replace(last, n_samples=last.n_samples + len(data))
                return
        self._pieces.append((first, Stretch(0.0, data.copy(), len(data))))

    def played(self, now_s: float) -> list[Stretch]:
        """The samples that were output so far."""
        n_samples = math.floor((self.n_played + ROUNDING_BYTES) / self._frame)
        stretches = [
            Stretch(self.play_s + first / self._rate, piece.samples, min(piece.n_samples, n_samples - first))
            for first, piece in self._pieces
            if first < n_samples
        ]
        return cut(stretches, self._rate, now_s)

    def forget(self, before_s: float) -> None:
        """Drop the data that were played before a time."""
        if self.play_s < before_s:
            n_samples = (before_s - self.play_s) * self._rate
            self._pieces = [piece for piece in self._pieces if piece[0] + piece[1].n_samples > n_samples]
