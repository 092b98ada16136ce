"""Records: what the kernels of the transport know of a tone, of a site, and of an atom.

A class lists the columns of an array, and :func:`record` makes the array's dtype of it. ``site.depth`` then
reads a column, in compiled code too. To add a column, add a line to its class.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple, get_type_hints

import numpy as np
from numpy.typing import ArrayLike

Dtype = np.dtype[Any]

FATES: Final = ("kept", "hand_over", "transport", "collision", "ejected", "program")
"""What may become of an atom that a mobile tweezer held: kept, or lost by one of these causes."""

NUMBERS: Final[dict[Any, Any]] = {float: np.float64, int: np.int64, bool: np.bool_}


def record(columns: type) -> Dtype:
    """The dtype of an array with a column for each number of a class."""
    numbers = [(name, NUMBERS[kind]) for name, kind in get_type_hints(columns).items()]
    return np.dtype((np.record, np.dtype(numbers, align=True)))


def signature(dtype: Dtype) -> str:
    """The type of a record as numba writes it, for the signature of a kernel that Python calls."""
    columns: list[str] = []
    for name, (kind, offset, *_) in (dtype.fields or {}).items():
        number = "boolean" if kind == np.bool_ else kind.name
        columns.append(f"('{name}', {{'type': {number}, 'offset': {offset}}})")
    return f"Record([{', '.join(columns)}], {dtype.itemsize}, {dtype.isalignedstruct})"


class Tone:
    """A tone in a segment.

    Attributes:
        start: Its position at the start, in sites.
        end: At the end.
        power_start: Its power at the start, relative to the intended one.
        power_end: At the end.
    """

    start: float
    end: float
    power_start: float
    power_end: float


class Site:
    """A site and its atom.

    Attributes:
        atom: Whether there is one.
        depth: Depth of the static tweezer per mass, in m^2/s^2.
        heat: Temperature of the atom, as it would be at the nominal depth.
        since_s: The time that the temperature belongs to.
    """

    atom: bool
    depth: float
    heat: float
    since_s: float


class Atom:
    """Position and velocity of an atom, in m and m/s."""

    x: float
    y: float
    z: float
    vx: float
    vy: float
    vz: float


TONE: Final = record(Tone)
SITE: Final = record(Site)
ATOM: Final = record(Atom)


class Plane(NamedTuple):
    """The plane of the sites. Numbers, as compiled code counts the references to an array that it passes on.

    Attributes:
        x: Position of site (0, 0), in metres.
        y: Likewise.
        x_row: Step from row to row, in metres.
        y_row: Likewise.
        x_col: Step from column to column.
        y_col: Likewise.
        row_x: Rows per metre along x; with the next three the inverse of the steps.
        row_y: Rows per metre along y.
        col_x: Columns per metre along x.
        col_y: Columns per metre along y.
    """

    x: float
    y: float
    x_row: float
    y_row: float
    x_col: float
    y_col: float
    row_x: float
    row_y: float
    col_x: float
    col_y: float


def plane_of(corner_m: ArrayLike, down_m: ArrayLike, right_m: ArrayLike) -> tuple[float, ...]:
    """The numbers of :class:`Plane`, from where the first site is and the steps between sites.

    Args:
        corner_m: Place of site (0, 0), (2,).
        down_m: Step from row to row, (2,).
        right_m: Step from column to column, (2,).
    """
    inverse = np.linalg.inv(np.stack([down_m, right_m], axis=1))
    return tuple(np.concatenate([corner_m, down_m, right_m, inverse.ravel()]).tolist())
