"""Plans and runs made visible: in words, in panels, and as pictures.

Importing this package imports no matplotlib; drawing a picture does.
"""

from labseq.drawing.batches import BatchSummary, lines_label, occupancies, on_grid, summarise_batches
from labseq.drawing.figure4 import ParallelismDrawing, save_parallelism
from labseq.drawing.figure5 import CyclesDrawing, save_cycles
from labseq.drawing.panels import MAX_PANELS, Panel, make_panels
from labseq.drawing.picture import PlanDrawing, check_picture, save_plan
from labseq.drawing.saving import ENDINGS, can_draw, check_place, encode_figure
from labseq.drawing.scaling import ComparisonDrawing, Curve, Histogram, save_comparison
from labseq.drawing.series import Series
from labseq.drawing.targets import draw_target, save_target, target_text
from labseq.drawing.waveform import WaveformDrawing, save_waveform

__all__ = [
    "ENDINGS",
    "MAX_PANELS",
    "BatchSummary",
    "ComparisonDrawing",
    "Curve",
    "CyclesDrawing",
    "Histogram",
    "Panel",
    "ParallelismDrawing",
    "PlanDrawing",
    "Series",
    "WaveformDrawing",
    "can_draw",
    "check_picture",
    "check_place",
    "draw_target",
    "encode_figure",
    "lines_label",
    "make_panels",
    "occupancies",
    "on_grid",
    "save_comparison",
    "save_cycles",
    "save_parallelism",
    "save_plan",
    "save_target",
    "save_waveform",
    "target_text",
    "summarise_batches",
]
