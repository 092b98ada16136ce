"""Records of a tone, a site and an atom, for the kernels of the transport.

A class lists the columns of an array, and :func:`record` makes the array's dtype from it. ``site.depth`` then
reads a column, also in compiled code. To add a column, add a line to its class.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple, get_type_hints

import numpy as np
from numpy.typing import ArrayLike

Dtype = np.dtype[Any]

FATES: Final = ("kept", "hand_over", "transport", "collision", "ejected", "program")
"""Fates of an atom that a mobile tweezer held. It is kept, or lost by one of these causes."""

NUMBERS: Final[dict[Any, Any]] = {float: np.float64, int: np.int64, bool: np.bool_}


def record(columns: type) -> Dtype:
    """The dtype of an array with a column for each number of a class."""
    numbers = [(name, NUMBERS[kind]) for name, kind in get_type_hints(columns).items()]
    return np.dtype((np.record, np.dtype(numbers, align=True)))


def signature(dtype: Dtype) -> str:
    """The type of a record in numba's notation, for the signature of a kernel that Python calls."""
    columns: list[str] = []
    for name, (kind, offset, *_) in (dtype.fields or {}).items():
        number = "boolean" if kind == np.bool_ else kind.name
        columns.append(f"('{name}', {{'type': {number}, 'offset': {offset}}})")
    return f"Record([{', '.join(columns)}], {dtype.itemsize}, {dtype.isalignedstruct})"


class Tone:
    """A tone in a segment.

    Attributes:
        start: Initial position, in sites.
        end: Final position, in sites.
        power_start: Initial power, relative to the intended power.
        power_end: Final power, relative to the intended power.
    """

    start: float
    end: float
    power_start: float
    power_end: float


class Site:
    """A site and its atom.

    Attributes:
        atom: Whether the site holds an atom.
        depth: Depth of the static tweezer per mass, in m^2/s^2.
        heat: Temperature of the atom, converted to the nominal depth.
        since_s: Time at which the temperature was valid.
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
    """The plane of the sites, as numbers, because compiled code counts references to arrays.

    Attributes:
        x: x of site (0, 0), in metres.
        y: y of site (0, 0).
        x_row: x step from row to row, in metres.
        y_row: y step from row to row.
        x_col: x step from column to column.
        y_col: y step from column to column.
        row_x: Rows per metre along x. With the next three the inverse of the steps.
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
    """The numbers of :class:`Plane`, from the first site's position and the steps between sites.

    Args:
        corner_m: Place of site (0, 0), (2,).
        down_m: Step from row to row, (2,).
        right_m: Step from column to column, (2,).
    """
    inverse = np.linalg.inv(np.stack([down_m, right_m], axis=1))
    return tuple(np.concatenate([corner_m, down_m, right_m, inverse.ravel()]).tolist())
