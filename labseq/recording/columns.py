"""The columns of a run's table of shots."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from labseq.errors import RecordingError
from labseq.plain import dumps
from labseq.recording.reader import Run
from labseq.recording.run_file import SIMULATION, flat_readings
from labseq.recording.schema import unit_of
from labseq.recording.shot import Shot, load_content
from labseq.units import si_unit_of

_FIXED: Final[Mapping[str, tuple[str, str]]] = {
    "shot": ("", "index of the shot in the run, from 0"),
    "attempt": ("", "0 for the first try"),
    "status": ("", "complete, interrupted or failed"),
    "t_start_utc": ("", "wall time of its start, ISO 8601, UTC"),
    "t_end_utc": ("", "wall time of its end"),
    "success": ("", "whether the last image step met the target"),
    "filling_fraction": ("", "filling of the target on the last image step"),
    "seen_defect_free_cycle": ("", "first cycle whose image met the target; 0 if none"),
    "n_images": ("", "number of images"),
    "n_cycles": ("", "number of rearrangement cycles"),
    "n_batches": ("", "batches that were played"),
    "n_atom_moves": ("", "atom moves that were played"),
    "n_missing_atoms": ("", "atoms that the loading fell short of the target"),
    "n_defects": ("", "empty target sites on the last image"),
    "n_surplus": ("", "atoms on the last image on sites that must be empty"),
    "duration_s": ("s", "sum of the steps on the session's clock"),
    "file": ("", "the shot's file, from the run's folder"),
}
"""Columns that every run has: unit and description."""

_TEXTS: Final = frozenset({"status", "t_start_utc", "t_end_utc", "file"})

FIGURES: Final = tuple(name for name in _FIXED if name not in {*_TEXTS, "shot", "attempt"})
"""Columns that every run has, and that are numbers that came of a shot."""

_Described: TypeAlias = Callable[[str], tuple[str, str]]
"""Name -> unit and description."""


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """One value of each shot.

    Attributes:
        name: Its name.
        values: (n_shots,): bool, int64, float64 with nan where there is none, or str objects with "".
        units: SI unit; "" where there is none.
        description: What it is.
    """

    name: str
    values: NDArray[Any]
    units: str
    description: str


def columns_of(run: Run, shots: Sequence[Shot] | None = None) -> list[Column]:
    """The shots of a run as columns, from the index alone.

    Only of runs before format 1.2 of the run the shots' files are opened, for readings and calibrations.

    Args:
        run: The run.
        shots: Those that make the rows; by default those that count.
    """
    chosen = run.shots if shots is None else shots
    told = [_shot_values(shot) for shot in chosen]
    rows = [shot.row for shot in chosen]
    columns = [
        Column(name, _array([of[name] for of in told], text=name in _TEXTS), *_FIXED[name]) for name in _FIXED
    ]
    taken = {*_FIXED}
    for prefix, groups, described in (
        ("", [_mapping(row.get("parameters")) for row in rows], _parameters(run)),
        ("stage.", [_stages(row) for row in rows], _as("sum of this stage on the session's clock")),
        ("reading.", list(map(_readings, chosen)), _reading),
        ("calibration.", list(map(_calibrations, chosen)), _as("id of the calibration in use")),
    ):
        for name in dict.fromkeys(name for group in groups for name in group):
            values = _array([group.get(name) for group in groups])
            columns.append(Column(_free(f"{prefix}{name}", taken), values, *described(name)))
    return columns


def figures_of(shot: Shot) -> dict[str, float]:
    """The numbers that the index tells of a shot, by the names of their columns; no nan among them."""
    found = {name: value for name, value in _shot_values(shot).items() if name in FIGURES}
    found |= {f"stage.{name}": value for name, value in _stages(shot.row).items()}
    found |= {f"reading.{name}": value for name, value in _readings(shot).items()}
    return {
        name: float(value)
        for name, value in found.items()
        if isinstance(value, bool | int | float) and math.isfinite(value)
    }


def _as(description: str) -> _Described:
    """Describes all names alike, each with the unit that it ends in."""
    return lambda name: (unit_of(name), description)


def _reading(name: str) -> tuple[str, str]:
    told = "truth of a simulation" if name.startswith(SIMULATION) else "read from a device during the shot"
    return unit_of(name), f"{told}, SI"


def _free(name: str, taken: set[str]) -> str:
    """A name that no other column has."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def _shot_values(shot: Shot) -> dict[str, Any]:
    row = shot.row
    steps = [s for name, s in _mapping(row.get("stage_s")).items() if name.startswith("step ")]
    found = {name: row.get(name) for name in _FIXED}
    n_defects, n_surplus = _last_image(shot)
    duration_s = math.fsum(s for s in steps if isinstance(s, int | float)) if steps else None
    return found | {"n_defects": n_defects, "n_surplus": n_surplus, "duration_s": duration_s}


