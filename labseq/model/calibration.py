"""A calibration: the values that the machine uses, with their quality and origin."""

from __future__ import annotations

import hashlib
import json
import math
import string
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from types import MappingProxyType
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.errors import LimitError
from labseq.model.grid import Floats, SiteGrid, axis_positions_m, mean_step_hz, read_only

CalibrationKind = Literal["sites", "thresholds", "tweezers", "amplitudes", "frequencies", "overlay", "timing"]
CALIBRATION_KINDS: Final[tuple[CalibrationKind, ...]] = get_args(CalibrationKind)

VALUE_SHAPES: Final[Mapping[str, Mapping[str, tuple[str | int, ...]]]] = MappingProxyType(
    {
        "sites": {"positions_px": ("rows", "cols", 2), "frame": (2,)},
        "thresholds": {"thresholds": ("rows", "cols")},
        "tweezers": {"row_amplitudes": ("rows",), "column_amplitudes": ("cols",)},
        "amplitudes": {"row_amplitudes": ("rows",), "column_amplitudes": ("cols",)},
        "frequencies": {"row_hz": ("rows",), "column_hz": ("cols",)},
        "overlay": {"offset_m": (2,)},
        "timing": {"overhead_s": (1,)},
    }
)
"""Kind -> the values that it must have, and their shapes. "rows" and "cols" are numbers of the grid."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationEntry:
    """One calibration, as it is stored. It never changes, because a new calibration is another entry.

    Values by kind, float64, (y, x) for pixels:

    - sites: ``positions_px`` (n_rows, n_cols, 2), ``frame`` (2,) height and width of the frames.
    - thresholds: ``thresholds`` (n_rows, n_cols), in the unit of the detector: counts over the
      offset, or log-odds.
    - tweezers: ``row_amplitudes`` (n_rows,), ``column_amplitudes`` (n_cols,) of the static tweezers' tones,
      fractions of full scale, and for tweezers with a weight for each site ``weights`` (n_rows, n_cols).
    - amplitudes: the same for the mobile tweezers' tones at the sites, above 0.
    - frequencies: ``row_hz`` (n_rows,), ``column_hz`` (n_cols,): the mobile tweezers' tones at the sites.
    - overlay: ``offset_m`` (2,): offset of the mobile tweezers from the sites, along a1 (along a
      row) and a2 (from row to row).
    - timing: ``overhead_s`` (1,): time from the start of a rearrangement cycle to the light, above 0.

    Attributes:
        kind: One of :data:`CALIBRATION_KINDS`.
        values: The values that the machine uses. It may contain more values than listed above.
        quality: Figures of merit, in SI units and pixels. nan for unknown figures.
        grid: ``rows``, ``cols``, ``spacing_m``, ``lattice`` and ``shear`` of the grid for which it was made.
        origin: JSON-ready: command, run, number of shots, profile, version of labseq, ids of the other
            calibrations in use.
        taken_utc: When it was made, ISO 8601, UTC.
        id: Twelve hexadecimal digits of the SHA-256 of kind, grid, values and ``taken_utc``, beginning with
            the first letter. Without a letter at the beginning, YAML could read the digits as a number.

    Raises:
        ValueError: A value is missing, not finite or out of range, or has the wrong shape.

    Example:
        >>> entry = CalibrationEntry("overlay", {"offset_m": [3e-8, 0.0]}, {"error_m": 1e-8},
        ...                          grid_facts(SiteGrid()), {}, "2026-11-20T08:00:00+00:00")
        >>> entry.id
        'db3073122486'
    """

    kind: CalibrationKind
    values: Mapping[str, NDArray[np.float64]]
    quality: Mapping[str, float]
    grid: Mapping[str, Any]
    origin: Mapping[str, Any]
    taken_utc: str
    id: str = field(init=False)

    def __post_init__(self) -> None:
        set_field = object.__setattr__
        if self.kind not in CALIBRATION_KINDS:
            raise ValueError(f"'{self.kind}' is not a kind of calibration")
        set_field(self, "grid", _facts(self.grid))
        set_field(self, "values", {name: _finite(name, value) for name, value in self.values.items()})
        set_field(self, "quality", {name: float(value) for name, value in self.quality.items()})
        set_field(self, "origin", dict(self.origin))
        self._check_shapes()
        self._check_range()
        if datetime.fromisoformat(self.taken_utc).tzinfo is None:
            raise ValueError(f"taken_utc is {self.taken_utc}, which has no time zone")
        set_field(self, "id", _content_id(self))

    def is_for(self, grid: SiteGrid) -> bool:
        """Whether the calibration is for a grid with these sites, whatever the tones of rows and columns."""
        return same_grid(self.grid, grid_facts(grid))

    def _check_shapes(self) -> None:
        weights = {"weights": ("rows", "cols")} if "weights" in self.values else {}
        for name, symbols in {**VALUE_SHAPES[self.kind], **weights}.items():
            shape = tuple(symbol if isinstance(symbol, int) else self.grid[symbol] for symbol in symbols)
            if name not in self.values:
                raise ValueError(f"'{name}' is missing")
            if self.values[name].shape != shape:
                raise ValueError(f"'{name}' has shape {self.values[name].shape}; expected {shape}")

    def _check_range(self) -> None:
        for name, value in self.values.items():
            if name.endswith("_amplitudes") and not np.all((value >= 0) & (value <= 1)):
                raise ValueError(f"'{name}' has values outside of 0 to 1")
        if not np.all(self.values.get("weights", np.ones(1)) > 0):
            raise ValueError("'weights' has values that are not above 0")
        if self.kind == "amplitudes" and any(
            not np.all(self.values[name] > 0) for name in VALUE_SHAPES[self.kind]
        ):
            raise ValueError("an amplitude is not above 0")
        if self.kind == "timing" and not self.values["overhead_s"][0] > 0:
            raise ValueError("'overhead_s' is not above 0")
        if self.kind == "frequencies":
            for name in VALUE_SHAPES[self.kind]:
                steps = np.diff(self.values[name])
                if not np.all(self.values[name] > 0):
                    raise ValueError(f"'{name}' has frequencies that are not above 0 Hz")
                if not (np.all(steps > 0) or np.all(steps < 0)):
                    raise ValueError(f"'{name}' neither rises nor falls monotonically")


def grid_facts(grid: SiteGrid) -> dict[str, Any]:
    """The properties of a grid that a calibration stores.

    Example:
        >>> grid_facts(SiteGrid(2, 3))
        {'rows': 2, 'cols': 3, 'spacing_m': 4.49e-06, 'lattice': 'triangular', 'shear': 1}
    """
    return {
        "rows": grid.n_rows,
        "cols": grid.n_cols,
        "spacing_m": float(grid.spacing_m),
        "lattice": grid.lattice,
        "shear": int(grid.shear),
    }


def same_grid(grid: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two grids have the same sites. The shear of a square lattice is ignored.

    Args:
        grid: From :func:`grid_facts`.
        other: From :func:`grid_facts`.
    """
    keys = ("rows", "cols", "lattice", *(("shear",) if grid["lattice"] == "triangular" else ()))
    is_alike = math.isclose(grid["spacing_m"], other["spacing_m"], rel_tol=1e-6)
    return is_alike and all(grid[key] == other[key] for key in keys)


