"""The grid of a run on the disk, and where its sites are on the frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from labseq.calibrations import read_entry
from labseq.errors import ConfigError
from labseq.imaging.known_sites import KnownSites, known_sites
from labseq.model import CalibrationEntry, SiteGrid
from labseq.recording import Run


@dataclass(frozen=True, slots=True)
class _Geometry:
    """What the detector's settings say of the sites."""

    sites: Path | None
    frame: tuple[int, int]
    centre_px: tuple[float, float]
    pixel_size: float
    angle: float


@dataclass(frozen=True, slots=True, eq=False)
class _Context:
    grid: SiteGrid
    calibrations: Mapping[str, CalibrationEntry]
    name: str = "detector"


def grid_of(run: Run) -> SiteGrid:
    """The grid of a run's sites, as the recorded profile has it."""
    n_rows, n_cols = run.target.shape
    profile = _mapping(_mapping(run.record.get("resolved")).get("profile"))
    sheared_left = _mapping(profile.get("grid")).get("shear") == -1
    lattice = "square" if run.record.get("lattice") == "square" else "triangular"
    spacing: Any = run.record.get("grid_spacing_m")
    known = isinstance(spacing, float | int) and spacing > 0
    spacing_m = float(spacing) if known else SiteGrid(1, 1).spacing_m
    return SiteGrid(n_rows, n_cols, spacing_m, lattice, -1 if sheared_left else 1)


def sites_of(run: Run) -> KnownSites | None:
    """Where a run's sites are on its frames: as the detector took them.

    That is by the file that the detector's settings name, by the calibration that was copied into the run's
    folder, or by the settings themselves.

    Returns:
        None if the run does not tell, or the file is gone.
    """
    profile = _mapping(_mapping(run.record.get("resolved")).get("profile"))
    told = _mapping(profile.get("detector"))
    try:
        height, width = told["frame"]
        y, x = told["centre_px"]
        file = told.get("sites")
        pixel_size, angle = float(told["pixel_size"]), float(told["angle"])
        geometry = _Geometry(Path(file) if file else None, (height, width), (y, x), pixel_size, angle)
        return known_sites(geometry, _Context(grid_of(run), _copies(run)))
    except (KeyError, TypeError, ValueError, ConfigError):
        return None


def _copies(run: Run) -> dict[str, CalibrationEntry]:
    path = run.path / "calibration_sites.json"
    return {"sites": read_entry(path)} if path.is_file() else {}


def _mapping(value: object) -> Mapping[str, Any]:
    return cast("Mapping[str, Any]", value) if isinstance(value, Mapping) else {}
