"""How much of an atom's light falls on which pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def spot_light(
    centres_px: NDArray[np.float64], corners: NDArray[np.int64], region: int, width_px: float
) -> NDArray[np.float64]:
    """Fraction of the light of Gaussian spots on the pixels of squares.

    Args:
        centres_px: float64 (n, 2), (y, x) of each spot.
        corners: int64 (n, 2), (y, x) of the first pixel of each square.
        region: Width of the squares, in pixels.
        width_px: Width of the spots (1 sigma), in pixels.

    Returns:
        float64 (n, region, region).

    Example:
        >>> import numpy as np
        >>> spot_light(np.array([[3.0, 3.0]]), np.array([[2, 2]]), 3, 0.1).round(3)[0, 1]
        array([0., 1., 0.])
    """
    from scipy.special import ndtr

    edges = (corners[:, :, None] + np.arange(region + 1) - 0.5 - centres_px[:, :, None]) / width_px
    along_y, along_x = np.diff(ndtr(edges), axis=2).transpose(1, 0, 2)
    return along_y[:, :, None] * along_x[:, None, :]


def pairs_within(positions: NDArray[np.float64], distance: float) -> NDArray[np.int64]:
    """Ordered pairs of different points within a distance, int64 (n_pairs, 2), by the first.

    Args:
        positions: float64 (n, 2).
        distance: In the same unit.

    Example:
        >>> import numpy as np
        >>> pairs_within(np.array([[0.0, 0.0], [0.0, 1.0], [0.0, 3.0]]), 1.5).tolist()
        [[0, 1], [1, 0]]
    """
    from scipy.spatial import KDTree

    pairs = KDTree(positions).query_pairs(distance, output_type="ndarray").astype(np.int64)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    return both[np.lexsort((both[:, 1], both[:, 0]))]
