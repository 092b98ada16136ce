"""The static tweezers' depths, site by site."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import DepthRamp, SiteGrid, ToneSource, TweezerAmplitudes
from labseq_virtual.settings import WorldSettings

Floats = NDArray[np.float64]


class StaticArray:
    """Depths of all sites, as fractions of the nominal one.

    At full light the depth of a site is the product of its row's and its column's power, of what the AODs
    make of these two tones (``tone_response``), and of the site's own disorder (``depth_disorder``), which
    no choice of amplitudes mends. The power of a tone goes as its amplitude squared; equal amplitudes that
    reach full scale together give the nominal depth.

    Args:
        grid: The grid of sites.
        settings: The constants.
    """

    def __init__(self, grid: SiteGrid, settings: WorldSettings) -> None:
        self._grid, self._settings = grid, settings
        self._site: Floats = np.ones(grid.shape)
        self._response: tuple[Floats, Floats] = np.ones(grid.n_rows), np.ones(grid.n_cols)
        self._power: tuple[Floats, Floats] = self._response
        self._level = 0.0
        self._source: ToneSource | None = None

    def draw(self, random: np.random.Generator) -> None:
        """Draw the disorder of the machine; all light off, amplitudes equal."""
        n_rows, n_cols = self._grid.shape
        disorder = random.standard_normal((n_rows, n_cols))
        self._site = np.maximum(0.0, 1.0 + self._settings.depth_disorder * disorder)
        row, col = (
            np.exp(self._settings.tone_response * random.standard_normal(n)) for n in (n_rows, n_cols)
        )
        self._response = row, col
        self._power = np.ones(n_rows), np.ones(n_cols)
        self._level = 0.0

    @property
    def depth(self) -> Floats:
        """Depth of each site now, float64 (n_rows, n_cols)."""
        rows, cols = (power * response for power, response in zip(self._power, self._response, strict=True))
        return self._level * self._site * rows[:, None] * cols

    def holds(self) -> NDArray[np.bool_]:
        """Which sites are deep enough to hold an atom, bool (n_rows, n_cols)."""
        return self.depth >= self._settings.lost_below_depth

    def switch_off(self) -> None:
        """No light, and nobody to listen to."""
        self._level = 0.0
        self._source = None

    def connect_outputs(self, source: ToneSource) -> None:
        """From now on the light is what these outputs play."""
        rows, cols = self._grid.shape
        self.drive(TweezerAmplitudes(np.zeros(rows), np.zeros(cols)))
        self._source, self._level = source, 1.0

    def receive_until(self, until_s: float, occupied: NDArray[np.bool_]) -> int:
        """Follow what the outputs played; atoms in too shallow tweezers are gone from ``occupied``.

        Returns:
            How many were lost.
        """
        before = np.count_nonzero(occupied)
        for amplitudes in () if self._source is None else self._source.played(until_s):
            self.drive(amplitudes)
            occupied &= self.holds()
        return int(before - np.count_nonzero(occupied))

    def drive(self, amplitudes: TweezerAmplitudes) -> None:
        """Take over the amplitudes of the tones."""
        rows, cols = amplitudes.row, amplitudes.column
        self._power = (rows * len(rows)) ** 2, (cols * len(cols)) ** 2

    def ramp(self, ramp: DepthRamp, occupied: NDArray[np.bool_]) -> int:
        """Change the depth; atoms in tweezers that become too shallow are gone from ``occupied``.

        Returns:
            How many were lost.
        """
        before = np.count_nonzero(occupied)
        for level in (ramp.start, ramp.end):
            self._level = level
            occupied &= self.holds()
        return int(before - np.count_nonzero(occupied))
