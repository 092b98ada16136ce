"""Probability laws of whole numbers, to draw from quickly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

NEVER: Final = 1e-13
"""Numbers at the ends of a law that are rarer than this together are left out."""


@dataclass(frozen=True, slots=True, eq=False)
class CountDistribution:
    """A law of whole numbers: its distribution function in a table, inverted by 32 random bits.

    Probabilities are rounded to whole multiples of 2^-32.

    Attributes:
        first: The least number.
        edges: uint32 (n_numbers,), the last random word of each number.
        starts: int32, where in ``edges`` to start looking, by the leading bits of the word.
    """

    first: int
    edges: NDArray[np.uint32]
    starts: NDArray[np.int32]

    @classmethod
    def of(cls, probability: NDArray[np.float64], first: int = 0) -> CountDistribution:
        """Tabulate a law.

        Args:
            probability: float64 (n,), of the numbers from ``first`` on; need not add up to 1.
            first: See there.
        """
        from labseq_virtual import _kernels_image as kernels

        below = np.cumsum(np.maximum(probability, 0.0))
        below /= below[-1]
        low, high = np.searchsorted(below, [NEVER, 1 - NEVER])
        part = below[low : high + 1] / below[high]
        edges = np.maximum(np.ceil(part * 2.0**32) - 1, 0).astype(np.uint32)
        words = np.arange(1 << kernels.START_BITS, dtype=np.uint32) << np.uint32(32 - kernels.START_BITS)
        return cls(first + int(low), edges, np.searchsorted(edges, words).astype(np.int32))

    def draw(self, drawn: NDArray[np.uint16] | NDArray[np.int32], rng: np.random.Generator) -> None:
        """Fill an array (n,) with numbers."""
        from labseq_virtual import _kernels_image as kernels

        kernels.draw(_words(len(drawn), rng), self.edges, self.starts, self.first, drawn)

    def draw_sums(self, n_each: NDArray[np.int64], rng: np.random.Generator) -> NDArray[np.int64]:
        """Draw sums of ``n_each`` numbers, int64 (n_sums,)."""
        from labseq_virtual import _kernels_image as kernels

        sums = np.empty(len(n_each), np.int64)
        words = _words(int(n_each.sum()), rng)
        kernels.draw_sums(words, self.edges, self.starts, self.first, n_each, sums)
        return sums


def _words(n: int, rng: np.random.Generator) -> NDArray[np.uint32]:
    """Random words of 32 bits; two are drawn at once, which is twice as fast."""
    return rng.integers(0, 2**64 - 1, (n + 1) // 2, np.uint64, endpoint=True).view(np.uint32)[:n]
