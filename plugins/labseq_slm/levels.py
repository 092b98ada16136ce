"""Conversion of phases to an SLM's grey levels by its look-up table, and correction of its surface."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import ConfigError, Problem
from labseq.plugin.arrays import opened_array
from labseq.plugin.messages import install_hint

LEVELS: Final = 256
FINE: Final = 4096
"""Steps of the phase for which the nearest grey level is looked up, 16 for each level."""


class BadFileError(Exception):
    """A file that cannot be used.

    Attributes:
        problem: The file with its fault, and what was expected.
    """

    def __init__(self, path: Path, what: str, expected: str) -> None:
        self.problem = Problem(what, str(path), expected=expected)
        super().__init__(str(self.problem))


def read_look_up_table(path: Path | None) -> NDArray[np.float64]:
    """Phase of each grey level, float64 (256,) in rad. Without a file they rise linearly to 2 pi.

    Raises:
        BadFileError: It is not such a file.
    """
    if path is None:
        return np.linspace(0.0, 2 * math.pi, LEVELS, endpoint=False)
    expected = f"{LEVELS} finite phases in rad, not all equal"
    table = np.asarray(_array(path, expected), np.float64)
    if table.shape != (LEVELS,) or not np.isfinite(table).all() or np.ptp(table) == 0:
        raise BadFileError(path, f"it holds an array of shape {table.shape}", expected)
    return table


def read_correction(path: Path | None, pixels: tuple[int, int]) -> NDArray[np.float32]:
    """Phase that corrects the surface, float32 (rows, columns) in rad, 0 without a file.

    Raises:
        BadFileError: It is not such a file.
    """
    if path is None:
        return np.zeros(pixels, np.float32)
    expected = f"grey levels of {pixels[0]} x {pixels[1]} pixels, 8 bits each"
    is_array = path.suffix.lower() == ".npy"
    levels = np.asarray(_array(path, expected) if is_array else _picture(path, expected))
    if levels.shape != pixels or levels.dtype != np.uint8:
        raise BadFileError(path, f"it holds {levels.dtype} of shape {levels.shape}", expected)
    return levels.astype(np.float32) * np.float32(2 * math.pi / LEVELS)


def _array(path: Path, expected: str) -> Any:
    _refuse_missing(path, expected)
    try:
        with opened_array(path) as array:
            return np.array(array)
    except (ConfigError, KeyError) as error:
        raise BadFileError(path, "it is not a file with an array", expected) from error


def _picture(path: Path, expected: str) -> Any:
    _refuse_missing(path, expected)
    try:
        from PIL import Image
    except ImportError:
        raise BadFileError(path, f"Pillow is not installed ({install_hint('slm')})", expected) from None
    try:
        with Image.open(path) as picture:
            return np.array(picture.convert("L") if picture.mode == "P" else picture)
    except (OSError, ValueError) as error:
        raise BadFileError(path, "it is not a picture", expected) from error


def _refuse_missing(path: Path, expected: str) -> None:
    if not path.is_file():
        raise BadFileError(path, "there is no such file", expected)


def nearest_levels(table: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Grey level whose phase is nearest to each of :data:`FINE` phases from 0 to 2 pi, uint8 (FINE,)."""
    phases = np.arange(FINE) * (2 * math.pi / FINE)
    apart = np.abs(np.exp(1j * phases)[:, None] - np.exp(1j * table))
    return apart.argmin(axis=1).astype(np.uint8)


def levels_of(phase: NDArray[np.float32], nearest: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grey levels of phases in rad, wrapped, uint8 (rows, columns).

    Example:
        >>> table = read_look_up_table(None)
        >>> levels_of(np.float32([0.0, np.pi, -np.pi / 2, 7 * np.pi]), nearest_levels(table)).tolist()
        [0, 128, 192, 128]
    """
    steps = np.rint(phase * np.float32(FINE / (2 * math.pi))).astype(np.int32)
    return nearest[steps % FINE]
