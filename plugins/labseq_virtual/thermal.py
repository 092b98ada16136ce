"""Atoms in thermal equilibrium in tweezers."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

WIDER: Final = np.array([2.2, 2.2, 4.0])
"""How much wider than the harmonic law positions are proposed: enough for a beam's weaker flanks."""
PROPOSALS: Final = 32
"""Proposals at once for each atom that is still to be placed; one in twenty is taken."""


def draw_atoms(
    depth: Floats, temperature: float, waist: float, rayleigh: float, rng: np.random.Generator
) -> Floats:
    """Draw atoms from the Boltzmann law of a Gaussian beam, as far as the beam binds them.

    Positions have the density ``exp(a) P(a)``, where ``a = -U / kT`` and
    ``P(a) = erf(sqrt(a)) - 2 sqrt(a / pi) exp(-a)`` is the part of the Maxwell law that is slow enough
    to be bound there. They are drawn by rejection from a wider Gaussian. Atoms drawn so stay
    distributed as they are; those of the harmonic law would breathe. In tweezers that are too shallow for
    the temperature they are as hot as half of the depth: hotter ones have evaporated.

    Args:
        depth: Depth of each atom's tweezer per mass, (n_atoms,), above 0.
        temperature: kT per mass.
        waist: 1/e^2 radius of the intensity.
        rayleigh: Rayleigh length.
        rng: Random numbers.

    Returns:
        Positions from the tweezers' foci, and velocities, (n_atoms, 6).
    """
    from scipy.special import erf

    kt = np.minimum(temperature, depth / 2)
    most = depth / kt
    size = np.array([waist, waist, rayleigh])
    spread = WIDER / np.sqrt(np.array([4.0, 4.0, 2.0]) * most[:, None])
    atoms = np.empty((len(depth), 6))
    bound = np.zeros(len(depth))
    left = np.arange(len(depth))
    while len(left):
        normal = rng.standard_normal((len(left), PROPOSALS, 3))
        place = normal * spread[left, None]
        s = 1.0 + place[..., 2] ** 2
        a = most[left, None] / s * np.exp(-2 * (place[..., 0] ** 2 + place[..., 1] ** 2) / s)
        slow = erf(np.sqrt(a)) - 2 * np.sqrt(a / np.pi) * np.exp(-a)
        weight = np.exp(a - most[left, None] + 0.5 * (normal**2).sum(axis=-1)) * slow
        taken = rng.random(weight.shape) < weight
        first = taken.argmax(axis=1)
        done = taken[np.arange(len(left)), first]
        atoms[left[done], :3] = place[done, first[done]] * size
        bound[left[done]] = a[done, first[done]]
        left = left[~done]
    left = np.arange(len(depth))
    while len(left):
        velocity = rng.standard_normal((len(left), 3))
        slow = 0.5 * (velocity**2).sum(axis=1) < bound[left]
        atoms[left[slow], 3:] = np.sqrt(kt[left[slow], None]) * velocity[slow]
        left = left[~slow]
    return atoms
