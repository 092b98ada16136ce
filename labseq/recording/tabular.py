"""A run as a pandas table and as an xarray dataset; both packages come with ``labseq[analysis]``."""

from __future__ import annotations

import math
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.errors import ConfigError, Problem
from labseq.recording.axes import Axes, axes_of
from labseq.recording.columns import columns_of
from labseq.recording.reader import Run

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

NO_IMAGE: Final = -1
"""What stands in occupancies where a shot has no such image, or no such shot was taken."""


def check_installed(*packages: str) -> None:
    """Refuse to go on without packages of the extra ``analysis``.

    Raises:
        ConfigError: One is missing; tells how to install it.
    """
    for package in packages:
        if find_spec(package) is None:
            what = f"this needs {package}, which is not installed"
            raise ConfigError(Problem(what, hint="pip install 'labseq[analysis]'"))


def dataframe_of(run: Run, *, attempts: bool = False) -> pd.DataFrame:
    """See :meth:`labseq.recording.Run.to_dataframe`."""
    check_installed("pandas")
    import pandas as pd

    shots = sorted((*run.shots, *run.attempts), key=lambda s: (s.index, s.attempt)) if attempts else run.shots
    columns = columns_of(run, shots)
    frame = pd.DataFrame({column.name: column.values for column in columns}).set_index("shot")
    frame.attrs.update(facts_of(run))
    frame.attrs["units"] = {column.name: column.units for column in columns}
    frame.attrs["descriptions"] = {column.name: column.description for column in columns}
    return frame


def facts_of(run: Run) -> dict[str, Any]:
    """What is true of the whole run, as plain values."""
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


def dataset_of(run: Run, *, occupancies: bool = True) -> xr.Dataset:
    """See :meth:`labseq.recording.Run.to_xarray`."""
    check_installed("xarray")
    import xarray as xr

    axes, columns = axes_of(run), columns_of(run)
    about = {column.name: {"units": column.units, "description": column.description} for column in columns}
    data: dict[str, Any] = {
        column.name: (axes.dims, axes.spread(column.values), about[column.name])
        for column in columns
        if column.name not in axes.coords
    }
    if occupancies:
        meaning = f"1 where the detector saw an atom, 0 where not, {NO_IMAGE} where there is no such image"
        dims = (*axes.dims, "image", "row", "col")
        data["occupancy"] = (dims, _occupancies(run, axes), {"units": "", "description": meaning})
    for name, sites in (("fill", run.target.fill), ("clear", run.target.clear)):
        meaning = f"1 where the target must {'hold an atom' if name == 'fill' else 'be empty'}"
        data[f"target_{name}"] = (
            ("row", "col"),
            sites.astype(np.int8),
            {"units": "", "description": meaning},
        )
    coords = {name: (dims, values, about.get(name, {})) for name, (dims, values) in axes.coords.items()}
    return xr.Dataset(data, coords, facts_of(run))


def _occupancies(run: Run, axes: Axes) -> NDArray[np.int8]:
    from labseq.recording.shot_reader import read_occupancies  # h5py takes 0.1 s to import

    found = [read_occupancies(shot.file) for shot in run.shots]
    n_images = max(map(len, found), default=0)
    flat = np.full((math.prod(axes.shape), n_images, *run.target.shape), NO_IMAGE, np.int8)
    for place, occupancies in zip(axes.places, found, strict=True):
        flat[place, : len(occupancies)] = occupancies
    return flat.reshape(*axes.shape, *flat.shape[1:])
