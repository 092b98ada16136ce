"""The samples for the radio, block by block, from a loop, its depth, and the fades between loops."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Samples = NDArray[np.float32]

BLOCK: Final = 1 << 15
"""Most samples per block, less than a millisecond at any rate that 20 tones need."""


class Output:
    """The signal of both channels.

    At full depth the samples are the loop itself, at depth 0 zeros. Only ramps and fades cost work. Both
    amplitudes of a tweezer scale with the fourth root of its depth. The loop is never interrupted, so no
    phase ever jumps.

    Attributes:
        depth: Depth at the end of the last block, as a fraction of the nominal depth.
    """

    def __init__(self) -> None:
        self.depth = 0.0
        self._silence = np.zeros((2, 2 * BLOCK), np.float32)
        self._loop = self._silence
        self._next: Samples | None = None
        self._n_fade = self._n_faded = 0
        self._slope = self._goal = 0.0  # of the ramp: change of the depth per sample, and its end
        self._n_ramp = self._n_dark = 0
        self._at = 0
        self._steps = np.arange(1, BLOCK + 1, dtype=np.float32).repeat(2)
        self._factor = np.empty(2 * BLOCK, np.float32)
        self._made = np.empty((2, 2 * BLOCK), np.float32)

    def load(self, loop: Samples, n_fade: int) -> None:
        """Play another loop, at once if nothing is on, otherwise faded in.

        Args:
            loop: float32 (2, 2 n), I and Q in turn, each loop as long as the first.
            n_fade: Length of the fade in samples.
        """
        if self._loop is self._silence:
            self._loop, self._at = loop, 0
        elif self.depth == 0.0 and not self._n_ramp:
            self._loop, self._next = loop, None
        else:
            if self._next is not None:  # the earlier fade stops where it is
                weight = np.float32(self._n_faded / self._n_fade)
                mixed = self._loop + weight * (self._next - self._loop)
                self._loop = mixed.astype(np.float32, copy=False)
            self._next, self._n_fade, self._n_faded = loop, max(1, n_fade), 0

    def ramp(self, depth: float, n_samples: int) -> None:
        """Change the depth linearly from its present value. The last sample has the new depth.

        During a release the ramp starts at once, from 0.
        """
        if self._n_dark:
            self._n_dark, self.depth = 0, 0.0
        self._n_ramp = max(1, n_samples)
        self._slope, self._goal = (depth - self.depth) / self._n_ramp, depth

    def release(self, n_samples: int) -> None:
        """Play silence for some samples. The loop continues at its depth, as if it had played meanwhile."""
        self._n_dark = n_samples

    @property
    def steady(self) -> bool:
        """Whether no ramp, fade or release is under way."""
        return self._n_ramp == 0 and self._n_dark == 0 and self._next is None

    def block(self) -> Samples:
        """The next samples, float32 (2, 2 n) with n from 1 to :data:`BLOCK`. Valid until the next call."""
        n = min(BLOCK, self._loop.shape[1] // 2 - self._at)
        if self._n_ramp:
            n = min(n, self._n_ramp)
        if self._next is not None:
            n = min(n, self._n_fade - self._n_faded)
        if self._n_dark:
            n = min(n, self._n_dark)
        samples = self._shaped(n)
        self._at = (self._at + n) % (self._loop.shape[1] // 2)
        if self._next is not None:
            self._n_faded += n
            if self._n_faded >= self._n_fade:
                self._loop, self._next = self._next, None
        return samples

    def _shaped(self, n: int) -> Samples:
        part = slice(2 * self._at, 2 * (self._at + n))
        if self._n_dark or (self.depth == 0.0 and not self._n_ramp):
            self._n_dark = max(0, self._n_dark - n)
            return self._silence[:, : 2 * n]
        samples = self._loop[:, part]
        made = self._made[:, : 2 * n]
        if self._next is not None:
            weight = self._steps[: 2 * n] * np.float32(1 / self._n_fade)
            weight += np.float32(self._n_faded / self._n_fade)
            np.subtract(self._next[:, part], samples, out=made)
            made *= weight
            made += samples
            samples = made
        if self._n_ramp:
            factor = self._factor[: 2 * n]
            np.multiply(self._steps[: 2 * n], np.float32(self._slope), out=factor)
            factor += np.float32(self.depth)
            np.maximum(factor, 0.0, out=factor)
            np.sqrt(factor, out=factor)
            np.sqrt(factor, out=factor)
            self._n_ramp -= n
            self.depth = self.depth + n * self._slope if self._n_ramp else self._goal
            return np.multiply(samples, factor, out=made)
        if self.depth != 1.0:
            return np.multiply(samples, np.float32(self.depth**0.25), out=made)
        return samples
