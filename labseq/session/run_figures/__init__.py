"""Pictures of runs: what is shown, worked out from what was recorded.

``labseq.drawing`` paints them. Importing this package imports neither h5py nor matplotlib.
"""

from labseq.session.run_figures.overview import CHOICES, overview, picture_of
from labseq.session.run_figures.paper import (
    PAPERS_DEFECT_FREE,
    PAPERS_FILLING,
    PAPERS_LIFETIME_S,
    figure_4,
    figure_5,
)
from labseq.session.run_figures.sampling import A_LOOK, spread
from labseq.session.run_figures.shot import shot_picture
from labseq.session.run_figures.timing import RunTiming, StageStatistics, timing_of

__all__ = [
    "A_LOOK",
    "CHOICES",
    "PAPERS_DEFECT_FREE",
    "PAPERS_FILLING",
    "PAPERS_LIFETIME_S",
    "RunTiming",
    "StageStatistics",
    "figure_4",
    "figure_5",
    "overview",
    "picture_of",
    "shot_picture",
    "spread",
    "timing_of",
]
