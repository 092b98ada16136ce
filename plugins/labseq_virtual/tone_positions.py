"""Positions of the light of the mobile tweezers' tones, in sites."""

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
    """Frequency -> position along an axis, in sites. Extrapolated beyond the grid with the outermost step.

    Args:
        frequency_hz: float64 (n_sites,), rising or falling.
        lone_step_hz: Step to assume if there is only one site.
        axis: "row" or "column", for the error message.

    Raises:
        LimitError: The frequencies neither all rise nor all fall.
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
        """Positions of tones, in sites from the first row or column."""
        return np.interp(frequency_hz, self._hz, self._sites)


class TonePositions:
    """The true positions of row and column tones, with the errors that a calibration has to find.

    The grid gives the intended position of each tone. The true position follows from the machine's own tones,
    if the settings give them, a common offset, a magnification, and an error of each tone (``settings.py``,
    ``mobile_light``).
    """

    def __init__(self, grid: SiteGrid, light: MobileLightSettings) -> None:
        steps = np.concatenate([np.diff(grid.row_frequency_hz), np.diff(grid.column_frequency_hz)])
        lone_step_hz = float(steps.mean()) if len(steps) else 1.6e6
        self._maps = (
            FrequencyMap(grid.row_frequency_hz, lone_step_hz, "row"),
            FrequencyMap(grid.column_frequency_hz, lone_step_hz, "column"),
        )
        self._combs = light.row_tones, light.column_tones
        self._middle = [(n - 1) / 2 for n in grid.shape]
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
        """Draw the errors of the tones from the machine's random numbers."""
        for axis, known in enumerate(self._known):
            scatter = random.standard_normal(len(known)) * self._light.tone_error / self._spacing_m
            self._errors[axis] = known + scatter

    def intended(self, axis: int, frequency_hz: Floats) -> Floats:
        """Intended positions of tones of the rows (axis 0) or columns (axis 1), in sites."""
        return self._maps[axis].sites(frequency_hz)

    def actual(self, axis: int, frequency_hz: Floats) -> Floats:
        """True positions of tones of the rows (axis 0) or columns (axis 1), in sites."""
        comb, errors = self._combs[axis], self._errors[axis]
        if comb is None:
            place = self._maps[axis].sites(frequency_hz)
        else:
            place = self._middle[axis] + (frequency_hz - comb.centre) / comb.step
        if not errors.any():
            return place
        return place + np.interp(place, np.arange(len(errors)), errors)
