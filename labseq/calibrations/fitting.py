"""Whether a calibration was made for this grid of sites."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from labseq.errors import ConfigError, Problem
from labseq.model import CalibrationEntry, SiteGrid, grid_facts
from labseq.units import format_quantity


def check_grid(entry: CalibrationEntry, grid: SiteGrid, source: str) -> None:
    """Refuse an entry of another grid.

    Args:
        entry: The entry.
        grid: The grid of the profile.
        source: Where the entry comes from, for the message.

    Raises:
        ConfigError: Says both grids.
    """
    if not entry.is_for(grid):
        what = f"{entry.kind} {entry.id} was made for another grid: {grid_text(entry.grid)}"
        expected = f"{grid_text(grid_facts(grid))}, as in the profile"
        raise ConfigError(Problem(what, source, expected=expected))


def grid_text(grid: Mapping[str, Any]) -> str:
    """A grid in words.

    Example:
        >>> from labseq.model import SiteGrid
        >>> grid_text(grid_facts(SiteGrid()))
        '20 x 20 sites, triangular, 4.49 um, shear +1'
    """
    spacing = format_quantity(grid["spacing_m"], "length")
    shear = f", shear {grid['shear']:+d}" if grid["lattice"] == "triangular" else ""
    return f"{grid['rows']} x {grid['cols']} sites, {grid['lattice']}, {spacing}{shear}"
