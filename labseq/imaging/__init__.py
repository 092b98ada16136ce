"""From a frame to an occupancy."""

from labseq.imaging.averaging import FrameAverage
from labseq.imaging.drift import Shift, measure_shift
from labseq.imaging.known_sites import KnownSites
from labseq.imaging.lattice import FoundLattice, find_lattice
from labseq.imaging.peaks import FittedThresholds, fit_thresholds
from labseq.imaging.sites import site_pixels
from labseq.imaging.threshold import ThresholdDetector, ThresholdLike
from labseq.imaging.weighted import WeightedDetector, WeightedLike

__all__ = [
    "FittedThresholds",
    "FoundLattice",
    "FrameAverage",
    "KnownSites",
    "Shift",
    "ThresholdDetector",
    "ThresholdLike",
    "WeightedDetector",
    "WeightedLike",
    "find_lattice",
    "fit_thresholds",
    "measure_shift",
    "site_pixels",
]
