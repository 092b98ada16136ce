"""The depths of the static tweezers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import DepthRamp, SiteGrid, ToneSource, TweezerAmplitudes
from labseq_virtual.settings import SimulationSettings

Floats = NDArray[np.float64]


class StaticArray:
    """Depths of the static tweezers, as fractions of the nominal depth.

    At full power the depth of a site is the product of the powers of its row tone and its column tone, of
    the AODs' response to these tones (``tone_response``), and of the site's own disorder
    (``depth_disorder``), which no choice of amplitudes corrects. The power of a tone is proportional to its
    amplitude squared; equal amplitudes that add up to full scale give the nominal depth.
    """

    def __init__(self, grid: SiteGrid, settings: SimulationSettings) -> None:
        self._grid, self._settings = grid, settings
        self._site: Floats = np.ones(grid.shape)
        self._response: tuple[Floats, Floats] = np.ones(grid.n_rows), np.ones(grid.n_cols)
        self._power: tuple[Floats, Floats] = self._response
        self._level = 0.0
        self._source: ToneSource | None = None

    def draw(self, random: np.random.Generator) -> None:
        """Draw the machine's disorder; the light is off, the amplitudes are equal."""
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
        """Turn the light off and disconnect the outputs."""
        self._level = 0.0
        self._source = None

    def connect_outputs(self, source: ToneSource) -> None:
        """From now on the depths follow what these outputs play."""
        rows, cols = self._grid.shape
        self.drive(TweezerAmplitudes(np.zeros(rows), np.zeros(cols)))
        self._source, self._level = source, 1.0

    def receive_until(self, until_s: float, occupied: NDArray[np.bool_]) -> int:
        """Apply the output played until a time; atoms in tweezers that become too shallow leave ``occupied``.

        Returns:
            Number of atoms lost.
        """
        before = np.count_nonzero(occupied)
        for amplitudes in () if self._source is None else self._source.played(until_s):
            self.drive(amplitudes)
            occupied &= self.holds()
        return int(before - np.count_nonzero(occupied))

    def drive(self, amplitudes: TweezerAmplitudes) -> None:
        """Set the amplitudes of the tones."""
        rows, cols = amplitudes.row, amplitudes.column
        self._power = (rows * len(rows)) ** 2, (cols * len(cols)) ** 2

    def ramp(self, ramp: DepthRamp, occupied: NDArray[np.bool_]) -> int:
        """Change the depth; atoms in tweezers that become too shallow leave ``occupied``.

        Returns:
            Number of atoms lost.
        """
        before = np.count_nonzero(occupied)
        for level in (ramp.start, ramp.end):
            self._level = level
            occupied &= self.holds()
        return int(before - np.count_nonzero(occupied))
