"""Kernels of the weighted detector, for a pass over the pixels and a pass over the neighbours."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.kernels.kernel import const, kernel

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]

IMAGE: Final = const("uint16", 2)
CORNERS: Final = const("int64", 2)
WEIGHTS: Final = const("float32", 3)
CURVE: Final = const("float32", 1)
INDICES: Final = const("int64", 1)
VALUES: Final = const("float64", 1)


@kernel(f"void({IMAGE}, {CORNERS}, {WEIGHTS}, {CURVE}, {VALUES}, float64[::1])")
def weigh_sites(
    image: NDArray[np.uint16], corners: Ints, weights: Singles, curve: Singles, constant: Floats, odds: Floats
) -> None:
    """Weigh the pixels around each site.

    Args:
        image: uint16 (height, width), the frame.
        corners: int64 (n_sites, 2), (y, x) of the first pixel of each region. No region reaches over the
            edge.
        weights: float32 (n_sites, region, region), weight of each pixel.
        curve: float32 (65536,), value of a pixel, by its counts.
        constant: float64 (n_sites,), added to each sum.
        odds: Result, float64 (n_sites,), the constant plus the weighted sum.
    """
    n_rows, n_cols = weights.shape[1], weights.shape[2]
    for site in range(len(corners)):
        y, x = corners[site, 0], corners[site, 1]
        total = constant[site]
        for row in range(n_rows):
            in_row = np.float32(0.0)
            for col in range(n_cols):
                in_row += weights[site, row, col] * curve[image[y + row, x + col]]
            total += in_row
        odds[site] = total


@kernel(f"void({INDICES}, {INDICES}, {VALUES}, {VALUES}, float64[::1])")
def undo_neighbours(starts: Ints, neighbours: Ints, effects: Floats, odds: Floats, undone: Floats) -> None:
    """Subtract the effect of the light of neighbours with atoms.

    Args:
        starts: int64 (n_sites + 1,), where each site's neighbours start in the lists.
        neighbours: int64 (n,), the sites whose light reaches it.
        effects: float64 (n,), odds that an atom on the neighbour adds.
        odds: float64 (n_sites,), from :func:`weigh_sites`. More than 0 is an atom.
        undone: Result, float64 (n_sites,).
    """
    for site in range(len(odds)):
        total = odds[site]
        for k in range(starts[site], starts[site + 1]):
            if odds[neighbours[k]] > 0.0:
                total -= effects[k]
        undone[site] = total
