"""Converts the shots of a run to a pandas table or an xarray dataset. Needs the extra ``analysis``."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.data.columns import columns_of
from labseq.data.points import reporting_damage
from labseq.data.reader import Run
from labseq.errors import ConfigError, Problem
from labseq.messages import install_hint
from labseq.plain import dumps

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

NO_IMAGE: Final = -1
"""Occupancy where an image or a shot is missing."""


def check_installed(*packages: str) -> None:
    """Raise if packages of the extra ``analysis`` are missing.

    Raises:
        ConfigError: A package is missing. The message says how to install it.
    """
    for package in packages:
        if find_spec(package) is None:
            problem = f"this needs {package}, which is not installed"
            raise ConfigError(Problem(problem, hint=install_hint("analysis")))


def facts_of(run: Run) -> dict[str, Any]:
    """The values that hold for the whole run, as plain Python values."""
    return {
        "run_id": str(run.record.get("run_id") or run.path.name),
        "name": run.name,
        "status": run.status,
        "error": run.error,
        "seed": str(run.seed),
        "simulated": int(run.simulated),
        "n_shots": run.n_shots,
        "t_start_utc": str(run.record.get("t_start_utc") or ""),
        "creator": str(run.record.get("creator") or ""),
    }


def dataframe_of(run: Run, *, attempts: bool = False) -> pd.DataFrame:
    """See :meth:`labseq.data.Run.to_dataframe`."""
    check_installed("pandas")
    import pandas as pd

    shots = sorted((*run.shots, *run.attempts), key=lambda s: (s.index, s.attempt)) if attempts else run.shots
    columns = columns_of(run, shots)
    frame = pd.DataFrame({column.name: column.values for column in columns}).set_index("shot")
    frame.attrs.update(facts_of(run))
    frame.attrs["units"] = {column.name: column.units for column in columns}
    frame.attrs["descriptions"] = {column.name: column.description for column in columns}
    return frame


def dataset_of(run: Run, *, occupancies: bool = True) -> xr.Dataset:
    """See :meth:`labseq.data.Run.to_xarray`."""
    check_installed("xarray")
    import xarray as xr

    grid = _grid_of(run)
    axis = "shot" if grid is None else "place"
    data: dict[str, Any] = {
        column.name: (axis, column.values, {"units": column.units, "description": column.description})
        for column in columns_of(run)
    }
    if occupancies:
        meaning = f"1 where the detector saw an atom, 0 where it saw none, {NO_IMAGE} where there is no image"
        attributes = {"units": "", "description": meaning}
        names, stack = _occupancies(run)
        data["occupancy"] = ((axis, "image", "row", "col"), stack, attributes)
        data["image"] = ("image", np.array(names, object), {"units": "", "description": "name of the image"})
    dataset = xr.Dataset(data) if grid is None else _on_grid(xr.Dataset(data), grid)
    for name, meaning in (("fill", "hold an atom"), ("clear", "be empty")):
        attributes = {"units": "", "description": f"1 where the target must {meaning}"}
        dataset[f"target_{name}"] = (("row", "col"), getattr(run.target, name).astype(np.int8), attributes)
    return dataset.assign_attrs(facts_of(run))


def _occupancies(run: Run) -> tuple[list[str], NDArray[np.int8]]:
    """The names of all images in the order of a shot, and the occupancies on each."""
    from labseq.recording.shot_file import read_occupancies

    shots = [read_occupancies(shot.file) for shot in run.shots]
    # shots may have different numbers of cycles, so this collects all images of all shots, by step and cycle
    all_images = dict.fromkeys(image for images, _ in shots for image in images)
    names = [name for *_, name in sorted(all_images, key=itemgetter(0, 1))]
    stack = np.full((len(shots), len(names), *run.target.shape), NO_IMAGE, np.int8)
    for shot_stack, (images, occupancies) in zip(stack, shots, strict=True):
        shot_stack[[names.index(name) for *_, name in images]] = occupancies
    return names, stack


@dataclass(frozen=True, slots=True, eq=False)
class _Grid:
    """The axes of a scan as a grid.

    Attributes:
        dims: The scanned addresses and "repeat", or "point" and "repeat" if the scan is not a product of
            its addresses.
        shape: Length of each axis.
        places: Indices of each shot along the axes.
        coords: Scanned address -> its axis, and its values there.
    """

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    places: list[tuple[int, ...]]
    coords: Mapping[str, tuple[str, NDArray[Any]]]


def _on_grid(shots: xr.Dataset, grid: _Grid) -> xr.Dataset:
    """Spread the axis "place" over the axes of a scan. nan or "" where there is no shot."""
    import pandas as pd
    import xarray as xr

    attributes = {name: shots[name].attrs for name in grid.coords if name in shots}
    columns = shots.drop_vars([*attributes])
    if len(grid.places) < math.prod(grid.shape):  # nan needs a float
        counts = [str(name) for name in columns if name != "occupancy" and columns[name].dtype.kind in "bi"]
        columns = columns.assign({name: columns[name].astype(np.float64) for name in counts})
    # integers and booleans need no fill value: either they are floats now, or there is a shot at every place
    missing_of_kind: Mapping[str, Any] = {"O": "", "f": np.nan, "i": 0, "b": False}
    missing = {name: missing_of_kind[columns[name].dtype.kind] for name in columns}
    missing |= {"occupancy": NO_IMAGE} if "occupancy" in columns else {}
    places = pd.MultiIndex.from_tuples(grid.places, names=grid.dims)
    spread = columns.assign_coords(xr.Coordinates.from_pandas_multiindex(places, "place")).unstack(
        "place", fill_value=missing
    )
    axes = dict(zip(grid.dims, map(range, grid.shape), strict=True))
    spread = spread.reindex(axes, fill_value=missing).transpose(*grid.dims, ...).drop_vars(grid.dims)
    coords = {name: (axis, values, attributes.get(name, {})) for name, (axis, values) in grid.coords.items()}
    return spread.assign_coords(coords)


def _grid_of(run: Run) -> _Grid | None:
    """The axes of a run's scan. None without a scan.

    Raises:
        RecordingError: The scan's record in run.json is damaged.
    """
    scan: Mapping[str, Any] = run.scan
    if not scan:
        return None
    with reporting_damage(run.path):
        points = [int(scan["point_of_shot"][shot.index]) for shot in run.shots]
        return _grid(list(scan["addresses"]), [list(values) for values in scan["points"]], points)


def _grid(addresses: list[str], points: list[list[Any]], point_of_shot: list[int]) -> _Grid:
    counts: Counter[int] = Counter()
    repeats: list[int] = []
    for point in point_of_shot:
        repeats.append(counts[point])
        counts[point] += 1
    axes = [dict(zip(map(dumps, values), values, strict=True)) for values in zip(*points, strict=True)]
    keys = [tuple(map(dumps, point)) for point in points]
    # a list of points that contains each combination once is a grid, too
    is_product = math.prod(map(len, axes)) == len(points) == len(set(keys))
    if is_product:
        dims, shape = tuple(addresses), tuple(map(len, axes))
        place_of_point = [
            tuple(list(axis).index(k) for axis, k in zip(axes, key, strict=True)) for key in keys
        ]
        along = [tuple(axis.values()) for axis in axes]
    else:
        dims, shape = ("point",), (len(points),)
        place_of_point = [(number,) for number in range(len(points))]
        along = list(zip(*points, strict=True))
    axis_of = dims if is_product else ["point"] * len(addresses)
    coords = {
        name: (axis, _values(values)) for name, axis, values in zip(addresses, axis_of, along, strict=True)
    }
    places = [(*place_of_point[point], repeat) for point, repeat in zip(point_of_shot, repeats, strict=True)]
    return _Grid((*dims, "repeat"), (*shape, max(counts.values(), default=0)), places, coords)


def _values(values: Sequence[Any]) -> NDArray[Any]:
    """The values along an axis, as numbers if possible, else as text."""
    if all(type(value) in (int, float) for value in values):
        return np.array(values)
    return np.array([value if isinstance(value, str) else dumps(value) for value in values], object)
