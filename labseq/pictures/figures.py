"""Matplotlib figures with common sizes and colours, saved whole."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.errors import ConfigError, Problem
from labseq.files import is_there, whole_file
from labseq.messages import install_hint
from labseq.model import SiteGrid

if TYPE_CHECKING:
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

ENDINGS: Final = (".png", ".svg", ".pdf")
"""File name endings of pictures."""
DARK, LIGHT, ORANGE, RED = "#1f4e8c", "#86b6e0", "#f28e2b", "#c8102e"
"""Colours of points and lines, of areas, of a second series, and of reference values."""


def check_place(path: Path, endings: Sequence[str] = ENDINGS, *, drawn: bool = True) -> None:
    """Check that a picture can be drawn and written, before any other work.

    Args:
        endings: Allowed endings of its name.
        drawn: True if matplotlib draws it.

    Raises:
        ConfigError: The name has another ending, its folder does not exist, or matplotlib is not installed.
    """
    name, wanted = str(path), f"a file that ends in {' or '.join(endings)}"
    if path.suffix.lower() not in endings:
        what = f"this is not the name of a {' or '.join(ending[1:].upper() for ending in endings)} file"
        raise ConfigError(Problem(what, name, expected=wanted))
    try:
        has_folder, is_folder = path.parent.is_dir(), path.is_dir()
        is_odd = is_there(path) and not path.is_file()
    except OSError as error:  # a name that is too long
        raise ConfigError(Problem(f"this is not the name of a file: {error.strerror}", name)) from error
    if not has_folder:
        raise ConfigError(Problem("there is no such folder", str(path.parent), expected="an existing folder"))
    if is_odd:
        what = "this is a folder" if is_folder else "this is not an ordinary file"
        raise ConfigError(Problem(what, name, expected=wanted))
    if drawn and not can_draw():
        what = "drawing a picture needs matplotlib, which is not installed"
        raise ConfigError(Problem(what, hint=install_hint("plot")))


def make_figure(width_in: float, height_in: float, **options: Any) -> Figure:
    """Make a figure of a size in inches that needs no screen, with the options of ``Figure``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), **options)
    FigureCanvasAgg(figure)
    return figure


def show_plain_numbers(axis: Axis) -> None:
    """Label a logarithmic axis with as many plain numbers as fit, instead of powers of ten."""
    from matplotlib.ticker import LogFormatter

    class PlainFormatter(LogFormatter):
        """Matplotlib's choice of ticks, with 0.01 instead of 1e-02."""

        def __call__(self, x: float, pos: int | None = None) -> str:
            return f"{x:g}" if super().__call__(x, pos) else ""

    axis.set_major_formatter(PlainFormatter())
    axis.set_minor_formatter(PlainFormatter(minor_thresholds=(2, 0.5)))


def encode_figure(draw: Callable[[], Figure], kind: str = ".png", **options: Any) -> bytes:
    """Draw a picture independently of the user's matplotlibrc. The same picture gives the same bytes."""
    from matplotlib import style

    # dates, versions and random ids in the file would make equal pictures differ
    undated = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    with style.context(["default", {"svg.hashsalt": "labseq", "text.parse_math": False}]):
        data = io.BytesIO()
        options.setdefault("metadata", undated[kind])
        draw().savefig(data, format=kind[1:], **options)
    return data.getvalue()


def can_draw() -> bool:
    """True if matplotlib is installed."""
    return find_spec("matplotlib") is not None


def save_figure(path: Path, draw: Callable[[], Figure], **options: Any) -> None:
    """Draw a picture independently of the user's matplotlibrc, and save it.

    The file appears when it is complete, and an older file stays until then.

    Args:
        path: The file. Its ending gives its kind, with PNG for other endings.

    Raises:
        ConfigError: The file cannot be written.
    """
    ending = path.suffix.lower()
    save_bytes(path, encode_figure(draw, ending if ending in ENDINGS else ".png", **options))


