from __future__ import annotations

import numpy as np
import pytest
from labseq_scans.pattern import InterleavedSettings, interleaved
from pydantic import ValidationError

from labseq import LimitError, SiteGrid


def test_it_is_centred_with_reservoir_around() -> None:
    target = interleaved(InterleavedSettings(rows=16, cols=16), SiteGrid(33, 18))
    rows, cols = np.nonzero(target.fill)
    assert sorted(set(rows.tolist())) == list(range(1, 33, 2))
    assert sorted(set(cols.tolist())) == list(range(1, 17))
    assert not target.clear.any()


def test_wider_gaps_an_origin_and_rows_between_to_be_cleared() -> None:
    made = InterleavedSettings(rows=2, cols=2, reservoir_rows=2, origin=(0, 1), clear="bounding_box")
    target = interleaved(made, SiteGrid(5, 3))
    assert target.fill.astype(int).tolist() == [[0, 1, 1], [0] * 3, [0] * 3, [0, 1, 1], [0] * 3]
    assert target.clear.astype(int).tolist() == [[0] * 3, [0, 1, 1], [0, 1, 1], [0] * 3, [0] * 3]


def test_without_rows_between_it_is_compact() -> None:
    target = interleaved(InterleavedSettings(rows=3, cols=2, reservoir_rows=0), SiteGrid(3, 2))
    assert target.fill.all()


def test_one_that_does_not_fit_is_refused() -> None:
    with pytest.raises(LimitError, match="31 rows x 16 columns"):
        interleaved(InterleavedSettings(rows=16, cols=16), SiteGrid(20, 20))
    with pytest.raises(ValidationError):
        InterleavedSettings(rows=0, cols=1)
