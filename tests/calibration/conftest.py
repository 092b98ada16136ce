"""Labs whose profile differs from what their simulation does, and atoms for fits of the overlay."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import erfc

from labseq.calibration.measure import METHODS, CalibrationRequest, Outcome, calibrate
from labseq.calibration_store import Store
from labseq.model import SiteGrid
from labseq.testing.fakes import RecordingObserver

Floats = NDArray[np.float64]

HEAD = """labseq: 1
name: lab
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
"""


class Lab:
    """A folder with a profile, its calibrations and its data."""

    def __init__(self, folder: Path, profile: str) -> None:
        folder.mkdir(exist_ok=True)
        self.folder, self.profile = folder, folder / "lab.yaml"
        self.store = Store(folder / "calibrations" / "lab")
        self.observer = RecordingObserver()
        self.write_profile(profile)

    def write_profile(self, text: str) -> None:
        self.profile.write_text(HEAD + text, "utf-8")

    def calibrate(self, kind: str, **changes: Any) -> Outcome:
        changes = {"output": self.folder / "data", "seed": 1} | changes
        request = CalibrationRequest(str(self.profile), **changes)
        return calibrate(METHODS[kind], request, self.observer)


@pytest.fixture(autouse=True)
def unencoded(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are composed, but not rendered, except for tests that ask for ``rendered``."""
    if "rendered" not in request.fixturenames:
        encode = "labseq.calibration.measure.encode_figure"
        monkeypatch.setattr(encode, lambda draw, **_: b"png" if draw() else b"")


@pytest.fixture
def rendered() -> None:
    """Pictures are those that users get."""


@pytest.fixture(scope="session")
def make_lab() -> Callable[[Path, str], Lab]:
    return Lab


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
