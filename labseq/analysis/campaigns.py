"""The runs of a campaign together: one file, one picture, and the results at each point."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from labseq.analysis.overview import RunPicture, scan_panels
from labseq.analysis.scanned import title_of, value_text
from labseq.campaigns.campaign import CAMPAIGN_FILE, Campaign, Point, recorded_runs
from labseq.console.output import say
from labseq.console.text import plural
from labseq.data.columns import quantities_in
from labseq.data.points import ScanPoint
from labseq.data.quantities import WITH_TARGET, Quantity, description_of, measured_by
from labseq.data.reader import Run
from labseq.data.scanned import Scanned, make_axis
from labseq.data.shot import Shot
from labseq.data.tables import check_installed
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.files import explained, whole_file
from labseq.messages import clean, visible
from labseq.recording.folders import RUN_FILE, find_run
from labseq.units import parse_any, si_unit_of

if TYPE_CHECKING:
    import xarray as xr

Runs = Mapping[Point, Sequence[Run]]

OF_SHOTS: Final = ("filling_fraction", "success", "n_defects", "n_batches", "n_atom_moves")
"""Columns of the shots that the combined file contains for each shot."""


def campaign_in(path: Path | None) -> Path | None:
    """The folder of a campaign if a command is given one. None if it is given a run.

    Raises:
        ConfigError: This folder is neither a run nor a campaign.
    """
    folder = None if path is None else path.expanduser()
    if folder is None or not folder.is_dir():
        return None
    if (folder / CAMPAIGN_FILE).is_file() and not (folder / RUN_FILE).is_file():
        return folder
    try:
        find_run(folder)
    except RecordingError as error:
        raise ConfigError(f"{error}, or a campaign's folder, which has a {CAMPAIGN_FILE}") from error
    return None


def export_campaign(folder: Path, path: Path) -> None:
    """Write the results of a campaign to a netCDF file, and print its name.

    Raises:
        ConfigError: The campaign has no runs.
        RecordingError: A run is damaged, or the file cannot be written.
    """
    campaign, runs = recorded_runs(folder)
    # before the file is touched, as a run may be damaged
    results = combined(campaign, runs)
    with explained(path), whole_file(path) as file:
        results.to_netcdf(Path(file.name), engine="h5netcdf")
    say(*_missing(campaign, runs), f"written: {path}")


def _missing(campaign: Campaign, runs: Runs) -> list[str]:
    """A line about the points whose runs are not complete. Empty if all are complete."""
    n_complete = sum(
        len(same_point) == campaign.settings.runs and all(run.status == "complete" for run in same_point)
        for same_point in runs.values()
    )
    if n_complete == (n_points := len(runs)):
        return []
    n_without = n_points - sum(any(run.shots for run in same_point) for same_point in runs.values())
    return [f"{n_complete} of {plural(n_points, 'point')} are complete; {n_without} without shots are nan"]


def combined(campaign: Campaign, runs: Runs) -> xr.Dataset:
    """The results of a campaign on the grid of its points.

    Returns:
        A dataset with a dimension for each axis. It has ``n_shots``, and the mean of each quantity that the
        runs measure with the ends of its 1 sigma interval, such as ``filling_low`` and ``filling_high``. If
        points have several shots, :data:`OF_SHOTS` have the dimension ``repeat`` as well. Coordinates are SI.
    """
    check_installed("xarray", "h5netcdf")
    import numpy as np
    import xarray as xr

    shape, names = tuple(map(len, campaign.axes.values())), tuple(campaign.axes)
    shots = {point: _shots(same_point) for point, same_point in runs.items()}
    n_repeats = max(campaign.settings.repeats, *map(len, shots.values()))
    measured = measured_by(_first(runs)) if any(runs.values()) else WITH_TARGET
    means = {f"{name}{end}": np.full(shape, np.nan) for name in measured for end in ("", "_low", "_high")}
    of_shots = {name: np.full((*shape, n_repeats), np.nan) for name in OF_SHOTS}
    n_shots = np.zeros(shape, np.int64)
    for point, same_point in runs.items():
        if not same_point:
            continue
        n_shots[point] = len(shots[point])
        for name in measured:
            estimate = same_point[0].quantity(name).over(shots[point])
            for end, value in zip(("", "_low", "_high"), (estimate.value, *estimate.interval), strict=True):
                means[name + end][point] = value
        for name, values in of_shots.items():
            taken = [quantities_in(shot.row).get(name, math.nan) for shot in shots[point]]
            values[point][: len(taken)] = taken  # nan for shots that are still missing
    dims, repeats = (*names, "repeat"), slice(None)
    if n_repeats == 1:
        dims, repeats = names, 0
    data: dict[str, Any] = {
        name: (names, values, {"long_name": _description(name)}) for name, values in means.items()
    }
    data |= {
        name: (dims, values[..., repeats], {"long_name": _description(name)})
        for name, values in of_shots.items()
    }
    data["n_shots"] = (names, n_shots, {"long_name": "shots at the point"})
    coordinates = {
        address: ((address,), _values(campaign, address, runs), {"units": si_unit_of(written[0])})
        for address, written in campaign.axes.items()
    }
    return xr.Dataset(data, coordinates, {"sequence": campaign.settings.sequence})


def _description(name: str) -> str:
    bare = name.removesuffix("_low").removesuffix("_high")
    if bare == name:
        return description_of(name) if name in OF_SHOTS else f"mean over the shots of: {description_of(name)}"
    return f"{'lower' if name.endswith('low') else 'upper'} end of the 1 sigma interval of {bare}"


def _values(campaign: Campaign, address: str, runs: Runs) -> list[Any]:
    """The values of an axis in SI, or all as written if one of them is not a number."""
    written, axis = campaign.axes[address], [*campaign.axes].index(address)
    values: list[Any] = [*written]
    for i, text in enumerate(written):
        with suppress(ValueError):
            values[i] = parse_any(text)[0]
    for point, same_point in runs.items():  # as the run read it, because it knows the setting's type
        for run in same_point:
            values[point[axis]] = run.record["overrides"][address]["value"]
    return values if all(type(value) in (int, float) for value in values) else [*written]


def campaign_picture(folder: Path) -> RunPicture:
    """What a campaign measures at its points: points with errors, or maps for two axes.

    Raises:
        ConfigError: The campaign has no shots yet.
        RecordingError: A run is damaged.
    """
    campaign, runs = recorded_runs(folder)
    if not campaign.axes:
        hint = "'labseq plot' draws each of its runs, 'labseq export' writes their shots to one file"
        raise ConfigError(Problem("the campaign has no axes to draw", visible(str(folder)), hint=hint))
    varied = [i for i, values in enumerate(campaign.axes.values()) if len(values) > 1] or [0]
    addresses = [[*campaign.axes][i] for i in varied]
    axes = tuple(
        make_axis(clean(address), [*map(clean, campaign.axes[address])], _values(campaign, address, runs))
        for address in addresses
    )
    points = [*campaign.points()]
    shots = [_shots(runs[point]) for point in points]
    places = tuple(tuple(point[i] for i in varied) for point in points)
    scan = Scanned(axes, places, tuple(ScanPoint({}, {}, point_shots) for point_shots in shots))
    names = measured_by(_first(runs))
    quantities = [_over_runs(runs, name) for name in names]
    rows = tuple(row for one in quantities if (row := scan_panels(scan, one, scan.over(one))))
    if not rows:
        raise ConfigError(Problem("the campaign has no shots to draw yet", visible(str(folder))))
    note = "; ".join([plural(sum(map(len, shots)), "shot"), *_missing(campaign, runs)])
    return RunPicture(f"campaign {clean(folder.resolve().name)}", note, rows)


def results_of(runs: Sequence[Run]) -> dict[str, str]:
    """Results of some runs of one sequence: quantity -> mean over their shots as text. Empty without runs."""
    quantities = [_over_runs({(): runs}, name) for name in measured_by(runs[0])] if runs else []
    shots = _shots(runs)
    return {title_of(one): value_text(one.over(shots), one, short=True) for one in quantities}


def _over_runs(runs: Runs, name: str) -> Quantity:
    """A quantity of the shots of several runs, each with the target of its own run."""
    of_run = {
        run.shots[0].file.parent: run.quantity(name)
        for same_point in runs.values()
        for run in same_point
        if run.shots
    }

    def events_of(shot: Shot) -> tuple[float, float]:
        return of_run[shot.file.parent].events_of(shot)

    return replace(_first(runs).quantity(name), events_of=events_of)


def _first(runs: Runs) -> Run:
    return next(run for same_point in runs.values() for run in same_point)


def _shots(runs: Sequence[Run]) -> tuple[Shot, ...]:
    """The shots of the runs of a point."""
    return tuple(shot for run in runs for shot in run.shots)
