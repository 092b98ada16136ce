"""The two levels of each atom, driven by pulses, and the light that removes atoms in the upper one.

Optical Bloch equations in the frame of the drive, with (u, v, w) of each site. w is -1 in the lower level and
1 in the upper one::

    du/dt = -u / T2 - D v + R sin(p) w
    dv/dt = D u - v / T2 - R cos(p) w
    dw/dt = -R sin(p) u + R cos(p) v - w / T1

with the detuning D of the drive from the atom, the Rabi frequency R and the phase p of the drive, both
frequencies times 2 pi. Between two edges of the lines everything is constant, and the solution is the
exponential of a matrix. T1 leads to equal populations, as scattering of trap light does between hyperfine
levels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import LineProgram
from labseq_virtual.atoms import Atoms
from labseq_virtual.settings import QubitSettings

Floats = NDArray[np.float64]

N_TERMS = 13
"""Terms of the Taylor series, enough for 1e-15 where the exponent has a norm of at most 1/2."""


class Qubits:
    """The states of the atoms on all sites since they were last prepared in the lower level.

    Args:
        shape: (n_rows, n_cols).
        t_s: Time when the atoms were prepared, on the session's clock.
        rng: Random numbers of the shot.

    Attributes:
        t_s: The time of the states.
    """

    def __init__(
        self, settings: QubitSettings, shape: tuple[int, int], t_s: float, rng: np.random.Generator
    ) -> None:
        self.t_s = t_s
        self._settings, self._rng = settings, rng
        self._bloch: Floats = np.zeros((*shape, 3))
        self._bloch[..., 2] = 1 - 2 * settings.preparation
        spread = settings.detuning_spread
        self._offsets_hz: Floats = spread * rng.standard_normal(shape) if spread else np.zeros((1, 1))

    @property
    def upper(self) -> Floats:
        """Probability that an atom is in the upper level, float64 (n_rows, n_cols)."""
        return (1 + self._bloch[..., 2]) / 2

    def play(self, program: LineProgram, t_start_s: float, source: Mapping[str, float], atoms: Atoms) -> int:
        """Apply a program of the lines.

        Args:
            t_start_s: Start of the program on the session's clock.
            source: "frequency" in Hz, "phase" and "shift" in rad of the drive.
            atoms: The atoms. Changed in place.

        Returns:
            Number of atoms that the push-out light has removed.
        """
        settings, n_lost = self._settings, 0
        detuning_hz = source["frequency"] - settings.transition - self._offsets_hz
        exponentials: dict[tuple[float, float | None], Floats] = {}
        waited_s = max(0.0, t_start_s - self.t_s)
        for duration_s, on in ((waited_s, frozenset[str]()), *_between_edges(program)):
            phase = source["phase"] + (source["shift"] if settings.quadrature in on else 0.0)
            key = round(duration_s, 12), phase if settings.drive in on else None
            if key not in exponentials:  # the pulses of a block are the same each time
                exponentials[key] = exponential(self._rates(detuning_hz, key[1]) * duration_s)
            self._bloch = np.einsum("...ij,...j->...i", exponentials[key], self._bloch)
            if settings.push_out in on:
                n_lost += self._push_out(duration_s, atoms)
        self.t_s = t_start_s + program.duration_s
        return n_lost

    def _rates(self, detuning_hz: Floats, phase: float | None) -> Floats:
        """The matrix of the equations (..., 3, 3), in 1/s. Without a phase there is no drive."""
        rabi = 0.0 if phase is None else 2 * math.pi * self._settings.rabi_frequency
        x, y = (rabi * part(phase or 0.0) for part in (math.cos, math.sin))
        rates = np.zeros((*detuning_hz.shape, 3, 3))
        rates[...] = [[0, 0, y], [0, 0, -x], [-y, x, 0]]
        rates[..., 1, 0] = 2 * math.pi * detuning_hz
        rates[..., 0, 1] = -rates[..., 1, 0]
        t1_s, t2_s = self._settings.relaxation_time, self._settings.coherence_time
        return rates - np.diag([1 / t2_s, 1 / t2_s, 1 / t1_s])

    def _push_out(self, duration_s: float, atoms: Atoms) -> int:
        """Remove atoms, mostly from the upper level. The remaining atoms are not in a superposition."""
        times_s = np.array([self._settings.push_out_time, self._settings.push_out_time_other])
        stay = np.exp(-duration_s / times_s)
        upper, lower = self.upper * stay[0], (1 - self.upper) * stay[1]
        self._bloch[..., :2] = 0.0
        self._bloch[..., 2] = (upper - lower) / np.maximum(upper + lower, 1e-300)  # 0 without atoms
        return atoms.lose(self._rng.random(atoms.occupied.shape) >= upper + lower)


def _between_edges(program: LineProgram) -> Iterator[tuple[float, frozenset[str]]]:
    """Duration between two edges, and the lines that are on."""
    ends = [*program.t_s.tolist(), max(program.duration_s, float(program.t_s[-1]))]
    for (start_s, end_s), on in zip(pairwise(ends), program.on.tolist(), strict=True):
        yield end_s - start_s, frozenset(line for line, is_on in zip(program.lines, on, strict=True) if is_on)


def exponential(matrices: Floats) -> Floats:
    """Exponentials of matrices (..., n, n), by a Taylor series of a fraction that is then squared repeatedly.

    Example:
        >>> quarter = exponential(np.array([[0.0, -1.0], [1.0, 0.0]]) * np.pi / 2)
        >>> np.abs(np.round(quarter, 12)).tolist()
        [[0.0, 1.0], [1.0, 0.0]]
    """
    norm = float(np.abs(matrices).sum(axis=-1).max())
    n_squarings = max(0, math.ceil(math.log2(2 * norm))) if norm else 0
    part = matrices / 2**n_squarings
    term = total = np.broadcast_to(np.eye(matrices.shape[-1]), matrices.shape)
    for n in range(1, N_TERMS + 1):
        term = term @ part / n
        total = total + term
    for _ in range(n_squarings):
        total = total @ total
    return total
