"""From a frame to an occupancy."""

from labseq.imaging.sites import site_pixels
from labseq.imaging.threshold import ThresholdDetector, ThresholdLike
from labseq.imaging.weighted import WeightedDetector, WeightedLike

__all__ = ["ThresholdDetector", "ThresholdLike", "WeightedDetector", "WeightedLike", "site_pixels"]