def _facts(grid: Mapping[str, Any]) -> dict[str, Any]:
    try:
        facts: dict[str, Any] = {
            "rows": int(grid["rows"]),
            "cols": int(grid["cols"]),
            "spacing_m": float(grid["spacing_m"]),
            "lattice": str(grid["lattice"]),
            "shear": int(grid["shear"]),
        }
    except KeyError as error:
        raise ValueError(f"the grid has no {error}") from None
    if facts["rows"] < 1 or facts["cols"] < 1 or not 0 < facts["spacing_m"] < math.inf:
        raise ValueError("the grid has no sites, or no spacing")
    return facts


def _finite(name: str, value: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"'{name}' contains {array.dtype}, not numbers")
    if not np.isfinite(array).all():
        raise ValueError(f"'{name}' has values that are not finite")
    return read_only(array, np.float64, (-1,) * array.ndim, name)


def _content_id(entry: CalibrationEntry) -> str:
    values = {name: value.tolist() for name, value in entry.values.items()}
    content = [entry.kind, entry.grid, values, entry.taken_utc]
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    digest = hashlib.sha256(text.encode()).hexdigest()
    return digest.lstrip(string.digits)[:12]


def correct_overlay(grid: SiteGrid, offset_m: ArrayLike) -> SiteGrid:
    """A grid with tones shifted so that the mobile tweezers are on the sites.

    An axis of one site takes the mean step of the other axis, and a grid of one site takes 1.6 MHz per
    spacing. The offsets of a probe use the same conversion.

    Args:
        grid: The grid, with the tones that displace the tweezers from the sites.
        offset_m: float64 (2,), displacement along a1 (along a row) and a2 (from row to row), in metres.

    Raises:
        LimitError: A tone is not above 0 Hz.

    Example:
        >>> grid = SiteGrid(3, 3, spacing_m=4e-6)
        >>> (correct_overlay(grid, [1e-6, 0.0]).column_frequency_hz - grid.column_frequency_hz).tolist()
        [-400000.0, -400000.0, -400000.0]
    """
    along_row_m, along_column_m = np.asarray(offset_m, np.float64)
    row_hz, column_hz = grid.row_frequency_hz, grid.column_frequency_hz
    return replace(
        grid,
        row_frequency_hz=_shifted("row", row_hz, column_hz, grid.spacing_m, along_column_m),
        column_frequency_hz=_shifted("column", column_hz, row_hz, grid.spacing_m, along_row_m),
    )


def _shifted(name: str, site_hz: Floats, other_hz: Floats, spacing_m: float, offset_m: float) -> Floats:
    if offset_m == 0:
        return site_hz
    site_m = axis_positions_m(len(site_hz), spacing_m)
    if len(site_hz) < 2:
        moved_hz = site_hz - offset_m * mean_step_hz(site_hz, other_hz) / spacing_m
    else:
        moved_hz = _along(site_m - offset_m, site_m, site_hz)
    if not np.all(moved_hz > 0):
        raise LimitError(f"the lowest {name} frequency", f"{moved_hz.min()} Hz", "above 0 Hz")
    return moved_hz


def _along(x: Floats, knots: Floats, values: Floats) -> Floats:
    """Interpolate linearly, and extrapolate beyond the ends with the outermost step. ``knots`` rise."""
    i = np.clip(np.searchsorted(knots, x) - 1, 0, len(knots) - 2)
    slope = np.diff(values) / np.diff(knots)
    return values[i] + slope[i] * (x - knots[i])
