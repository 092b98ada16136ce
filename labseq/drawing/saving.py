"""Pictures into files; the only place that talks to matplotlib's canvas."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from labseq.errors import ConfigError, Problem
from labseq.files import whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure


ENDINGS: Final = (".png", ".svg", ".pdf")
"""Kinds of pictures."""
_UNDATED: Final = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}


def check_place(path: Path, endings: Sequence[str] = ENDINGS) -> None:
    """Find out whether a picture can be drawn and where it is to go, before anything is worked out.

    Args:
        path: The file.
        endings: Those that its name may have.

    Raises:
        ConfigError: The file has another ending, its folder does not exist, or matplotlib is not installed.
    """
    name, wanted = str(path), f"a file that ends in {' or '.join(endings)}"
    if path.suffix.lower() not in endings:
        what = f"this is no name of a {' or '.join(ending[1:].upper() for ending in endings)} file"
        raise ConfigError(Problem(what, name, expected=wanted))
    try:
        has_folder, is_folder = path.parent.is_dir(), path.is_dir()
        is_odd = path.exists() and not path.is_file()
    except OSError as error:  # a name that is too long
        raise ConfigError(Problem(f"this is no name of a file: {error.strerror}", name)) from error
    if not has_folder:
        raise ConfigError(Problem("there is no such folder", str(path.parent), expected="one that exists"))
    if is_odd:
        what = "this is a folder" if is_folder else "this is not an ordinary file"
        raise ConfigError(Problem(what, name, expected=wanted))
    if not can_draw():
        what = "drawing a picture needs matplotlib, which is not installed"
        raise ConfigError(Problem(what, hint="pip install 'labseq[plot]'"))


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


def encode_figure(draw: Callable[[], Figure], kind: str = ".png", **options: Any) -> bytes:
    """Draw a picture, whatever the user's matplotlibrc says: the same picture, the same bytes.

    Args:
        draw: Makes the figure.
        kind: One of :data:`ENDINGS`.
        options: Of matplotlib's ``savefig``.
    """
    from matplotlib import style

    with style.context(["default", {"svg.hashsalt": "labseq"}]):
        data = io.BytesIO()
        options.setdefault("metadata", _UNDATED[kind])
        draw().savefig(data, format=kind[1:], **options)
    return data.getvalue()


def can_draw() -> bool:
    """Whether matplotlib is installed."""
    return find_spec("matplotlib") is not None


def save_figure(path: Path, draw: Callable[[], Figure], **options: Any) -> None:
    """Draw a picture and save it, whatever the user's matplotlibrc says.

    The file is there whole or not at all, and an older one stays until then.

    Args:
        path: The file; its ending says of which kind it is, PNG where that is none of them.
        draw: Makes the figure.
        options: Of matplotlib's ``savefig``.

    Raises:
        ConfigError: The file cannot be written.
    """
    ending = path.suffix.lower()
    data = encode_figure(draw, ending if ending in ENDINGS else ".png", **options)
    try:
        with whole_file(path) as file:
            file.write(data)
    except OSError as error:
        problem = Problem(f"the picture cannot be written: {error.strerror or error}", str(path))
        raise ConfigError(problem) from error
