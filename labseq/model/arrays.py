"""Array helpers shared by the domain types."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import DTypeLike, NDArray

Occupancy: TypeAlias = NDArray[np.bool_]
"""bool (n_rows, n_cols), C-contiguous, indexed [row, col], row 0 at the top of the image."""


def read_only(values: Any, dtype: DTypeLike, shape: tuple[int, ...], name: str) -> NDArray[Any]:
    """Make a read-only, C-contiguous array of a given dtype and shape.

    A read-only array that already fits is returned as it is; anything else is
    copied, so that the caller's array is neither frozen nor shared.

    Args:
        values: Array or nested sequence.
        dtype: Wanted dtype; the conversion must not lose values.
        shape: Wanted shape, where -1 stands for any length.
        name: Field name for the error message.

    Raises:
        ValueError: Wrong number of dimensions, wrong shape, or values that the
            dtype cannot hold.
    """
    wanted = np.dtype(dtype)
    array: NDArray[Any] = np.asarray(values)
    if array.dtype == wanted and (array.shape == shape or _fits(array.shape, shape)):
        flags = array.flags
        if not flags.writeable and flags.c_contiguous:
            return array
    if array.dtype != wanted:
        if array.size == 0:
            array = array.astype(wanted)
        else:
            converted = array.astype(wanted)
            if not np.array_equal(converted, array):
                raise ValueError(f"{name} holds values that {wanted} cannot represent")
            array = converted
    if array.size == 0 and 0 not in shape and array.ndim != len(shape):
        array = array.reshape(tuple(0 if n == -1 else n for n in shape))
    if not _fits(array.shape, shape):
        wanted_text = "(" + ", ".join("n" if n == -1 else str(n) for n in shape) + ")"
        raise ValueError(f"{name} has shape {array.shape}; expected {wanted_text}")
    if array.flags.writeable or not array.flags.c_contiguous:
        array = np.array(array, dtype=wanted, order="C", copy=True)
        array.flags.writeable = False
    return array


def _fits(shape: tuple[int, ...], wanted: tuple[int, ...]) -> bool:
    if len(shape) != len(wanted):
        return False
    for have, want in zip(shape, wanted, strict=True):  # noqa: SIM110 - all() takes three times as long
        if want not in (-1, have):
            return False
    return True


def as_occupancy(values: Any, shape: tuple[int, int] | None = None) -> Occupancy:
    """Read any array of zeros and ones as an occupancy.

    Args:
        values: Array or nested sequence of bool, 0 or 1, of shape (n_rows, n_cols).
        shape: The grid's (n_rows, n_cols), if it is known.

    Returns:
        A C-contiguous bool array; the caller's own if it already is one.

    Raises:
        ValueError: Not two-dimensional, of another shape, or other values than 0 and 1.

    Example:
        >>> as_occupancy([[1, 0], [0, 1]]).sum()
        np.int64(2)
    """
    array = np.asarray(values)
    if array.ndim != 2 or array.size == 0:
        raise ValueError(f"an occupancy has shape (n_rows, n_cols); this one has {array.shape}")
    if shape is not None and array.shape != shape:
        raise ValueError(f"the occupancy has shape {array.shape}; the grid has {shape}")
    if array.dtype != np.bool_:
        as_bool = array.astype(np.bool_)
        if not np.array_equal(as_bool, array):
            raise ValueError("an occupancy holds only 0 and 1 (False and True)")
        array = as_bool
    return np.ascontiguousarray(array)
