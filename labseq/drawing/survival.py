"""How atoms survive a probe beside their sites, and where tones put their tweezers."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from labseq.drawing.saving import make_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

DIRECTIONS: Final = ("along a row", "from row to row")
ON_LINE_M: Final = 1e-9
POINT, CURVE = "#1b5e8c", "#c8102e"


def draw_survival(
    offset_m: Floats,
    n_before: NDArray[np.int64],
    n_survived: NDArray[np.int64],
    survival: Callable[[Floats], Floats],
) -> Figure:
    """Draw survival against the offset on each axis.

    Args:
        offset_m: float64 (n_points, 2), commanded offsets along a1 and a2.
        n_before: int64 (n_points,), atoms that were probed.
        n_survived: int64 (n_points,), how many of them survived.
        survival: What was fitted: offsets (n, 2) -> probabilities (n,).
    """
    figure = make_figure(8.0, 4.0, layout="constrained")
    middle = np.median(offset_m, axis=0)
    for axis, axes in enumerate(figure.subplots(1, 2, sharey=True)):
        on_line = np.abs(offset_m[:, 1 - axis] - middle[1 - axis]) < ON_LINE_M
        x_m, n, k = offset_m[on_line, axis], np.maximum(n_before[on_line], 1), n_survived[on_line]
        error = np.sqrt((k + 0.5) * (n - k + 0.5) / (n + 1)) / (n + 1)
        axes.errorbar(1e6 * x_m, k / n, error, fmt="o", color=POINT, markersize=4, label="atoms")
        line_m = np.repeat(middle[None], 200, axis=0)
        line_m[:, axis] = np.linspace(offset_m[:, axis].min(), offset_m[:, axis].max(), 200)
        axes.plot(1e6 * line_m[:, axis], survival(line_m), color=CURVE, label="fit")
        axes.set_xlabel(f"offset {DIRECTIONS[axis]} (um)")
        axes.set_ylim(-0.02, 1.02)
    figure.axes[0].set_ylabel("survival")
    figure.axes[0].legend(fontsize="small")
    return figure


def draw_tone_offsets(rows: tuple[Floats, Floats], columns: tuple[Floats, Floats]) -> Figure:
    """Draw how far the tweezers of each row and column stood beside their sites.

    Args:
        rows: Offset from row to row and its standard error, each float64 (n_rows,), in metres.
        columns: Offset along a row and its standard error, each float64 (n_cols,).
    """
    figure = make_figure(8.0, 4.0, layout="constrained")
    for axes, name, (off_m, error_m), direction in zip(
        figure.subplots(1, 2), ("row", "column"), (rows, columns), reversed(DIRECTIONS), strict=True
    ):
        axes.errorbar(np.arange(len(off_m)), 1e9 * off_m, 1e9 * error_m, fmt="o", color=POINT, markersize=4)
        axes.set_xlabel(name)
        axes.set_ylabel(f"offset {direction} (nm)")
    return figure
