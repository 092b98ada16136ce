"""The shots of a run as columns, read from the index alone: one value per shot, with its unit."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.data.shot import Shot
from labseq.plain import dumps, plain_text
from labseq.recording import schema
from labseq.recording.index import SIMULATION, IndexRow
from labseq.recording.results import result_columns
from labseq.recording.schema import unit_of

if TYPE_CHECKING:
    from labseq.data.reader import Run

_DERIVED: Final[Mapping[str, tuple[str, Callable[[IndexRow], Any]]]] = {
    "n_loaded": ("atoms on the first image", lambda row: _first(row.images.n_atoms)),
    "n_atoms": ("atoms on the last image", lambda row: _first(row.images.n_atoms[-1:])),
    "n_defects": ("empty target sites on the last image", lambda row: _first(row.images.n_defects[-1:])),
    "n_surplus": (
        "atoms on the last image on sites that must be empty",
        lambda row: _first(row.images.n_surplus[-1:]),
    ),
    "duration_s": ("sum of the steps on the session's clock", lambda row: row.duration_s),
    "file": ("the shot's file, from the run's folder", lambda row: row.file),
}
"""Columns that are computed from a line of the index: description, function."""

_FIELDS: Final = tuple(field for field in schema.IN_INDEX if field.name != "error")
DESCRIPTIONS: Final = {field.name: field.description for field in _FIELDS} | {
    name: description for name, (description, _) in _DERIVED.items()
}
"""Columns that every run has -> their descriptions."""
_TEXTS: Final = frozenset({"file", *(field.name for field in _FIELDS if field.dtype == "text")})

QUANTITIES: Final = tuple(name for name in DESCRIPTIONS if name not in {*_TEXTS, "shot", "attempt"})
"""Columns of every run that are numerical results of a shot."""
FRACTIONS: Final = frozenset({"success", "filling_fraction"})
"""Quantities that are shown in per cent."""


def _readings(row: IndexRow) -> dict[str, Any]:
    return {**row.readings, **{f"{SIMULATION}{name}": value for name, value in row.simulation.items()}}


_GROUPS: Final[Mapping[str, Callable[[IndexRow], Mapping[str, Any]]]] = {
    "": lambda row: row.parameters,
    "stage.": lambda row: {f"{name}_s": seconds for name, seconds in row.stage_s.items()},
    "reading.": _readings,
    "calibration.": lambda row: row.calibrations,
}
"""Prefix of the columns that differ from run to run -> their values in a line of the index."""
GROUPS: Final = {
    "stage.": "sum of this stage on the session's clock",
    "reading.": "read from a device during the shot, SI",
    "calibration.": "id of the calibration in use",
}
"""Prefix of such columns -> their description."""
RESULT: Final = "result of an analysis"


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """One value of each shot.

    Attributes:
        name: Name of the column.
        values: Array (n_shots,) of bool, int64, float64 with nan if missing, or str objects with "".
        units: SI unit. "" for none.
        description: Description of the column.
    """

    name: str
    values: NDArray[Any]
    units: str
    description: str


def make_column(
    name: str, values: Sequence[Any], units: str, description: str, *, text: bool = False
) -> Column:
    """A column of the narrowest type that can hold all values, or of text."""
    return Column(name, _array(values, text=text), units, description)


def columns_of(run: Run, shots: Sequence[Shot] | None = None) -> list[Column]:
    """The shots of a run as columns, read from the index alone.

    Args:
        shots: The shots of the rows. Default: the shots that count.
    """
    rows = [shot.row for shot in (run.shots if shots is None else shots)]
    results = result_columns(run.path)
    fixed = [_fixed(row) for row in rows]
    columns = [
        make_column(name, [values[name] for values in fixed], unit_of(name), description, text=name in _TEXTS)
        for name, description in DESCRIPTIONS.items()
    ]
    names = {*DESCRIPTIONS}
    scanned = (run.record.get("scan") or {}).get("addresses") or ()
    known_units = {"": run.units, "reading.": run.reading_units}
    for prefix, values_of in _GROUPS.items():
        groups = [values_of(row) for row in rows]
        for name in dict.fromkeys(name for group in groups for name in group):
            full_name = _column_name(prefix, name)
            # a parameter may have the same name as a fixed column
            while full_name in names:
                full_name += "_"
            names.add(full_name)
            units = known_units.get(prefix, {}).get(name, unit_of(name) if prefix else "")
            description = _description(prefix, name, scanned=name in scanned)
            columns.append(make_column(full_name, [group.get(name) for group in groups], units, description))
    for name, values in results.items():
        # only attempts that count are analysed, but a failed one has the same shot number
        row_values = [values.get(row.shot) if row.counts else None for row in rows]
        columns.append(make_column(name, row_values, unit_of(name), RESULT))
    return columns


def _description(prefix: str, name: str, *, scanned: bool) -> str:
    if prefix == "reading." and name.startswith(SIMULATION):
        return "true value in the simulation, SI"
    if prefix:
        return GROUPS[prefix]
    return f"{'scanned' if scanned else 'set for the run'}, SI"


def quantities_in(row: IndexRow) -> dict[str, float]:
    """The quantities (numerical results) of a shot, from its line in the index.

    Returns:
        Name -> value, with the column names of :meth:`labseq.Run.to_dataframe`: "filling_fraction",
        "stage.plan_s", "reading.laser.power_w". Values that are nan are left out.
    """
    values = {name: value for name, value in _fixed(row).items() if name in QUANTITIES}
    for prefix in ("stage.", "reading."):
        values |= {_column_name(prefix, name): value for name, value in _GROUPS[prefix](row).items()}
    return {
        name: float(value)
        for name, value in values.items()
        if isinstance(value, bool | int | float) and math.isfinite(value)
    }


def _fixed(row: IndexRow) -> dict[str, Any]:
    """The values of the columns that every run has."""
    values = {field.name: getattr(row, field.name) for field in _FIELDS}
    return values | {name: value(row) for name, (_, value) in _DERIVED.items()}


def _first(values: Sequence[int]) -> int | None:
    return values[0] if len(values) else None


def _column_name(prefix: str, name: str) -> str:
    """The name of a column, without spaces."""
    return "_".join(plain_text(f"{prefix}{name}").split())


def _array(values: Sequence[Any], *, text: bool = False) -> NDArray[Any]:
    """Convert values to one array of the narrowest type that can hold all of them."""
    kinds = {*map(type, values)}
    if not text and kinds <= {bool, int, float, type(None)} and all(map(_fits, values)):
        if kinds == {bool}:
            return np.array(values, np.bool_)
        if kinds == {int}:
            return np.array(values, np.int64)
        # numpy has no missing integer, so a column with gaps is of floats
        return np.array([math.nan if value is None else value for value in values], np.float64)
    return np.array([_text(value) for value in values], object)


def _fits(value: float | None) -> bool:
    """Whether a value fits into an array of numbers."""
    return type(value) is not int or -(2**63) <= value < 2**63


def _text(value: object) -> str:
    if value is None:
        return ""
    return plain_text(value) if isinstance(value, str) else dumps(value)
