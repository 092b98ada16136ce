"""Pictures into files; the only place that talks to matplotlib's canvas."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from labseq.errors import ConfigError, Problem

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
    real = Path(os.path.realpath(path))
    part = real.with_name(f"{real.name}.part")
    try:
        part.write_bytes(data.getbuffer())
        part.replace(real)
    except OSError as error:
        problem = Problem(f"the picture cannot be written: {error.strerror or error}", str(path))
        raise ConfigError(problem) from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
