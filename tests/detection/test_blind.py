from __future__ import annotations

import numpy as np
import pytest

from labseq.detection.threshold import BlindDetector
from labseq.model import Frame, SiteGrid
from labseq.roles import Context


@pytest.mark.parametrize("shape", [(1, 1), (64, 48)])
def test_it_sees_nothing_on_any_frame(shape: tuple[int, int]) -> None:
    detector = BlindDetector(None, Context("detector", SiteGrid(3, 4)))
    occupancy, confidence = detector.detect(Frame(np.full(shape, 65535, np.uint16), 0.1, 0.0, "camera"))
    assert (occupancy.shape, occupancy.dtype, occupancy.any()) == ((3, 4), np.bool_, False)
    assert (confidence.shape, confidence.dtype, confidence.any()) == ((3, 4), np.float32, False)
