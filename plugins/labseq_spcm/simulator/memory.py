"""The on-board memory, and how data get there: over the bus, in time."""

from __future__ import annotations

import ctypes
import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labseq_spcm.simulator import registers as r
from labseq_spcm.simulator.rules import Refusal, refuse

Samples = NDArray[np.int16]

PAGE = 4096
SMALL_NOTIFY = (16, 32, 64, 128, 256, 512, 1024, 2048)


@dataclass(frozen=True, slots=True)
class Buffer:
    """A transfer buffer in the memory of the PC.

    Attributes:
        address: Where it starts.
        offset: Where its data shall go, in bytes from the start of the memory or segment.
        n_bytes: Its length.
        notify_bytes: How much must have been transferred until somebody is told; 0: all.
    """

    address: int
    offset: int
    n_bytes: int
    notify_bytes: int

    def check(self, buffer_type: int, direction: int) -> None:
        """Refuse what the driver refuses, and a buffer that is not aligned to a page.

        Raises:
            Refusal: Wrong kind, direction, size or notify size, or not aligned.
        """
        if buffer_type != r.SPCM_BUF_DATA:
            raise refuse(buffer_type, f"the buffer type {r.SPCM_BUF_DATA}")
        if direction != r.SPCM_DIR_PCTOCARD:
            raise Refusal(r.ERR_DIRMISMATCH, "a generator card takes data from the PC only")
        if self.notify_bytes % PAGE and self.notify_bytes not in SMALL_NOTIFY:
            raise Refusal(
                r.ERR_NOTIFYSIZE, f"notify size {self.notify_bytes} is not a multiple of 4096 bytes"
            )
        if self.n_bytes <= 0 or self.n_bytes % 2 or self.offset % 2:
            raise refuse(self.n_bytes, "a whole number of samples")
        if not self.address or self.address % PAGE:
            raise Refusal(r.ERR_INVALIDPARAM, "the buffer must be aligned to 4096 bytes")

    def content(self) -> Samples:
        """A copy of all of it, int16 (n_bytes / 2,)."""
        out = np.empty(self.n_bytes // 2, np.int16)
        self.fetch(0, out)
        return out

    def fetch(self, start: int, out: Samples) -> None:
        """Copy some of its samples, which may go around its end, from byte ``start`` on."""
        whole = (ctypes.c_char * self.n_bytes).from_address(self.address)
        samples = np.frombuffer(memoryview(whole), np.int16)
        first = start % self.n_bytes // 2
        n = min(len(out), len(samples) - first)
        out[:n] = samples[first : first + n]
        out[n:] = samples[: len(out) - n]


@dataclass(frozen=True, slots=True)
class Upload:
    """Data on their way to the memory.

    Attributes:
        done_s: When the last of them is there.
        segment: The segment they go to; None for the memory as a whole.
        n_samples: Length of that memory or segment, all channels together.
        first: Where in it the data go.
        data: int16 (n,).
    """

    done_s: float
    segment: int | None
    n_samples: int
    first: int
    data: Samples


class Memory:
    """The samples on the card.

    Attributes:
        uploads: What is still on its way, in order.
    """

    def __init__(self, bus_bytes_per_s: float) -> None:
        self._bus_bytes_per_s = bus_bytes_per_s
        self._areas: dict[int | None, Samples] = {}
        self._in_use: set[int | None] = set()
        self._bus_free_s = -math.inf
        self.uploads: deque[Upload] = deque()

    @property
    def done_s(self) -> float:
        """When the bus will be, or became, idle."""
        return self._bus_free_s

    def send(self, now_s: float, segment: int | None, n_samples: int, first: int, data: Samples) -> None:
        """Put data on the bus."""
        self._bus_free_s = max(now_s, self._bus_free_s) + data.nbytes / self._bus_bytes_per_s
        self.uploads.append(Upload(self._bus_free_s, segment, n_samples, first, data))

    def store(self, upload: Upload) -> None:
        """Data arrive. What is being played from the old content goes on with it."""
        area = self._areas.get(upload.segment)
        if len(upload.data) == upload.n_samples:
            area = upload.data
        else:
            if area is None or len(area) != upload.n_samples:
                old = area if area is not None else np.zeros(0, np.int16)
                area = np.zeros(upload.n_samples, np.int16)
                area[: len(old)] = old[: len(area)]
            elif upload.segment in self._in_use:
                area = area.copy()
            area[upload.first : upload.first + len(upload.data)] = upload.data
        self._areas[upload.segment] = area
        self._in_use.discard(upload.segment)

    def read(self, segment: int | None, n_samples: int, n_channels: int) -> Samples:
        """What is there, int16 (n_samples, n_channels); zeros where nothing was ever written."""
        area = self._areas.get(segment)
        if area is None or len(area) < n_samples * n_channels:
            old = area if area is not None else np.zeros(0, np.int16)
            area = np.zeros(n_samples * n_channels, np.int16)
            area[: len(old)] = old
            self._areas[segment] = area
        self._in_use.add(segment)
        return area[: n_samples * n_channels].reshape(n_samples, n_channels)

    def drop_segments(self) -> None:
        """The memory was divided anew: all segments are lost."""
        whole = self._areas.get(None)
        self._areas = {} if whole is None else {None: whole}
