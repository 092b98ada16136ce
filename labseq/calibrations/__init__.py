"""The store of calibrations: a folder of entries that never change, and a note of those in use."""

from labseq.calibrations.active import Activation
from labseq.calibrations.comparing import Difference, compare, unit_of
from labseq.calibrations.entry_file import encode_entry, read_entry
from labseq.calibrations.fitting import check_grid, grid_text
from labseq.calibrations.quality import DECIDING, QualityFigure, figure_of, why_worse
from labseq.calibrations.store import Damaged, Store, Stored

__all__ = [
    "DECIDING",
    "Activation",
    "Damaged",
    "QualityFigure",
    "Difference",
    "Store",
    "Stored",
    "check_grid",
    "compare",
    "encode_entry",
    "figure_of",
    "grid_text",
    "read_entry",
    "unit_of",
    "why_worse",
]
