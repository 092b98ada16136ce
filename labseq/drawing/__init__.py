"""Plans made visible: in words, in panels, and as a picture.

Importing this package imports no matplotlib; drawing a picture does.
"""

from labseq.drawing.batches import BatchStory, line_words, occupancies, on_grid, tell_batches
from labseq.drawing.panels import MAX_PANELS, Panel, make_panels
from labseq.drawing.picture import PlanDrawing, check_picture, save_plan
from labseq.drawing.scaling import ComparisonDrawing, Curve, Histogram, save_comparison
from labseq.drawing.targets import draw_target, save_target, target_text
from labseq.drawing.waveform import WaveformDrawing, save_waveform

__all__ = [
    "MAX_PANELS",
    "BatchStory",
    "ComparisonDrawing",
    "Curve",
    "Histogram",
    "Panel",
    "PlanDrawing",
    "WaveformDrawing",
    "check_picture",
    "draw_target",
    "line_words",
    "make_panels",
    "occupancies",
    "on_grid",
    "save_comparison",
    "save_plan",
    "save_target",
    "save_waveform",
    "target_text",
    "tell_batches",
]
