"""Benchmark: from a frame of 512 x 512 pixels to the occupancy of 400 sites. Goal: under 100 us.

How many errors are made: ``tests/detection/test_fidelity.py``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq.detection.weighted import WeightedDetector, WeightedSettings
from labseq.plugin import Context, Frame, SiteGrid


@pytest.fixture
def frame() -> Frame:
    return Frame(np.random.default_rng(0).poisson(530, (512, 512)).astype(np.uint16), 45e-3, 0.0)


@pytest.mark.parametrize("region", [5, 7])
def test_threshold(benchmark: Any, frame: Frame, region: int) -> None:
    detector = ThresholdDetector(ThresholdSettings(region=region), Context("detector"))
    occupancy, *_ = benchmark(detector.detect, frame)
    assert occupancy.shape == (20, 20)


@pytest.mark.parametrize("region", [7, 9, 11])
@pytest.mark.parametrize(("spacing", "spot"), [(4.49e-6, 0.42e-6), (2.5e-6, 0.525e-6)])
def test_weighted(benchmark: Any, frame: Frame, region: int, spacing: float, spot: float) -> None:
    grid = SiteGrid(spacing_m=spacing)
    detector = WeightedDetector(WeightedSettings(region=region, spot=spot), Context("detector", grid))
    detector.warm()
    occupancy, *_ = benchmark(detector.detect, frame)
    assert occupancy.shape == (20, 20)


def test_warming_the_weights(benchmark: Any) -> None:
    """At the start of a run, not in a shot."""

    def warm() -> WeightedDetector:
        detector = WeightedDetector(WeightedSettings(), Context("detector"))
        detector.warm()
        return detector

    assert benchmark(warm) is not None
