"""From a frame to an occupancy."""

from labseq.imaging.sites import site_pixels
from labseq.imaging.threshold import ThresholdDetector, ThresholdLike

__all__ = ["ThresholdDetector", "ThresholdLike", "site_pixels"]
