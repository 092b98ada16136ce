"""FIFO_SINGLE: played while it is transferred. The session's clock consumes the data."""

from __future__ import annotations

import math

from labseq_spcm.simulator.memory import Buffer
from labseq_spcm.simulator.replay import Stretch, cut
from labseq_spcm.simulator.rules import refuse
from labseq_spcm.simulator.store import Store

SMALL: float = 1e-3
"""Bytes that are rounding of time."""


class Fifo:
    """A ring buffer in the PC, the bus, the on-board memory as a FIFO, and the output.

    Bytes are handed over by the user, transferred by the bus while there is room on the
    card, and consumed by the output from the trigger on. When the output finds none it
    breaks off: an underrun.

    Args:
        buffer: The ring.
        n_channels: Active channels.
        sample_rate_hz: Sample rate.
        room_bytes: How much of the on-board memory is used.
        bus_bytes_per_s: Speed of the bus.
        store: Memory for what was handed over.
    """

    def __init__(
        self,
        buffer: Buffer,
        n_channels: int,
        sample_rate_hz: float,
        room_bytes: int,
        bus_bytes_per_s: float,
        store: Store,
    ) -> None:
        self._buffer = buffer
        self._store = store
        self._frame = 2 * n_channels
        self._rate = sample_rate_hz
        self._room = room_bytes
        self._bus = bus_bytes_per_s
        self._total = math.inf
        self._handed = 0
        self._transferred = 0.0
        self._consumed = 0.0
        self._now_s = -math.inf
        self._play_s = math.inf
        self._pieces: list[tuple[int, Stretch]] = []
        self._dma = False
        self.failed = False
        self.finished = False

    def set_length(self, n_samples: int) -> None:
        """How many samples per channel shall be played; 0: until the stop."""
        self._total = n_samples * self._frame if n_samples else math.inf

    def hand_over(self, n_bytes: int) -> None:
        """The user has filled bytes, which the card may now fetch.

        Raises:
            Refusal: More than were free, or not whole samples.
        """
        if not 0 <= n_bytes <= self._buffer.n_bytes - (self._handed - self._notified()):
            raise refuse(n_bytes, f"0 to {self.user_bytes} bytes")
        if n_bytes % self._frame:
            raise refuse(n_bytes, f"a multiple of {self._frame} bytes")
        if n_bytes:
            data = self._store.take(n_bytes // 2)
            self._buffer.fetch(self._handed, data)
            data = data.reshape(-1, self._frame // 2)
            self._pieces.append((self._handed // self._frame, Stretch(0.0, data, len(data))))
            self._handed += n_bytes

    def start_dma(self, now_s: float) -> None:
        """The bus begins to fetch."""
        self.advance(now_s)
        self._dma = True

    def stop_dma(self, now_s: float) -> None:
        """The bus fetches no more."""
        self.advance(now_s)
        self._dma = False

    def _notified(self) -> int:
        done = math.floor(self._transferred + SMALL)
        notify = self._buffer.notify_bytes
        return done // notify * notify if notify else done

    @property
    def user_bytes(self) -> int:
        """Bytes that are free for the user, in whole notify sizes."""
        return self._buffer.n_bytes - (self._handed - self._notified())

    @property
    def user_position(self) -> int:
        """Where in the ring the free bytes start."""
        return self._handed % self._buffer.n_bytes

    @property
    def fill_promille(self) -> int:
        """How full the on-board memory is, in sixteenths."""
        sixteenths = math.floor(16 * (self._transferred - self._consumed) / self._room + SMALL)
        return round(sixteenths * 62.5)

    @property
    def block_ready(self) -> bool:
        """Whether a wait for the transfer would return."""
        return self.user_bytes >= max(1, self._buffer.notify_bytes) or self._transferred >= self._handed

    def block_s(self) -> float | None:
        """When a wait for the transfer will return, at the present speed."""
        speed = self._speed()
        missing = max(1, self._buffer.notify_bytes) - self.user_bytes
        return self._now_s + max(1.0, missing) / speed if speed > 0 else None

    def _drain(self) -> float:
        return self._rate * self._frame if self._now_s >= self._play_s and not self._over else 0.0

    @property
    def _over(self) -> bool:
        return self.failed or self.finished

    def _speed(self) -> float:
        """What the bus carries now, in bytes per second."""
        if not self._dma or self._over or self._transferred >= self._handed - SMALL:
            return 0.0
        full = self._transferred - self._consumed >= self._room - SMALL
        return min(self._bus, self._drain()) if full else self._bus

    def advance(self, now_s: float) -> None:
        """Let bytes flow up to now."""
        if self._now_s == -math.inf:
            self._now_s = now_s
        while self._now_s < now_s and not self._over:
            self._flow(now_s)
        self._now_s = max(self._now_s, now_s)

    def _flow(self, now_s: float) -> None:
        """Flow until something changes: the start, the end of the data, full, empty, or now."""
        drain, speed = self._drain(), self._speed()
        fill = self._transferred - self._consumed
        if drain > speed and fill <= SMALL:
            self.failed = True
            return
        spans = [now_s - self._now_s]
        if self._now_s < self._play_s:
            spans.append(self._play_s - self._now_s)
        if speed:
            spans.append((self._handed - self._transferred) / speed)
        if speed > drain:
            spans.append((self._room - fill) / (speed - drain))
        if drain > speed:
            spans.append(fill / (drain - speed))
        if drain:
            spans.append((self._total - self._consumed) / drain)
        step_s = min(spans)
        at_least_s = math.nextafter(self._now_s, math.inf)
        self._now_s = now_s if step_s == spans[0] else max(self._now_s + step_s, at_least_s)
        self._transferred = min(float(self._handed), self._transferred + speed * step_s)
        self._consumed = min(self._transferred, self._consumed + drain * step_s)
        self.finished = self._consumed >= self._total - SMALL

    def trigger(self, out_s: float) -> None:
        """The first trigger starts the output."""
        self._play_s = min(self._play_s, out_s)

    def ends_s(self) -> float | None:
        """Known if the length is, and it plays."""
        end_s = self._play_s + self._total / (self._rate * self._frame)
        return end_s if end_s < math.inf else None

    def played(self, now_s: float) -> list[Stretch]:
        """What came out of the FIFO so far."""
        n_samples = math.floor((self._consumed + SMALL) / self._frame)
        stretches = [
            Stretch(self._play_s + first / self._rate, piece.samples, min(piece.n_samples, n_samples - first))
            for first, piece in self._pieces
            if first < n_samples
        ]
        return cut(stretches, self._rate, now_s)

    def forget(self, before_s: float) -> None:
        """Drop the data that were played before a time."""
        if self._play_s < before_s:
            n_samples = (before_s - self._play_s) * self._rate
            self._pieces = [piece for piece in self._pieces if piece[0] + piece[1].n_samples > n_samples]
