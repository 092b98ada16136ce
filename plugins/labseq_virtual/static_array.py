"""The depths of the static tweezers."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import DepthRamp, SiteGrid, ToneSource, TweezerAmplitudes
from labseq_virtual.flight import KELVIN, draw_atoms
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
        self._is_blocked = False
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
        return (0.0 if self._is_blocked else self._level) * self._site * rows[:, None] * cols

    def holds(self) -> NDArray[np.bool_]:
        """Which sites are deep enough to hold an atom, bool (n_rows, n_cols)."""
        return self.depth >= self._settings.lost_below_depth

    def switch_off(self) -> None:
        """Turn the light off and disconnect the outputs."""
        self._level, self._is_blocked = 0.0, False
        self._source = None

    def connect_outputs(self, source: ToneSource) -> None:
        """From now on the depths follow what these outputs play."""
        rows, cols = self._grid.shape
        self._power = np.zeros(rows), np.zeros(cols)
        self._source, self._level = source, 1.0

    def receive_until(
        self, until_s: float, occupied: NDArray[np.bool_], rng: np.random.Generator
    ) -> Counter[str]:
        """Apply the output played until a time; atoms that are lost leave ``occupied``.

        Returns:
            Number of atoms lost in tweezers that were too shallow ("light"), and in releases ("release").
        """
        lost: Counter[str] = Counter()
        for amplitudes in () if self._source is None else self._source.played(until_s):
            if amplitudes.dark_s:
                lost["release"] += self.release(amplitudes.dark_s, occupied, rng)
            self.drive(amplitudes)
            before = np.count_nonzero(occupied)
            occupied &= self.holds()
            lost["light"] += int(before - np.count_nonzero(occupied))
        return lost

    def drive(self, amplitudes: TweezerAmplitudes) -> None:
        """Set the amplitudes of the tones."""
        rows, cols = amplitudes.row, amplitudes.column
        self._power = (rows * len(rows)) ** 2, (cols * len(cols)) ** 2

    def block(self, occupied: NDArray[np.bool_], *, is_blocked: bool) -> int:
        """Block the light by a line that turns it off, or let it pass.

        Returns:
            Number of atoms lost.
        """
        if is_blocked == self._is_blocked:
            return 0
        before, self._is_blocked = np.count_nonzero(occupied), is_blocked
        occupied &= self.holds()
        return int(before - np.count_nonzero(occupied))

    def release(self, dark_s: float, occupied: NDArray[np.bool_], rng: np.random.Generator) -> int:
        """Let the atoms fly while the light is off, and recapture those that the same tweezer then binds.

        Atoms begin with the temperature of the settings and fly straight on: gravity and neighbouring
        tweezers are left out.

        Returns:
            Number of atoms lost.
        """
        settings = self._settings
        row, col = np.nonzero(occupied & self.holds())
        depth = KELVIN * settings.static_depth * self.depth[row, col]
        waist = settings.static_waist
        rayleigh = np.pi * waist**2 / settings.static_wavelength
        state = draw_atoms(depth, KELVIN * settings.temperature, waist, rayleigh, rng)
        x, y, z = (state[:, :3] + dark_s * state[:, 3:]).T
        width = 1 + (z / rayleigh) ** 2
        light = depth / width * np.exp(-2 * (x**2 + y**2) / (waist**2 * width))
        bound = 0.5 * (state[:, 3:] ** 2).sum(axis=1) < light
        occupied[row, col] = bound
        return int(np.count_nonzero(~bound))

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
