"""Where the mobile tweezers' tones really put their light."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import LimitError, SiteGrid
from labseq_virtual.settings import MobileLightSettings

Floats = NDArray[np.float64]

BEYOND: Final = 1000
"""Sites beyond the grid to which the frequency map is extended on each side."""


class FrequencyMap:
    """Frequency -> place along an axis, in sites; beyond the grid at the outermost step.

    Args:
        frequency_hz: float64 (n_sites,), rising or falling.
        lone_step_hz: Step to assume where there is one site only.
        axis: "row" or "column", for the error message.

    Raises:
        LimitError: The frequencies neither rise nor fall all along.
    """

    def __init__(self, frequency_hz: Floats, lone_step_hz: float, axis: str) -> None:
        steps = np.diff(frequency_hz)
        if not (np.all(steps > 0) or np.all(steps < 0)):
            raise LimitError(
                f"the {axis} frequencies of the grid", "out of order", "frequencies that all rise or all fall"
            )
        first, last = (steps[0], steps[-1]) if len(steps) else (lone_step_hz, lone_step_hz)
        ends = frequency_hz[0] - BEYOND * first, frequency_hz[-1] + BEYOND * last
        hz = np.concatenate([ends[:1], frequency_hz, ends[1:]])
        n_sites = len(frequency_hz)
        sites = np.concatenate([[-BEYOND], np.arange(n_sites), [n_sites - 1 + BEYOND]])
        rising = hz[-1] > hz[0]
        self._hz, self._sites = (hz, sites) if rising else (hz[::-1], sites[::-1])

    def sites(self, frequency_hz: Floats) -> Floats:
        """Places of some tones, in sites from the first row or column."""
        return np.interp(frequency_hz, self._hz, self._sites)


class Places:
    """The places of row and column tones as the optics make them, with what a calibration has to find.

    The grid says where each tone is meant to be. The truth differs from it by a common offset, a
    magnification, and an error of each tone (``settings.py``, ``mobile_light``).

    Args:
        grid: The grid of sites, with the frequencies that were meant before any calibration.
        light: The errors.
    """

    def __init__(self, grid: SiteGrid, light: MobileLightSettings) -> None:
        steps = np.concatenate([np.diff(grid.row_frequency_hz), np.diff(grid.column_frequency_hz)])
        lone_step_hz = float(steps.mean()) if len(steps) else 1.6e6
        self._maps = (
            FrequencyMap(grid.row_frequency_hz, lone_step_hz, "row"),
            FrequencyMap(grid.column_frequency_hz, lone_step_hz, "column"),
        )
        self._spacing_m = grid.spacing_m
        self._light = light
        along_row, from_row_to_row = light.offset
        centres = [(n - 1) / 2 for n in grid.shape]
        self._errors = [
            offset / grid.spacing_m + light.magnification_error * (np.arange(n) - centre)
            for offset, n, centre in zip((from_row_to_row, along_row), grid.shape, centres, strict=True)
        ]
        self._known = [error.copy() for error in self._errors]

    def draw(self, random: np.random.Generator) -> None:
        """Draw the errors of the tones; they belong to the machine."""
        for axis, known in enumerate(self._known):
            scatter = random.standard_normal(len(known)) * self._light.tone_error / self._spacing_m
            self._errors[axis] = known + scatter

    def meant(self, axis: int, frequency_hz: Floats) -> Floats:
        """Where the tones of the rows (axis 0) or columns (1) are meant to be, in sites."""
        return self._maps[axis].sites(frequency_hz)

    def sites(self, axis: int, frequency_hz: Floats) -> Floats:
        """Where the tones of the rows (axis 0) or columns (1) are, in sites."""
        meant, errors = self._maps[axis].sites(frequency_hz), self._errors[axis]
        if not errors.any():
            return meant
        return meant + np.interp(meant, np.arange(len(errors)), errors)
