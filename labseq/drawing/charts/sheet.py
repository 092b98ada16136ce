"""A sheet of charts, in rows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

from labseq.drawing.saving import make_figure, save_figure
from labseq.drawing.series import plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI: Final = 150
PANEL_IN: Final = (3.7, 3.1)
"""Width and height of a panel where there are several, in inches."""
ALONE_IN: Final = (6.4, 4.4)
"""Those of a panel that is alone."""
HEAD_IN: Final = 0.55
"""Room for the title, in inches."""


class Chart(Protocol):
    """Paints itself into a panel."""

    def paint(self, axes: Axes) -> None:
        """Paint."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class RunDrawing:
    """What is drawn.

    Attributes:
        title: Stands at the top.
        note: Stands below it.
        rows: The charts, row by row; none of the rows is empty.
    """

    title: str
    note: str
    rows: tuple[tuple[Chart, ...], ...]


def save_run(path: Path, drawing: RunDrawing) -> None:
    """Draw charts of a run on a sheet.

    Args:
        path: The PNG, SVG or PDF file.
        drawing: What is drawn.

    Raises:
        ConfigError: The file cannot be written.
    """
    save_figure(path, lambda: _draw(drawing), dpi=DPI)


def _draw(drawing: RunDrawing) -> Figure:
    n_rows, n_cols = len(drawing.rows), max(map(len, drawing.rows))
    width, height = ALONE_IN if n_rows == n_cols == 1 else (n_cols * PANEL_IN[0], n_rows * PANEL_IN[1])
    figure = make_figure(width, height + HEAD_IN, layout="constrained")
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.08)  # pyright: ignore[reportOptionalMemberAccess, reportCallIssue]
    parts = figure.subfigures(n_rows, 1, squeeze=False)[:, 0]
    for part, charts in zip(parts, drawing.rows, strict=True):
        for axes, chart in zip(part.subplots(1, len(charts), squeeze=False)[0], charts, strict=True):
            chart.paint(axes)
    figure.suptitle(f"{plain(drawing.title)}\n{plain(drawing.note)}".rstrip(), fontsize=10)
    return figure
