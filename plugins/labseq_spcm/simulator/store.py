"""Memory of this computer for what was streamed to a simulated card."""

from __future__ import annotations

import weakref
from typing import Final

import numpy as np

from labseq_spcm.simulator.memory import Samples

AREA: Final = 1 << 21
"""Samples that are asked for at a time."""
MAX_AHEAD: Final = 1 << 27
"""Most samples that are asked for before they are needed."""


class Store:
    """Memory that is used again once nobody looks at what is in it any more.

    To get fresh memory from the operating system, page by page, can take longer than to play what
    is put there: a stream would run dry for a reason that no real card has.
    """

    def __init__(self) -> None:
        self._free: list[Samples] = []
        self._rest: Samples = np.empty(0, np.int16)

    def reserve(self, n: int) -> None:
        """See that there is memory for a number of samples, or for as many as are asked for ahead."""
        while len(self._free) * AREA < min(n, MAX_AHEAD):
            area = np.empty(AREA, np.int16)
            area.fill(0)  # until then it is only promised
            self._free.append(area)

    def take(self, n: int) -> Samples:
        """Memory for n samples, int16 (n,); it is free again when nothing refers to it any more."""
        if n > AREA:
            return np.empty(n, np.int16)
        if len(self._rest) < n:
            self.reserve(n)
            area = self._free.pop()
            self._rest = np.frombuffer(area.data, np.int16)  # all that is cut from it keeps it alive
            weakref.finalize(self._rest, self._free.append, area)
        taken, self._rest = self._rest[:n], self._rest[n:]
        return taken
