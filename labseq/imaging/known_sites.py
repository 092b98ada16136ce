"""Where the sites are, and who says so: a file, a calibration, or the geometry in the settings."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from labseq.errors import ConfigError
from labseq.imaging.sites import site_pixels
from labseq.model import CalibrationEntry, SiteGrid
from labseq.model.arrays import read_only

Floats = NDArray[np.float64]

COLUMNS: Final = ("row", "col", "y", "x")


class ContextLike(Protocol):
    """What a detector needs of a ``labseq.Context``."""

    @property
    def name(self) -> str:
        """Role in the profile."""
        ...

    @property
    def grid(self) -> SiteGrid:
        """The grid of sites."""
        ...

    @property
    def calibrations(self) -> Mapping[str, CalibrationEntry]:
        """Calibrations in use: kind -> entry."""
        ...


class GeometryLike(Protocol):
    """Where the sites are on the frames; SI and pixels."""

    @property
    def sites(self) -> Path | None:
        """File with the place of each site; None for none."""
        ...

    @property
    def frame(self) -> tuple[int, int]:
        """(height, width) of the frames that file and geometry belong to."""
        ...

    @property
    def centre_px(self) -> tuple[float, float]:
        """(y, x) of the grid's centre."""
        ...

    @property
    def pixel_size(self) -> float:
        """Size of a pixel in the atom plane, in metres."""
        ...

    @property
    def angle(self) -> float:
        """Rotation of the grid, in radians, clockwise on the screen."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class KnownSites:
    """Where the sites are.

    Attributes:
        positions_px: float64 (n_rows, n_cols, 2), (y, x) of each site in pixels; read-only.
        frame: (height, width) of the frames that they belong to.
        source: Who says so, in words: "the calibration of sites a1b2c3d4e5f6".
        mend: What to do if they do not fit.
    """

    positions_px: Floats
    frame: tuple[int, int]
    source: str
    remedy: str

    def __post_init__(self) -> None:
        positions = read_only(self.positions_px, np.float64, (-1, -1, 2), "positions_px")
        object.__setattr__(self, "positions_px", positions)


def known_sites(settings: GeometryLike, context: ContextLike) -> KnownSites:
    """Where the sites are: by the file in ``sites``, else by the calibration in use, else by the geometry.

    Args:
        settings: See :class:`GeometryLike`.
        context: Grid and calibrations.

    Raises:
        ConfigError: The file cannot be read, or has not one place for each site.
    """
    if settings.sites is not None:
        return KnownSites(
            read_sites(settings.sites, context.grid.shape),
            settings.frame,
            f"the sites in {settings.sites}",
            "check the file, and `frame` of the detector",
        )
    entry = context.calibrations.get("sites")
    if entry is not None:
        height, width = (int(n) for n in entry.values["frame"])
        return KnownSites(
            entry.values["positions_px"],
            (height, width),
            f"the calibration of sites {entry.id}",
            "calibrate the sites with this camera, crop it as it was then, or take another calibration",
        )
    return KnownSites(
        site_pixels(context.grid, settings.pixel_size, settings.centre_px, settings.angle),
        settings.frame,
        "the detector's settings",
        "calibrate the sites, or check `centre_px`, `pixel_size`, `angle` and `frame` of the detector",
    )


def read_sites(path: Path, shape: tuple[int, int]) -> Floats:
    """Read the places of the sites of an irregular array.

    Args:
        path: A .npy file of floats (n_rows, n_cols, 2) with (y, x) in pixels, or a
            table in text with the columns row, col, y and x, named in its first
            line and separated by commas, and a line for each site.
        shape: (n_rows, n_cols) of the grid.

    Returns:
        float64 (n_rows, n_cols, 2).

    Raises:
        ConfigError: It cannot be read, or has not one place for each site.
    """
    try:
        positions = _array(path) if path.suffix == ".npy" else _table(path, shape)
    except (OSError, ValueError, TypeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigError(
            f"the sites cannot be read from '{path}': {reason}; expected a .npy file of floats "
            f"(n_rows, n_cols, 2), (y, x) in pixels, or a .csv file with the columns {', '.join(COLUMNS)}"
        ) from error
    if positions.shape != (*shape, 2) or not np.isfinite(positions).all():
        came = f"of shape {positions.shape}" if positions.shape != (*shape, 2) else "not all finite"
        raise ConfigError(
            f"the sites in '{path}' are {came}; expected (y, x) for each of {shape[0]} x {shape[1]} sites: "
            f"{(*shape, 2)}"
        )
    return positions


def _array(path: Path) -> Floats:
    with path.open("rb") as file:
        return np.lib.format.read_array(file, allow_pickle=False).astype(np.float64)


def _table(path: Path, shape: tuple[int, int]) -> Floats:
    positions = np.full((*shape, 2), np.nan)
    with path.open(newline="", encoding="utf-8-sig") as file:
        table = csv.DictReader(file, skipinitialspace=True)
        missing = [name for name in COLUMNS if name not in (table.fieldnames or ())]
        if missing:
            raise ValueError(f"it has no column '{missing[0]}'")
        for line in table:
            try:
                row, col = int(line["row"]), int(line["col"])
                place = float(line["y"]), float(line["x"])
            except (TypeError, ValueError):
                raise ValueError(f"line {table.line_num} has not four numbers") from None
            if not (0 <= row < shape[0] and 0 <= col < shape[1]):
                raise ValueError(
                    f"line {table.line_num} is of site ({row}, {col}), which the grid does not have"
                )
            if not np.isnan(positions[row, col, 0]):
                raise ValueError(
                    f"line {table.line_num} is of site ({row}, {col}), which stands above already"
                )
            positions[row, col] = place
    left = np.argwhere(np.isnan(positions[..., 0]))
    if len(left):
        raise ValueError(f"{len(left)} sites are missing, ({left[0, 0]}, {left[0, 1]}) among them")
    return positions
