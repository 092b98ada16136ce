"""A morning on the practice lab: all that it hides is found from scratch, and held against the truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from labseq_virtual.images import site_spots
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation
from numpy.typing import NDArray

import labseq
from labseq.builtin.equalise import factors
from labseq.calibration.measure import METHODS, CalibrationRequest, calibrate
from labseq.config.profile import load_profile
from labseq.detection.sites import known_sites, region_corners
from labseq.detection.spots import spot_light
from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq.model import CalibrationEntry
from labseq.motion import correct_overlay
from labseq.plugin import Context, DepthRamp, RandomStream, TweezerAmplitudes
from labseq.plugin.runs import Run

Floats = NDArray[np.float64]

ROOT = Path(__file__).parents[2]
SHOTS = {"tweezers": 1, "sites": 8, "thresholds": 60, "frequencies": 29, "overlay": 29}
"""Kinds in the order of the morning, and fewer shots than usual."""
SMALLER = {"frame: [512, 512]": "frame: [340, 480]", "[243.2, 268.9]": "[157.2, 252.9]"}
"""Changes of the profile: frames without what lies far from the sites, which stay as far from the middle."""
N_FRESH = 15
COSTS = np.array([3.0, 1.0])
"""Of an atom that is missed and of one that is imagined, as thresholds are fitted."""
LADDER = np.arange(-2000.0, 14_384.0, 2.0)


class Practice:
    """The practice lab, copied, and the truth about it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.profile = folder / "practice.yaml"
        text = (ROOT / "hardware_profiles" / "practice.yaml").read_text("utf-8")
        for old, new in SMALLER.items():
            assert old in text
            text = text.replace(old, new)
        self.profile.write_text(text, "utf-8")
        document, spec = load_profile(str(self.profile))
        physics = document.validate(SimulationSettings, ("simulation",), core_keys={"use"})
        self.detector = document.validate(ThresholdSettings, ("detector",), core_keys={"use"})
        self.grid, self.image = spec.grid_model(), physics.image
        self.random = RandomStream(2026)
        self.world = VirtualSimulation(physics, Context("simulation", self.grid, random=self.random))
        self.world.open()
        self.world.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
        self.found: dict[str, CalibrationEntry] = {}

    def calibrate(self, kind: str, shots: int) -> None:
        options: dict[str, Any] = {"output": self.folder / "data", "seed": 1, "shots": shots}
        if kind in ("frequencies", "overlay"):  # which need no more than the occupancies
            options["overrides"] = ["record_frames=none"]
        request = CalibrationRequest(str(self.profile), **options)
        outcome = calibrate(METHODS[kind], request)
        assert outcome.refused == ""
        self.found[kind] = outcome.stored.entry

    def run(self, shots: int) -> Run:
        sequence = ROOT / "sequences" / "compact_225.yaml"
        profile, output = str(self.profile), self.folder / "data"
        with labseq.Session.open(sequence, profile=profile, shots=shots, seed=5, output=output) as session:
            return session.run()

    def sites_off_px(self) -> Floats:
        """How far each site is from where the camera sees it."""
        off = self.found["sites"].values["positions_px"] - site_spots(self.image, self.grid)
        return np.hypot(*np.moveaxis(off, -1, 0))

    def separable_spread(self) -> float:
        """That of the powers themselves, at the amplitudes in force."""
        return factors(self.world.spot_powers()).separable_spread

    def mobile_off_m(self) -> Floats:
        """How far each site's mobile tweezer stands from it."""
        grid = self.grid
        if "frequencies" in self.found:
            tones = self.found["frequencies"].values
            grid = replace(grid, row_frequency_hz=tones["row_hz"], column_frequency_hz=tones["column_hz"])
            grid = correct_overlay(grid, self.found["overlay"].values["offset_m"])
        row, col = (
            self.world._positions.actual(axis, hz) - np.arange(len(hz))
            for axis, hz in enumerate((grid.row_frequency_hz, grid.column_frequency_hz))
        )
        return np.linalg.norm(row[:, None, None] * grid.axes[1] + col[:, None] * grid.axes[0], axis=-1)


