"""The depths of the static tweezers."""

from __future__ import annotations

from collections import Counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import DepthRamp, SiteGrid, TweezerAmplitudes
from labseq.plugin.simulation import ToneSource
from labseq_virtual.atoms import Atoms
from labseq_virtual.flight import KELVIN, draw_atoms
from labseq_virtual.responses import lowering
from labseq_virtual.settings import SimulationSettings

Floats = NDArray[np.float64]


HOLDING: Final = 0.1
"""Depth, as a fraction of the nominal one, below which a static tweezer loads no atom, and loses its own if
it came there without a ramp (ours)."""


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
        return self.depth >= HOLDING

    def switch_off(self) -> None:
        """Turn the light off and disconnect the outputs."""
        self._level, self._is_blocked = 0.0, False
        self._source = None

    def connect_outputs(self, source: ToneSource) -> None:
        """From now on the depths follow what these outputs play."""
        rows, cols = self._grid.shape
        self._power = np.zeros(rows), np.zeros(cols)
        self._source, self._level = source, 1.0

    def receive_until(self, until_s: float, atoms: Atoms, rng: np.random.Generator) -> Counter[str]:
        """Apply the output played until a time; in a release of it atoms have the temperature of cooled ones.

        Returns:
            Number of atoms lost in tweezers that were too shallow ("light"), and in releases ("release").
        """
        lost: Counter[str] = Counter()
        for amplitudes in () if self._source is None else self._source.played(until_s):
            if amplitudes.dark_s:
                cooled = Atoms(atoms.occupied, self._settings.temperature)
                lost["release"] += self.release(amplitudes.dark_s, cooled, rng)
            self.drive(amplitudes)
            lost["light"] += atoms.lose(~self.holds())
        return lost

    def drive(self, amplitudes: TweezerAmplitudes) -> None:
        """Set the amplitudes of the tones."""
        rows, cols = amplitudes.row, amplitudes.column
        self._power = (rows * len(rows)) ** 2, (cols * len(cols)) ** 2

    def block(self, atoms: Atoms, *, is_blocked: bool) -> int:
        """Block the light by a line that turns it off, or let it pass.

        Returns:
            Number of atoms lost.
        """
        if is_blocked == self._is_blocked:
            return 0
        self._is_blocked = is_blocked
        return atoms.lose(~self.holds())

    def release(self, dark_s: float, atoms: Atoms, rng: np.random.Generator) -> int:
        """Let the atoms fly while the light is off, and recapture those that the same tweezer then binds.

        Atoms fly straight on: gravity and neighbouring tweezers are left out.

        Args:
            dark_s: How long the light is off.
            atoms: The atoms; changed in place.
            rng: Random numbers of the shot.

        Returns:
            Number of atoms lost.
        """
        settings, heat = self._settings, atoms.heat
        row, col = np.nonzero(atoms.occupied & (self.depth > 0))
        level = self.depth[row, col]
        depth = KELVIN * settings.static_depth * level
        waist = settings.static_waist
        rayleigh = np.pi * waist**2 / settings.static_wavelength
        state = draw_atoms(depth, KELVIN * heat[row, col] * np.sqrt(level), waist, rayleigh, rng)
        x, y, z = (state[:, :3] + dark_s * state[:, 3:]).T
        width = 1 + (z / rayleigh) ** 2
        light = depth / width * np.exp(-2 * (x**2 + y**2) / (waist**2 * width))
        kinetic = 0.5 * (state[:, 3:] ** 2).sum(axis=1)
        bound = kinetic < light
        atoms.occupied[row, col] = bound
        heat[row, col] = np.maximum(kinetic + depth - light, 0.0) / 3 / KELVIN / np.sqrt(level)
        return int(np.count_nonzero(~bound))

    def ramp(self, ramp: DepthRamp, atoms: Atoms, rng: np.random.Generator) -> int:
        """Change the depth; atoms too hot for tweezers that become shallower are lost; returns how many."""
        occupied, heat = atoms.occupied, atoms.heat
        before = np.count_nonzero(occupied)
        for start, end, duration_s in (
            (self._level, ramp.start, 0.0),
            (ramp.start, ramp.end, ramp.duration_s),
        ):
            self._level = start
            row, col = np.nonzero(occupied)
            level = self.depth[row, col]
            self._level = end
            if end < start and len(row):
                temperature = heat[row, col] * np.sqrt(level)
                depth = np.maximum(self._settings.static_depth * level, 1e-12)
                loss, warmer = lowering(end / start, duration_s, depth, temperature)
                occupied[row, col] = (rng.random(len(row)) >= loss) & (level > 0)
                heat[row, col] *= warmer
        return int(before - np.count_nonzero(occupied))
