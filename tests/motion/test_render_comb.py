from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from labseq.errors import LimitError
from labseq.model import SiteGrid
from labseq.motion import comb_sample_rate


def comb(n: int, start_hz: float, step_hz: float) -> NDArray[np.float64]:
    return (start_hz + step_hz * np.arange(n)).astype(np.float64)


def test_the_sample_rate_suits_both_axes() -> None:
    assert comb_sample_rate(SiteGrid()) == 624e6
    rows, columns = comb(5, 90e6, 1.5e6), comb(5, 90e6, 1.0e6)
    grid = SiteGrid(5, 5, row_frequency_hz=rows, column_frequency_hz=columns)
    assert comb_sample_rate(grid) == 624e6
    assert comb_sample_rate(SiteGrid(1, 1)) == 625e6
    rows = comb(5, 90e6, 1.6180339e6)
    with pytest.raises(LimitError, match=r"1618033\.9 Hz and 1000000 Hz"):
        comb_sample_rate(SiteGrid(5, 5, row_frequency_hz=rows, column_frequency_hz=columns))