def save_bytes(path: Path, data: bytes) -> None:
    """Save an encoded picture as a whole.

    Raises:
        ConfigError: The file cannot be written.
    """
    try:
        with whole_file(path) as file:
            file.write(data)
    except OSError as error:
        problem = Problem(f"the picture cannot be written: {error.strerror or error}", str(path))
        raise ConfigError(problem) from error


Floats = NDArray[np.float64]

PANEL_IN: Final = 4.4
"""Width of a panel, in inches, unless its sites become too small or too large."""
SITE_IN: Final = (0.05, 0.3)
"""Least and largest distance between neighbours, in inches."""
MARGIN: Final = 1.4
"""Room around the outermost sites and landing places, in units of the spacing."""
TITLE_IN: Final = 0.3
"""Room above each panel for its title, in inches."""
HEAD_IN: Final = 0.9
"""Room at the top of the sheet for its title and key, in inches."""


@dataclass(frozen=True, slots=True)
class Extent:
    """A part of the lattice, in units of the spacing, y down the image."""

    left: float
    right: float
    top: float
    bottom: float

    @property
    def width(self) -> float:
        """Width of the area."""
        return self.right - self.left

    @property
    def height(self) -> float:
        """Height of the area."""
        return self.bottom - self.top


@dataclass(frozen=True, slots=True)
class Sheet:
    """A sheet of equal panels.

    Attributes:
        site_in: Distance between neighbours, in inches.
        extent: The part of the lattice that each panel shows.
    """

    n_cols: int
    n_rows: int
    site_in: float
    width_in: float
    height_in: float
    extent: Extent

    def place(self, index: int) -> tuple[float, float, float, float]:
        """Left, bottom, width and height of a panel, in fractions of the sheet."""
        row, col = divmod(index, self.n_cols)
        width, height = self.extent.width * self.site_in, self.extent.height * self.site_in
        aside = (self.width_in - self.n_cols * width) / 2
        left = aside + col * width
        below = self.height_in - HEAD_IN - (row + 1) * (height + TITLE_IN)
        across, up = self.width_in, self.height_in
        return left / across, below / up, width / across, height / up


def place_sites(sites: NDArray[np.generic], grid: SiteGrid) -> NDArray[np.float64]:
    """Positions of sites, on the grid or off it.

    Args:
        sites: (..., 2), row and column.

    Returns:
        float64 (..., 2), x and y in units of the spacing, from the site (0, 0), y down the image.

    Example:
        >>> place_sites(np.array([[0, 3], [2, -1]]), SiteGrid(lattice="square")).tolist()
        [[3.0, 0.0], [-1.0, 2.0]]
    """
    axes = grid.axes / grid.spacing_m
    return sites[..., 1:] * axes[0] + sites[..., :1] * axes[1]


def extent_of_sites(others: NDArray[np.integer], grid: SiteGrid) -> Extent:
    """The extent of all sites of the grid, and of other sites, int (n, 2), that may be outside it."""
    rows, cols = np.mgrid[: grid.n_rows : max(1, grid.n_rows - 1), : grid.n_cols : max(1, grid.n_cols - 1)]
    corners = np.stack([rows.ravel(), cols.ravel()], axis=1)
    places = place_sites(np.concatenate([corners, others]), grid)
    (left, top), (right, bottom) = places.min(axis=0) - MARGIN, places.max(axis=0) + MARGIN
    return Extent(float(left), float(right), float(top), float(bottom))


