"""The ring buffer of the computer, in which the SDK keeps frames."""

from __future__ import annotations

import ctypes
from collections import OrderedDict
from typing import Any

import numpy as np

from labseq.plugin import Frame
from labseq_andor.codes import Code


class FrameBuffer:
    """Frames by their numbers from 1; the oldest is overwritten when it is full.

    Attributes:
        n_arrived: Frames since the start.
        n_fetched: Number of the last frame that was fetched.
    """

    def __init__(self) -> None:
        self.clear(1)

    def clear(self, size: int) -> None:
        """Forget everything; from now on it holds ``size`` frames."""
        self._size = size
        self._frames: OrderedDict[int, Frame] = OrderedDict()
        self.n_arrived = self.n_fetched = 0

    def add(self, frame: Frame) -> None:
        """A frame arrives."""
        self.n_arrived += 1
        self._frames[self.n_arrived] = frame
        if len(self._frames) > self._size:
            self._frames.popitem(last=False)

    def t_start_s(self, number: int) -> float | None:
        """When a frame's exposure began; None if it is not there."""
        frame = self._frames.get(number)
        return None if frame is None else frame.t_start_s

    def put_new(self, first: Any, last: Any) -> int:
        """Write the numbers of the first and the last frame not yet fetched."""
        new = [number for number in self._frames if number > self.n_fetched]
        if not new:
            return Code.NO_NEW_DATA
        first[0], last[0] = new[0], new[-1]
        return Code.SUCCESS

    def copy(self, first: int, last: int, into: Any, size: int) -> int:
        """Copy frames into a C array of ``size`` pixels."""
        if first not in self._frames:
            return Code.P1INVALID
        if last not in self._frames or last < first:
            return Code.P2INVALID
        images = [np.ascontiguousarray(self._frames[number].image) for number in range(first, last + 1)]
        if size != sum(image.size for image in images):
            return Code.P4INVALID
        address = ctypes.addressof(into.contents)
        for image in images:
            ctypes.memmove(address, image.ctypes.data, image.nbytes)
            address += image.nbytes
        self.n_fetched = max(self.n_fetched, last)
        return Code.SUCCESS
