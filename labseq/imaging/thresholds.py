"""The threshold of each site, and who says so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from labseq.errors import ConfigError, LimitError
from labseq.imaging.known_sites import ContextLike

PerSite: TypeAlias = float | str | Path | Sequence[Sequence[float]]
"""One number for all sites, one for each, or the path of a .npy file with one for each."""


@dataclass(frozen=True, slots=True, eq=False)
class KnownThresholds:
    """The thresholds.

    Attributes:
        values: float64 (n_rows, n_cols), in the detector's unit.
        source: Who says so, in words.
    """

    values: NDArray[np.float64]
    source: str


def known_thresholds(threshold: PerSite, unit: str, context: ContextLike) -> KnownThresholds:
    """The thresholds by the calibration in use, else by the settings.

    Args:
        threshold: The setting.
        unit: What the detector compares: "counts" or "log-odds".
        context: Grid and calibrations.

    Raises:
        LimitError: Not one finite value per site.
        ConfigError: The file cannot be read, or the calibration's ``origin`` names another unit.
    """
    entry = context.calibrations.get("thresholds")
    if entry is None:
        source = "the detector's settings" if not isinstance(threshold, str | Path) else str(threshold)
        return KnownThresholds(site_thresholds(threshold, context.grid.shape), source)
    theirs = entry.origin.get("unit", unit)
    if theirs != unit:
        raise ConfigError(
            f"the calibration of thresholds {entry.id} is in {theirs}, and the detector compares {unit}; "
            "calibrate the thresholds with this detector, or take another calibration, or `off`"
        )
    return KnownThresholds(entry.values["thresholds"], f"the calibration of thresholds {entry.id}")


def site_thresholds(threshold: PerSite, shape: tuple[int, int]) -> NDArray[np.float64]:
    """One threshold per site, float64 (n_rows, n_cols).

    Raises:
        LimitError: Not one finite value per site.
        ConfigError: The file cannot be read.
    """
    if isinstance(threshold, str | Path):
        values, source = _load(Path(threshold)), f"the thresholds in {threshold}"
    else:
        values, source = threshold, "the detector's thresholds"
    try:
        array = np.asarray(values, np.float64)
    except ValueError:  # rows of different lengths
        array = np.empty(0)
    if array.ndim == 0:
        return np.full(shape, array)
    if array.shape != shape or not np.isfinite(array).all():
        raise LimitError(
            f"the shape of {source}",
            array.shape if array.shape != shape else "right, but not every value is finite",
            f"one finite number for each of {shape[0]} x {shape[1]} sites",
        )
    return array


def _load(path: Path) -> NDArray[np.float64]:
    try:
        with path.open("rb") as file:
            return np.lib.format.read_array(file, allow_pickle=False).astype(np.float64)
    except (OSError, ValueError, TypeError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigError(
            f"the detector's thresholds cannot be read from '{path}': {reason}; "
            "expected a .npy file of one float per site"
        ) from error
