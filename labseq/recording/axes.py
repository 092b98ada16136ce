"""Where each shot of a run stands on the axes of its scan."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labseq.errors import RecordingError
from labseq.recording.folders import RUN_FILE
from labseq.recording.plain import dumps
from labseq.recording.reader import Run


@dataclass(frozen=True, slots=True, eq=False)
class Axes:
    """The axes that the shots of a run make a grid on.

    Attributes:
        dims: Names of the axes: "shot"; or the scanned addresses and "repeat"; or "point" and
            "repeat" where the scan is no product of its addresses.
        shape: Length of each.
        places: int64 (n_shots,), place of each shot that counts in the flattened grid.
        coords: Name -> the axes that it runs along, and its values.
    """

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    places: NDArray[np.int64]
    coords: Mapping[str, tuple[tuple[str, ...], NDArray[Any]]]

    def spread(self, values: NDArray[Any]) -> NDArray[Any]:
        """Put one value of each shot on the grid; nan, or "" for texts, where there is no shot."""
        n_places = math.prod(self.shape)
        if values.dtype == object:
            flat: NDArray[Any] = np.full(n_places, "", object)
        elif len(values) == n_places:
            flat = np.empty(n_places, values.dtype)
        else:
            flat = np.full(n_places, np.nan)
        flat[self.places] = values
        return flat.reshape(self.shape)


def axes_of(run: Run) -> Axes:
    """The axes of a run's scan, or that of its shots without one.

    Raises:
        RecordingError: What run.json says of the scan is damaged.
    """
    scan: Mapping[str, Any] = run.scan
    indices = np.array([shot.index for shot in run.shots], np.int64)
    if not scan:
        n = len(indices)
        return Axes(("shot",), (n,), np.arange(n), {"shot": (("shot",), indices)})
    try:
        points = [int(scan["point_of_shot"][index]) for index in indices]
        return _of_scan(list(scan["addresses"]), [list(values) for values in scan["points"]], points)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        reason = f"has a damaged scan: {error!r}; take it from a backup"
        raise RecordingError(run.path / RUN_FILE, reason) from error


def _of_scan(addresses: list[str], points: list[list[Any]], point_of_shot: list[int]) -> Axes:
    counts: Counter[int] = Counter()
    repeats: list[int] = []
    for point in point_of_shot:
        repeats.append(counts[point])
        counts[point] += 1
    n_repeats = max(counts.values(), default=0)
    grid = _grid(points, len(addresses))
    if grid is None:
        dims, shape = ("point",), (len(points),)
        place_of_point = np.arange(len(points))
        columns = list(zip(*points, strict=True))
        coords = {name: (dims, _values(column)) for name, column in zip(addresses, columns, strict=True)}
    else:
        values, place_of_point = grid
        dims, shape = tuple(addresses), tuple(map(len, values))
        coords = {name: ((name,), _values(axis)) for name, axis in zip(addresses, values, strict=True)}
    places = np.array([place_of_point[point] for point in point_of_shot], np.int64) * n_repeats
    return Axes((*dims, "repeat"), (*shape, n_repeats), places + np.array(repeats, np.int64), coords)


def _grid(points: list[list[Any]], n_axes: int) -> tuple[list[list[Any]], NDArray[np.int64]] | None:
    """The values of each axis and the place of each point, if the points are the product of the axes."""
    keys = [[dumps(value) for value in point] for point in points]
    axes = [list(dict.fromkeys(point[axis] for point in keys)) for axis in range(n_axes)]
    shape = tuple(map(len, axes))
    if math.prod(shape) != len(points) or len({*map(tuple, keys)}) != len(points):
        return None
    found = {
        key: value
        for point, names in zip(points, keys, strict=True)
        for key, value in zip(names, point, strict=True)
    }
    indices = [[axis.index(key) for axis, key in zip(axes, point, strict=True)] for point in keys]
    places = np.array([np.ravel_multi_index(index, shape) for index in indices], np.int64)
    return [[found[key] for key in axis] for axis in axes], places


def _values(values: Sequence[Any]) -> NDArray[Any]:
    """The values along an axis: numbers, else text."""
    if all(type(value) in (int, float) for value in values):
        return np.array(values)
    return np.array([value if isinstance(value, str) else dumps(value) for value in values], object)