class Signals:
    """What the detector sums on the sites that were found: its exact law, and fresh frames.

    The law is that of 60 counts a photoelectron, an exponential gain, and read noise of 16 counts a pixel.
    """

    def __init__(self, lab: Practice) -> None:
        self.lab, image, region = lab, lab.image, lab.detector.region
        context = Context("detector", lab.grid, calibrations=lab.found)
        self.detector = ThresholdDetector(lab.detector, context)
        corners = region_corners(known_sites(lab.detector, context), region)
        spots = site_spots(image, lab.grid).reshape(-1, 2)
        light = 60 * spot_light(spots, corners, region, image.spot / image.pixel_size).sum(axis=(1, 2))
        dark = np.full(len(light), 0.375 * region**2)
        self.missed, self.imagined = below(dark + light), 1 - below(dark)
        self.ours = lab.found["thresholds"].values["thresholds"].ravel()
        self.best = LADDER[np.argmin(COSTS[0] * self.missed + COSTS[1] * self.imagined, axis=1)]

    def expected(self, thresholds: Floats) -> Floats:
        """By the law: how often an atom is missed, and how often an empty site is taken for full."""
        ways = [
            [np.interp(at, LADDER, of_site) for at, of_site in zip(thresholds, law, strict=True)]
            for law in (self.missed, self.imagined)
        ]
        return np.asarray(ways, np.float64).mean(axis=1)

    def count(self, n_frames: int) -> tuple[Floats, Floats]:
        """On fresh frames: [missed, imagined], of [atoms, empty sites]; atoms lost meanwhile do not count."""
        world, errors, cases = self.lab.world, np.zeros(2), np.zeros(2)
        for shot in range(n_frames):
            self.lab.random.begin_shot(shot, 0)
            world.begin_shot()
            world.load(0.0, 0.5)
            before = world.truth()
            seen, *_ = self.detector.detect(world.expose(0.5, 45e-3))
            atoms, empty = before & world.truth(), ~before
            errors += np.count_nonzero(atoms & ~seen), np.count_nonzero(empty & seen)
            cases += np.count_nonzero(atoms), np.count_nonzero(empty)
        return errors, cases


def below(light: Floats) -> Floats:
    """Probability of less than each of the ``LADDER``, for means of photoelectrons: (n_sites, n_steps)."""
    t = 2 * np.pi * np.fft.rfftfreq(len(LADDER), LADDER[1] - LADDER[0])
    transform = light[:, None] * (1 / (1 + 60j * t) - 1) - (80 * t) ** 2 / 2 + 1j * t * LADDER[0]
    return np.fft.irfft(np.exp(transform), len(LADDER), axis=1).cumsum(axis=1)


def test_a_morning_of_calibration_finds_all_that_the_practice_lab_hides(tmp_path: Path) -> None:
    lab = Practice(tmp_path)
    assert lab.separable_spread() > 0.05
    assert lab.mobile_off_m().mean() > 200e-9
    for kind, shots in SHOTS.items():
        lab.calibrate(kind, shots)
    rows, columns = (lab.found["tweezers"].values[f"{axis}_amplitudes"] for axis in ("row", "column"))
    lab.world.play("static_tweezers", TweezerAmplitudes(rows, columns), 0.0)
    assert lab.separable_spread() < 0.006
    assert lab.sites_off_px().max() < 0.1
    assert lab.mobile_off_m().mean() < 50e-9

    signals = Signals(lab)
    ours, best = (signals.expected(thresholds) for thresholds in (signals.ours, signals.best))
    assert COSTS @ ours < 1.2 * COSTS @ best
    errors, cases = signals.count(N_FRESH)
    chance = np.sqrt(cases * ours)
    assert (np.abs(errors - cases * ours) < 4 * chance + 1).all(), "the law is not that of the frames"
    assert COSTS @ (errors / cases) < 1.2 * COSTS @ best + 3 * np.linalg.norm(COSTS * chance / cases)

    run = lab.run(2)
    assert {*run.shots[0].calibrations} == {*SHOTS}
    assert run.filling_fraction > 0.98
