"""What came of a run, as charts on a sheet.

Each chart knows how to paint itself into a panel; importing them imports no matplotlib.
"""

from labseq.drawing.charts.bars import LossCausesChart, DefectsChart
from labseq.drawing.charts.course import TrendChart
from labseq.drawing.charts.curves import CurvesChart
from labseq.drawing.charts.maps import MapChart
from labseq.drawing.charts.sheet import Chart, RunDrawing, save_run
from labseq.drawing.charts.sites import SitesChart
from labseq.drawing.charts.stages import StageBar, StagesChart

__all__ = [
    "LossCausesChart",
    "Chart",
    "TrendChart",
    "CurvesChart",
    "DefectsChart",
    "MapChart",
    "RunDrawing",
    "SitesChart",
    "StageBar",
    "StagesChart",
    "save_run",
]
