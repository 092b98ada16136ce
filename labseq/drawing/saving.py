"""Pictures into files; the only place that talks to matplotlib's canvas."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from labseq.errors import ConfigError, Problem
from labseq.files import whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def make_figure(width_in: float, height_in: float, **options: Any) -> Figure:
    """Make a figure that needs no screen.

    Args:
        width_in: Width in inches.
        height_in: Height in inches.
        options: Of matplotlib's ``Figure``.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), **options)
    FigureCanvasAgg(figure)
    return figure


def save_figure(path: Path, draw: Callable[[], Figure], **options: Any) -> None:
    """Draw a picture and save it as PNG, whatever the user's matplotlibrc says.

    The file is there whole or not at all, and an older one stays until then.

    Args:
        path: The file.
        draw: Makes the figure.
        options: Of matplotlib's ``savefig``.

    Raises:
        ConfigError: The file cannot be written.
    """
    from matplotlib import style

    with style.context("default"):
        data = io.BytesIO()
        draw().savefig(data, format="png", **options)
    try:
        with whole_file(path) as file:
            file.write(data.getbuffer())
    except OSError as error:
        problem = Problem(f"the picture cannot be written: {error.strerror or error}", str(path))
        raise ConfigError(problem) from error