def _last_image(shot: Shot) -> tuple[int | None, int | None]:
    images = _mapping(shot.row.get("images"))
    try:
        if images:
            return images["n_defects"][-1], images["n_surplus"][-1]
        found = shot.summary.images
        return found.n_defects[-1], found.n_surplus[-1]
    except (RecordingError, LookupError, TypeError):  # no image, no file, or a damaged line
        return None, None


def _stages(row: Mapping[str, Any]) -> dict[str, Any]:
    return {f"{name}_s": seconds for name, seconds in _mapping(row.get("stage_s")).items()}


def _readings(shot: Shot) -> dict[str, Any]:
    told = {f"{SIMULATION}{name}": value for name, value in _mapping(shot.row.get("simulation")).items()}
    if "readings" in shot.row:
        return {**_mapping(shot.row["readings"]), **told}
    try:
        everything = shot.readings
    except RecordingError:
        return told
    untold = {name: value for name, value in everything.items() if name.startswith(SIMULATION)}
    return {**flat_readings(everything), **untold, **told}


def _calibrations(shot: Shot) -> dict[str, Any]:
    if "calibrations" in shot.row:
        return _mapping(shot.row["calibrations"])
    try:
        return dict(shot.calibrations)
    except RecordingError:
        return {}


def _mapping(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}  # pyright: ignore[reportUnknownVariableType] - of JSON


def _parameters(run: Run) -> _Described:
    """Tells unit and description of a parameter."""
    scan = run.scan
    units: dict[str, str] = {}
    for values in scan.get("written") or ():
        for address, written in zip(scan.get("addresses") or (), values, strict=False):
            units[address] = units.get(address) or si_unit_of(str(written))

    def described(name: str) -> tuple[str, str]:
        return units.get(name) or unit_of(name), f"{'scanned' if name in units else 'set for the run'}, SI"

    return described


def _array(values: Sequence[Any], *, text: bool = False) -> NDArray[Any]:
    """Values as one array, of the narrowest kind that takes all of them."""
    kinds = {*map(type, values)}
    if not text and kinds <= {bool, int, float, type(None)} and all(map(_fits, values)):
        if kinds == {bool}:
            return np.array(values, np.bool_)
        if kinds == {int}:
            return np.array(values, np.int64)
        return np.array([math.nan if value is None else value for value in values], np.float64)
    return np.array([_text(value) for value in values], object)


def _fits(value: float | None) -> bool:
    return type(value) is not int or -(2**63) <= value < 2**63


def _text(value: object) -> str:
    if value is None:
        return ""
    return value if isinstance(value, str) else dumps(value)


def figures_in(row: Mapping[str, Any]) -> dict[str, float]:
    """The numbers that came of a shot.

    Args:
        row: The shot's line in the index.

    Returns:
        Name -> value, as :meth:`labseq.Run.to_dataframe` calls its column: "filling_fraction",
        "stage.plan_s", "reading.laser.power_w". No nan is among them.

    Example:
        >>> figures_in({"shot": 0, "filling_fraction": 0.5, "stage_s": {"plan": 0.1}})
        {'filling_fraction': 0.5, 'stage.plan_s': 0.1}
    """
    return figures_of(Shot(Path(), dict(row), load_content))
