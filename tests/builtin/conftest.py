from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import erfc

from labseq.model import SiteGrid

Floats = NDArray[np.float64]


class Atoms:
    """Atoms in sites of 300 uK, probed by deeper tweezers that let go at once; not the fit's law.

    An atom dropped at a distance d has the energy U (1 - exp(-2 d^2 / w^2)) beside its kinetic one, of
    42 uK, and is lost if both exceed U. From 1.55 um on it is not taken.
    """

    def survival(self, distance_m: Floats) -> Floats:
        left = 300.0 / 42.0 * np.exp(-2 * distance_m**2 / 0.98e-6**2)
        fast = erfc(np.sqrt(left)) + 2 * np.sqrt(left / np.pi) * np.exp(-left)
        return 0.004 + 0.99 * np.where(distance_m < 1.55e-6, 0.975 * (1 - fast), 1.0)

    def survival_at(self, offset_m: Floats, hidden_m: Floats, grid: SiteGrid) -> Floats:
        """Survival at a commanded offset, where the tweezers stand beside the sites by a hidden one."""
        place = (offset_m + hidden_m) @ (grid.axes / grid.spacing_m)
        return self.survival(np.hypot(place[..., 0], place[..., 1]))

    def scan(self, reach_m: float = 1.4e-6, n_each: int = 15) -> Floats:
        """Offsets along both axes, (n_points, 2)."""
        along = np.linspace(-reach_m, reach_m, n_each)
        zero = np.zeros_like(along)
        return np.concatenate([np.stack([along, zero], 1), np.stack([zero, along], 1)])


@pytest.fixture(scope="session")
def atoms() -> Atoms:
    return Atoms()
