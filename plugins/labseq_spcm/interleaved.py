"""Tone programs as the card wants them: the samples of both outputs side by side."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Renderer, ToneProgram
from labseq_spcm.limits import SAMPLE_STEP

CHUNK: Final = 1 << 18
"""Samples that are rendered at a time, 0.4 ms at 625 MS/s: few enough to stay in the cache meanwhile."""


class InterleavedRenderer:
    """Renders any stretch of a program, in the thread that asks for it.

    A second thread would have to be waited for, and where other programs keep the processor busy
    that takes longer than the work that it takes over.

    Args:
        program: What is played.
        sample_rate_hz: What the card's clock really makes.
        row_channel: The output of the row axis, 0 or 1.

    Attributes:
        n_samples: Samples per channel, silence up to the card's granularity included.
    """

    def __init__(self, program: ToneProgram, sample_rate_hz: float, row_channel: int) -> None:
        self._renderer = Renderer(program, sample_rate_hz)
        self._channels = (row_channel, 1 - row_channel)
        self._chunk = np.empty((2, CHUNK), np.int16)
        self.n_samples = max(1, math.ceil(self._renderer.n_samples / SAMPLE_STEP)) * SAMPLE_STEP

    def write(self, start: int, out: NDArray[np.int16]) -> None:
        """Render some samples; after the end of the program there is silence.

        Args:
            start: The first sample.
            out: Result, int16 (n, 2): a column per output.
        """
        from labseq_spcm._kernels import interleave

        frames = out.view(np.uint32)[:, 0]
        for first in range(0, len(out), CHUNK):
            chunk = self._chunk[:, : len(out) - first]
            for axis, channel in enumerate(self._channels):
                self._renderer.write(axis, start + first, chunk[channel])
            first_words, second_words = chunk.view(np.uint16)
            interleave(first_words, second_words, frames[first : first + CHUNK])
