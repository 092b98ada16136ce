"""How all charts look."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from labseq.drawing.series import plain, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colorbar import Colorbar

TITLE_PT: Final = 9
LABEL_PT: Final = 9
TICK_PT: Final = 8
KEY_PT: Final = 8

COLOURS: Final = "cividis"
"""Colour map of fractions: rises evenly in lightness, for every kind of colour vision and in print."""
NOTHING: Final = "0.94"
"""Of cells without a value."""


def label(axes: Axes, title: str, x: str, y: str) -> None:
    """Name a panel and its axes.

    Args:
        axes: The panel.
        title: What stands above it.
        x: What the x axis shows, with its unit.
        y: What the y axis shows, with its unit.
    """
    tidy(axes)
    axes.set_title(plain(title), fontsize=TITLE_PT, loc="left")
    axes.set_xlabel(plain(x), fontsize=LABEL_PT)
    axes.set_ylabel(plain(y), fontsize=LABEL_PT)
    axes.tick_params(labelsize=TICK_PT)


def count_along(axes: Axes, *, x: bool = True) -> None:
    """Let an axis tick at whole numbers only."""
    from matplotlib.ticker import MaxNLocator

    axis = axes.xaxis if x else axes.yaxis
    axis.set_major_locator(MaxNLocator(nbins=6, integer=True, min_n_ticks=1))


def finish_bar(bar: Colorbar, text: str) -> None:
    """Name a colour bar."""
    bar.set_label(plain(text), fontsize=LABEL_PT)
    bar.ax.tick_params(labelsize=TICK_PT, width=0.7)
    bar.outline.set_linewidth(0.5)  # pyright: ignore[reportCallIssue, reportUnknownMemberType]
