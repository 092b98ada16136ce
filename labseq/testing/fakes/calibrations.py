"""Calibrations that nobody measured."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from labseq.model import CalibrationEntry, CalibrationKind, SiteGrid, grid_facts

_FIGURES = {
    "sites": {"residual_px": 0.02, "n_sites_found": 0.0},
    "thresholds": {"error": 5e-4},
    "tweezers": {"separable_spread": 3e-3},
    "frequencies": {"error_m": 2e-8},
    "overlay": {"error_m": 2e-8},
}


def fake_calibration(
    kind: CalibrationKind,
    grid: SiteGrid | None = None,
    *,
    values: Mapping[str, ArrayLike] | None = None,
    quality: Mapping[str, float] | None = None,
    origin: Mapping[str, Any] | None = None,
    taken_utc: str = "2026-11-20T08:00:00+00:00",
) -> CalibrationEntry:
    """Make a calibration of any kind, with sites 10 px apart and tones as the grid has them.

    Args:
        kind: Its kind.
        grid: The grid of sites; by default the paper's.
        values: Values in place of its own.
        quality: Figures of merit in place of its own.
        origin: Where it comes from.
        taken_utc: When it was made.

    Example:
        >>> fake_calibration("overlay", values={"offset_m": [1e-7, 0.0]}).values["offset_m"].tolist()
        [1e-07, 0.0]
    """
    grid = grid or SiteGrid()
    figures = _FIGURES[kind] | ({"n_sites_found": float(np.prod(grid.shape))} if kind == "sites" else {})
    merged: Any = {**_values(kind, grid), **(values or {})}  # whatever a test wants to see refused
    return CalibrationEntry(
        kind,
        merged,
        figures if quality is None else quality,
        grid_facts(grid),
        origin or {},
        taken_utc,
    )


def _values(kind: CalibrationKind, grid: SiteGrid) -> Mapping[str, ArrayLike]:
    n_rows, n_cols = grid.shape
    rows, cols = np.indices(grid.shape)
    values: Mapping[str, Mapping[str, ArrayLike]] = {
        "sites": {
            "positions_px": 10.0 * np.stack([rows + 1, cols + 1 + 0.5 * rows], axis=-1),
            "frame": [10 * n_rows + 20, 10 * n_cols + 5 * n_rows + 20],
        },
        "thresholds": {"thresholds": np.full(grid.shape, 1630.0)},
        "tweezers": {
            "row_amplitudes": np.full(n_rows, 1 / n_rows),
            "column_amplitudes": np.full(n_cols, 1 / n_cols),
        },
        "frequencies": {"row_hz": grid.row_frequency_hz, "column_hz": grid.column_frequency_hz},
        "overlay": {"offset_m": [0.0, 0.0]},
    }
    return values[kind]
