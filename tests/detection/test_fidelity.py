"""How many errors the detectors make on the virtual lab's frames, beside the least that anyone could make.

``LABSEQ_FRAMES=2500 pytest -s tests/detection/test_fidelity.py --numprocesses=0`` prints the figures of
``docs/explanation/detection.md``. Each detector has the threshold of fewest errors: the least mean of
the fractions of atoms missed and of empty sites taken for full. Atoms lost during the exposure do not count.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pytest
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation
from numpy.typing import NDArray
from scipy.sparse import csr_array

from labseq.detection.sites import known_sites, region_corners
from labseq.detection.spots import spot_light
from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq.detection.weighted import WeightedDetector, WeightedSettings
from labseq.plugin import Context, DepthRamp, Frame, RandomStream, SiteGrid

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

N_FRAMES = int(os.environ.get("LABSEQ_FRAMES", "100"))
PLACE: dict[str, Any] = {"frame": (240, 400), "centre_px": (119.5, 199.5)}
CASES = {"4.49 um": (4.49e-6, 0.42e-6), "2.5 um": (2.5e-6, 0.525e-6), "2.0 um": (2.0e-6, 0.525e-6)}
SHAPES: tuple[Literal["square", "disc"], ...] = ("square", "disc")
IN_SUITE = [*CASES] if "LABSEQ_FRAMES" in os.environ else ["4.49 um", "2.0 um"]
MOST = {"4.49 um": 0.8, "2.5 um": 0.5, "2.0 um": 0.5}


@dataclass
class Errors:
    """At the best threshold, and at that of the settings."""

    threshold: float
    missed: int
    imagined: int
    n_atoms: int
    n_empty: int

    @property
    def mean(self) -> float:
        return (self.missed / self.n_atoms + self.imagined / self.n_empty) / 2

    def __str__(self) -> str:
        return (
            f"at {self.threshold:7.1f}: {self.missed:5d} of {self.n_atoms} missed, {self.imagined:5d} of "
            f"{self.n_empty} imagined, mean {self.mean * 1e4:6.3f}e-4"
        )


def exposures(spacing: float, spot: float, n_frames: int) -> Iterator[tuple[Frame, Bools, Bools]]:
    """Frame, atoms that survived it, atoms before it."""
    random = RandomStream(2026)
    settings = SimulationSettings.model_validate({"image": PLACE | {"spot": spot}})
    simulation = VirtualSimulation(
        settings, Context("simulation", SiteGrid(spacing_m=spacing), random=random)
    )
    simulation.open()
    simulation.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    for shot in range(n_frames):
        random.begin_shot(shot, 0)
        simulation.begin_shot()
        simulation.load(0.0, 0.5)
        before = simulation.truth()
        yield simulation.expose(0.5, 45e-3), before & simulation.truth(), before


def at(statistic: Floats, atoms: Bools, empty: Bools, threshold: float) -> Errors:
    missed, imagined = (statistic <= threshold) & atoms, (statistic > threshold) & empty
    return Errors(threshold, *(int(x.sum()) for x in (missed, imagined, atoms, empty)))


def at_best(statistic: Floats, atoms: Bools, empty: Bools) -> Errors:
    with_atom, without = np.sort(statistic[atoms]), np.sort(statistic[empty])
    n = len(without) // 5
    candidates = np.concatenate([with_atom[:n], without[-n:]])
    missed = np.searchsorted(with_atom, candidates, "right") / len(with_atom)
    imagined = 1 - np.searchsorted(without, candidates, "right") / len(without)
    return at(statistic, atoms, empty, float(candidates[np.argmin(missed + imagined)]))


class Ideal:
    """Exact likelihood ratio of all pixels around a site, with the neighbours' atoms known.

    Its law of the counts is the Fourier transform of the characteristic function, on a fine
    ladder of lights: nothing of the detector's own work is used.
    """

    N = 8192

    def __init__(self, spacing: float, spot: float) -> None:
        settings = WeightedSettings(**PLACE, region=11)
        known = known_sites(settings, Context("detector", SiteGrid(spacing_m=spacing)))
        sites, self.corners = known.positions_px.reshape(-1, 2), region_corners(known, settings.region)
        n, w = len(sites), settings.region
        lit = [
            60.0 * spot_light(np.tile(site, (n, 1)), self.corners, w, spot / settings.pixel_size)
            for site in sites
        ]
        light = np.stack(lit).reshape(n, n, w * w)  # atom, site, pixel
        self.own = light[np.arange(n), np.arange(n)].copy()
        light[np.arange(n), np.arange(n)] = 0.0
        self.light = csr_array(np.where(light > 1e-9, light, 0.0).reshape(n, -1))
        self.ladder = 0.375 + np.concatenate([[0.0], np.geomspace(1e-3, 60.0, 400)])
        self.log_p = np.stack([self.law(lam) for lam in self.ladder])
        dy, dx = np.indices((w, w)).reshape(2, -1)
        self.pixels = (self.corners[:, :1] + dy) * 400 + self.corners[:, 1:] + dx

    def law(self, lam: float) -> Floats:
        """Log-probability of the counts 0 to N; beyond what doubles resolve, a straight line."""
        t = 2 * np.pi * np.fft.rfftfreq(self.N)
        transform = lam * (1 / (1 + 60j * t) - 1) - (16.0 * t) ** 2 / 2 - 500j * t
        p = np.fft.irfft(np.exp(transform) * np.sinc(t / 2 / np.pi), self.N)
        solid = np.flatnonzero(p > 1e-11)
        low, high = solid[0], solid[-1]
        log_p = np.log(np.maximum(p, 1e-300))
        slope = (log_p[high] - log_p[high - 50]) / 50
        log_p[high:] = log_p[high] + slope * np.arange(self.N - high)
        log_p[:low] = log_p[low]
        return log_p

    def at_light(self, lam: Floats, counts: NDArray[np.int64]) -> Floats:
        place = np.interp(lam, self.ladder, np.arange(len(self.ladder)))
        below = np.minimum(place.astype(int), len(self.ladder) - 2)
        part = place - below
        return self.log_p[below, counts] * (1 - part) + self.log_p[below + 1, counts] * part

    def log_odds(self, frame: Frame, before: Bools) -> Floats:
        counts = np.minimum(frame.image.ravel()[self.pixels], self.N - 1).astype(np.int64)
        dark = 0.375 + (before.ravel() @ self.light).reshape(self.own.shape)
        ratio = self.at_light(dark + self.own, counts) - self.at_light(dark, counts)
        return ratio.sum(axis=1).reshape(before.shape)


def sums(spacing: float) -> dict[str, ThresholdDetector]:
    """The threshold detector with regions of all shapes that could be the best."""
    return {
        f"{shape} {region}": ThresholdDetector(
            ThresholdSettings(**PLACE, region=region, shape=shape, threshold=0.0),
            Context("detector", SiteGrid(spacing_m=spacing)),
        )
        for shape in SHAPES
        for region in (3, 5, 7)
    }


def weights(spacing: float, spot: float, **settings: Any) -> WeightedDetector:
    given: dict[str, Any] = PLACE | {"spot": spot} | settings
    known = WeightedSettings(**given)
    return WeightedDetector(known, Context("detector", SiteGrid(spacing_m=spacing)))


def variants(spacing: float, spot: float) -> dict[str, WeightedDetector]:
    """A linear filter, and settings that are off by what may happen in a lab."""
    changes: dict[str, dict[str, Any]] = {
        "linear": {"em_register": False},
        "photoelectrons + 20 %": {"photoelectrons": 72.0},
        "background + 20 %": {"background": 0.45},
        "gain + 20 %": {"counts_per_photoelectron": 72.0},
        "spot + 20 %": {"spot": spot * 1.2},
        "offset + 3 counts": {"offset": 503.0},
        "filling 0.5": {"filling": 0.5},
        "sites + 0.5 px": {"centre_px": (119.5, 200.0)},
    }
    return {what: weights(spacing, **({"spot": spot} | change)) for what, change in changes.items()}


@pytest.mark.parametrize("case", IN_SUITE)
def test_weighted_makes_fewer_errors_than_the_best_threshold(case: str) -> None:
    spacing, spot = CASES[case]
    thorough = "LABSEQ_FRAMES" in os.environ
    regions, weighted = sums(spacing), {"weighted": weights(spacing, spot)}
    ideal = Ideal(spacing, spot) if thorough else None
    if thorough:
        weighted |= variants(spacing, spot)
    found: dict[str, list[Floats]] = {}
    survived, before_all = list[Bools](), list[Bools]()
    for frame, atoms, before in exposures(spacing, spot, N_FRAMES):
        survived.append(atoms)
        before_all.append(before)
        for name, region in regions.items():
            found.setdefault(name, []).append(region.signals(frame))
        for name, detector in weighted.items():
            found.setdefault(name, []).append(detector.signals(frame))
        if ideal is not None:
            found.setdefault("ideal", []).append(ideal.log_odds(frame, before))
    truth = np.stack(survived), ~np.stack(before_all)
    errors = {name: at_best(np.stack(values), *truth) for name, values in found.items()}
    as_set = at(np.stack(found["weighted"]), *truth, 0.0)
    print(f"\nspacing {case}, spot {spot * 1e6:.3f} um, {N_FRAMES} frames")
    for name, error in (*errors.items(), ("as set", as_set)):
        print(f"{name:>22} {error}")
    if thorough:
        lines = [(name, 0.0) for name in (*weighted, "ideal")]
        lines += [("weighted", -1.0), ("weighted", -2.0), ("weighted", -3.0), ("square 5", 1630.0)]
        for name, threshold in lines:
            print(f"{name:>22} {at(np.stack(found[name]), *truth, threshold)}")
    best_region = min(errors[name].mean for name in regions)
    assert errors["weighted"].mean <= MOST[case] * best_region
    assert as_set.mean <= MOST[case] * best_region
