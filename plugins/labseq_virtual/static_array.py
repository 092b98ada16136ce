"""The depths of the static tweezers."""

from __future__ import annotations

from collections import Counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import DepthRamp, SiteGrid, TweezerAmplitudes
from labseq.plugin.simulation import ToneSource
from labseq_virtual.atoms import Atoms
from labseq_virtual.formulas import KELVIN, rayleigh_length
from labseq_virtual.settings import SimulationSettings

Floats = NDArray[np.float64]
Sites = NDArray[np.intp]


SLOWEST_S: Final = 10e-3
"""Longest simulated ramp, 90 periods along the beam at 300 uK. Slower ramps are as gentle (ours)."""
OFF: Final = 5e-3
"""Ratio of depths after and before a ramp below which no atom stays, due to gravity (not modelled, ours)."""
HOLDING: Final = 0.1
"""Depth, as a fraction of the nominal one, below which a static tweezer loads no atom, and loses its atom if
this depth was reached without a ramp (ours)."""


class StaticArray:
    """Depths of the static tweezers, as fractions of the nominal depth.

    At full power the depth of a site is the product of the powers of its row tone and its column tone, of
    the AODs' response to these tones (``tone_response``), and of the site's own disorder
    (``depth_disorder``), which no choice of amplitudes corrects. The power of a tone is proportional to its
    amplitude squared. Equal amplitudes that add up to full scale give the nominal depth. If no tones make
    the tweezers, the powers of the sites replace the product of tones and response.
    """

    def __init__(self, grid: SiteGrid, settings: SimulationSettings) -> None:
        self._grid, self._settings = grid, settings
        self._site: Floats = np.ones(grid.shape)
        self._response: tuple[Floats, Floats] = np.ones(grid.n_rows), np.ones(grid.n_cols)
        self._power: Floats = self._site
        self._level = 0.0
        self._is_blocked = False
        self._source: ToneSource | None = None

    def draw(self, random: np.random.Generator) -> None:
        """Draw the machine's disorder, with the light off and equal amplitudes."""
        n_rows, n_cols = self._grid.shape
        disorder = random.standard_normal((n_rows, n_cols))
        self._site = np.maximum(0.0, 1.0 + self._settings.depth_disorder * disorder)
        row, col = (
            np.exp(self._settings.tone_response * random.standard_normal(n)) for n in (n_rows, n_cols)
        )
        self._response = row, col
        self._power = np.outer(row, col)
        self._level = 0.0

    @property
    def depth(self) -> Floats:
        """Present depth of each site, float64 (n_rows, n_cols)."""
        return (0.0 if self._is_blocked else self._level) * self._site * self._power

    def holds(self) -> NDArray[np.bool_]:
        """Sites that are deep enough to hold an atom, bool (n_rows, n_cols)."""
        return self.depth >= HOLDING

    def switch_off(self) -> None:
        """Turn the light off and disconnect the outputs."""
        self._level, self._is_blocked = 0.0, False
        self._source = None

    def connect_outputs(self, source: ToneSource) -> None:
        """Make the depths follow the played signal of these outputs from now on."""
        self._power = np.zeros(self._grid.shape)
        self._source, self._level = source, 1.0

    def receive_until(self, until_s: float, atoms: Atoms, rng: np.random.Generator) -> Counter[str]:
        """Apply the output played until a time. In its releases atoms have the temperature of cooled atoms.

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
        """Set the amplitudes of the tones, or the powers of the sites."""
        if amplitudes.site is not None:
            self._power = amplitudes.site
            return
        tones = zip((amplitudes.row, amplitudes.column), self._response, strict=True)
        rows, cols = ((each * len(each)) ** 2 * response for each, response in tones)
        self._power = np.outer(rows, cols)

    def block(self, atoms: Atoms, *, is_blocked: bool) -> int:
        """Block the light by a line that turns it off, or let the light pass.

        Returns:
            Number of atoms lost.
        """
        if is_blocked == self._is_blocked:
            return 0
        self._is_blocked = is_blocked
        return atoms.lose(~self.holds())

    def release(self, dark_s: float, atoms: Atoms, rng: np.random.Generator) -> int:
        """Let the atoms fly while the light is off, and recapture those that the same tweezer then binds.

        Atoms fly straight, without gravity and neighbouring tweezers.

        Args:
            dark_s: Time without light.
            atoms: The atoms. Changed in place.
            rng: Random numbers of the shot.

        Returns:
            Number of atoms lost.
        """
        row, col = np.nonzero(atoms.occupied & (self.depth > 0))
        state, depth, level = self._draw(atoms, row, col, rng)
        waist, rayleigh = self._beam
        x, y, z = (state[:, :3] + dark_s * state[:, 3:]).T
        width = 1 + (z / rayleigh) ** 2
        light = depth / width * np.exp(-2 * (x**2 + y**2) / (waist**2 * width))
        kinetic = 0.5 * (state[:, 3:] ** 2).sum(axis=1)
        bound = kinetic < light
        atoms.occupied[row, col] = bound
        atoms.heat[row, col] = np.maximum(kinetic + depth - light, 0.0) / 3 / KELVIN / np.sqrt(level)
        return int(np.count_nonzero(~bound))

    def ramp(self, ramp: DepthRamp, atoms: Atoms, rng: np.random.Generator) -> int:
        """Change the depth, lose atoms too hot for shallower tweezers, and return their number."""
        before = np.count_nonzero(atoms.occupied)
        for start, end, duration_s in (
            (self._level, ramp.start, 0.0),
            (ramp.start, ramp.end, ramp.duration_s),
        ):
            self._level = start
            if end < start:
                self._lower(end / start, duration_s, atoms, rng)
            self._level = end
        return int(before - np.count_nonzero(atoms.occupied))

    def _lower(self, fraction: float, duration_s: float, atoms: Atoms, rng: np.random.Generator) -> None:
        """Let atoms fly while their tweezers become shallower, and lose the unbound ones at the end."""
        from labseq_virtual.atom_kernels import ramp_atoms
        from labseq_virtual.flight_kernels import COLDEST

        atoms.occupied &= (self.depth > 0) & (fraction > OFF)
        row, col = np.nonzero(atoms.occupied)
        state, depth, level = self._draw(atoms, row, col, rng)
        before = ramp_atoms(state, depth, 1.0, 0.0, *self._beam) + depth
        after = ramp_atoms(state, depth, fraction, min(duration_s, SLOWEST_S), *self._beam)
        atoms.occupied[row, col] = after < 0
        # the energy is proportional to the trap frequency if the change is slow
        change = (after + fraction * depth) / np.sqrt(max(fraction, 1e-12)) - before
        heat = atoms.heat[row, col]
        atoms.heat[row, col] = np.maximum(heat + change / 3 / KELVIN / np.sqrt(level), COLDEST * heat)

    @property
    def _beam(self) -> tuple[float, float]:
        """Waist and Rayleigh length."""
        waist = self._settings.static_waist
        return waist, rayleigh_length(waist, self._settings.static_wavelength)

    def _draw(
        self, atoms: Atoms, row: Sites, col: Sites, rng: np.random.Generator
    ) -> tuple[Floats, Floats, Floats]:
        """Draw atoms in their tweezers. Also returns depths per mass, and relative to the nominal depth."""
        from labseq_virtual.atom_kernels import draw_atoms

        level = self.depth[row, col]
        depth = KELVIN * self._settings.static_depth * level
        return (
            draw_atoms(depth, KELVIN * atoms.heat[row, col] * np.sqrt(level), *self._beam, rng),
            depth,
            level,
        )
