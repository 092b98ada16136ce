"""Plans made visible: in words, in panels, and as a picture.

Importing this package imports no matplotlib; drawing a picture does.
"""

from labseq.drawing.batches import BatchStory, line_words, occupancies, tell_batches
from labseq.drawing.panels import MAX_PANELS, Panel, make_panels
from labseq.drawing.picture import check_picture

__all__ = [
    "MAX_PANELS",
    "BatchStory",
    "Panel",
    "check_picture",
    "line_words",
    "make_panels",
    "occupancies",
    "tell_batches",
]
