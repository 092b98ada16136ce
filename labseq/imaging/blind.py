"""A detector for measurements that need the frames only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.imaging.known_sites import ContextLike
from labseq.model import Frame, Occupancy


class BlindDetector:
    """Takes any frame and sees no atoms: it needs to know neither the sites nor the camera.

    Args:
        settings: None.
        context: The grid.
    """

    def __init__(self, settings: object, context: ContextLike) -> None:
        del settings
        self._shape = context.grid.shape

    def detect(self, frame: Frame) -> tuple[Occupancy, NDArray[np.float32]]:
        """See nothing.

        Returns:
            An empty occupancy, bool (n_rows, n_cols), and no confidence, float32 (n_rows, n_cols).
        """
        del frame
        return np.zeros(self._shape, np.bool_), np.zeros(self._shape, np.float32)