def plan_timelines(extent: Extent, n_panels: int, panel_in: float = PANEL_IN) -> Sheet:
    """Choose the size of the panels and how many are in a row.

    The sheet should be somewhat wider than high, with few empty places.

    Args:
        panel_in: Width of a panel, in inches, unless its sites become too small or too large.

    Example:
        >>> sheet = plan_timelines(Extent(-1, 11, -1, 11), 6)
        >>> sheet.n_cols, sheet.n_rows, sheet.site_in
        (3, 2, 0.3)
    """
    site_in = min(max(panel_in / extent.width, SITE_IN[0]), SITE_IN[1])
    width, height = extent.width * site_in, extent.height * site_in + TITLE_IN

    def size(n_cols: int) -> tuple[float, float]:
        return n_cols * width, math.ceil(n_panels / n_cols) * height + HEAD_IN

    def badness(n_cols: int) -> float:
        across, down = size(n_cols)
        return abs(math.log(across / down / 1.5)) + 1.5 * (-n_panels % n_cols) / n_panels

    n_cols = min(range(1, n_panels + 1), key=badness)
    across, down = size(n_cols)
    n_rows = math.ceil(n_panels / n_cols)
    min_width_in = 9.0  # for title and key
    return Sheet(n_cols, n_rows, site_in, max(across, min_width_in), down, extent)


POINTS_PER_INCH: Final = 72


@dataclass(frozen=True, slots=True)
class MarkerStyle:
    """A marker and how it is painted.

    Attributes:
        label: Its meaning, in the key.
        marker: matplotlib's name of the shape.
        size: Diameter, in units of the spacing.
        face: Colour inside, or "none" for a ring.
        edge: Colour of the rim.
    """

    label: str
    marker: str
    size: float
    face: str
    edge: str

    def keywords(self, site_in: float) -> dict[str, Any]:
        """Keywords for matplotlib, for a distance of neighbours in inches."""
        points = site_in * POINTS_PER_INCH
        return {
            "linestyle": "none",
            "marker": self.marker,
            "markersize": self.size * points,
            "markerfacecolor": self.face,
            "markeredgecolor": self.edge,
            "markeredgewidth": min(1.0, 0.07 * points),
        }


def neighbours(grid: SiteGrid) -> NDArray[np.int64]:
    """Steps to the nearest sites, in rows and columns, counter-clockwise as seen in a picture.

    Returns:
        int64 (n, 2), 6 steps on a triangular lattice and 4 on a square lattice.

    Example:
        >>> neighbours(SiteGrid(lattice="square")).tolist()
        [[-1, 0], [0, 1], [1, 0], [0, -1]]
    """
    steps = np.array([step for step in product((-1, 0, 1), repeat=2) if any(step)])
    x, y = place_sites(steps, grid).T
    near = np.hypot(x, y) < 1.01  # in units of the spacing, with room for rounding
    order = np.argsort(np.arctan2(y[near], x[near]), kind="stable")
    return steps[near][order]


def cell(grid: SiteGrid) -> Floats:
    """Corners of the cell around a site at the origin, float64 (n, 2), x and y in units of the spacing.

    Example:
        >>> cell(SiteGrid(lattice="square")).tolist()
        [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]
    """
    return _edges(grid)[:, 0]


def outline(sites: NDArray[np.bool_], grid: SiteGrid) -> Floats:
    """The border around some sites, bool (n_rows, n_cols).

    Returns:
        float64 (n, 2, 2), start and end (x, y) of each stretch, in units of the spacing.

    Example:
        >>> len(outline(np.array([[True, True]]), SiteGrid(1, 2)))
        10
    """
    padded = np.pad(sites, 1)
    stretches: list[Floats] = []
    for (row, col), edge in zip(neighbours(grid), _edges(grid), strict=True):
        neighbour = np.roll(padded, (-row, -col), axis=(0, 1))[1:-1, 1:-1]
        at_border = np.argwhere(sites & ~neighbour)
        stretches.append(place_sites(at_border, grid)[:, None] + edge)
    return np.concatenate(stretches)


def _edges(grid: SiteGrid) -> Floats:
    """The edge of a cell towards each neighbour, float64 (n, 2, 2). Each starts where the last ends."""
    to = place_sites(neighbours(grid), grid)
    aside = np.stack([-to[:, 1], to[:, 0]], axis=1)
    half = np.tan(np.pi / len(to)) / 2
    edges: Floats = np.stack([to / 2 - half * aside, to / 2 + half * aside], axis=1)
    return edges.round(12)
