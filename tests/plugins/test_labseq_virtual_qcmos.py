"""The virtual qCMOS camera, and what the shipped detectors make of its frames."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from labseq_virtual.sensors import Qcmos, View
from labseq_virtual.settings import ImageSettings, SimulationSettings
from labseq_virtual.simulation import VirtualSimulation
from numpy.typing import NDArray

from labseq import Context, DepthRamp, RandomStream, SensorMode
from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq.detection.weighted import WeightedDetector, WeightedSettings
from labseq.roles import WHOLE_SENSOR

Floats = NDArray[np.float64]
EXPOSURE_S = 45e-3
EVEN: dict[str, Any] = {"read_noise_spread": 0.0, "offset_spread": 0.0, "gain_spread": 0.0}


def read(
    electrons: int = 0,
    n_frames: int = 1,
    mode: SensorMode = WHOLE_SENSOR,
    background: float = 0.0,
    **qcmos: Any,
) -> Floats:
    """Frames of even light (n_frames, height, width)."""
    image = {"sensor": "qcmos", "background": background, "frame": (256, 256)}
    settings = ImageSettings.model_validate(image | {"qcmos": {"dark_current": 0.0} | qcmos})
    view = View.of(settings, mode)
    camera, rng = Qcmos(view, np.random.default_rng(1)), np.random.default_rng(2)
    light = np.full(view.region[2:], electrons, np.int32)
    return np.stack([camera.read(light, EXPOSURE_S, rng) for _ in range(n_frames)]).astype(float)


def test_a_dark_frame_is_offset_and_read_noise() -> None:
    frame = read(read_noise=0.3, electrons_per_adu=0.1, offset=200.0, **EVEN)
    assert frame.mean() == pytest.approx(200.0, abs=0.05)
    assert frame.std() == pytest.approx(np.sqrt(3.0**2 + 1 / 12), rel=0.01)


def test_electrons_are_counted_without_excess_noise() -> None:
    frame = read(background=2.0 / 0.6, read_noise=0.0, electrons_per_adu=0.1, offset=0.0, **EVEN)
    assert set(np.unique(frame)) <= {10.0 * k for k in range(20)}
    assert frame.mean() == pytest.approx(20.0, rel=0.01)
    assert frame.var() == pytest.approx(200.0, rel=0.02)  # Poisson's


def test_dark_current_grows_with_the_exposure() -> None:
    frame = read(read_noise=0.0, electrons_per_adu=1.0, offset=0.0, dark_current=10.0, **EVEN)
    assert frame.mean() == pytest.approx(0.45, rel=0.02)


def test_the_read_noise_differs_from_pixel_to_pixel_about_its_mean_square() -> None:
    frames = read(n_frames=60, read_noise=0.43, read_noise_spread=0.3, electrons_per_adu=0.02)
    noise = frames.std(axis=0, ddof=1) * 0.02
    assert np.sqrt((noise**2).mean()) == pytest.approx(0.43, rel=0.02)
    assert np.log(noise).std() == pytest.approx(np.hypot(0.3, 1 / np.sqrt(120)), rel=0.05)


def test_offset_and_gain_have_a_fixed_pattern() -> None:
    dark = read(n_frames=60, read_noise=0.1, offset_spread=2.0, gain_spread=0.0).mean(axis=0)
    assert dark.std() == pytest.approx(2.0, rel=0.05)
    bright = read(1000, n_frames=10, read_noise=0.1, offset_spread=0.0, gain_spread=0.02).mean(axis=0) - 200
    assert bright.std() / bright.mean() == pytest.approx(0.02, rel=0.05)


def test_a_region_keeps_the_pixels_own_pattern() -> None:
    whole = read(read_noise=0.0, offset_spread=5.0)[0]
    part = read(mode=SensorMode((30, 70, 100, 90)), read_noise=0.0, offset_spread=5.0)[0]
    np.testing.assert_array_equal(part, whole[30:130, 70:160])


def test_wells_and_converter_saturate() -> None:
    full = read(10_000, full_well=7000, electrons_per_adu=1.0, read_noise=0.0, offset=100.0, **EVEN)
    assert set(np.unique(full)) == {7100.0}
    assert read(10_000, full_well=20_000, electrons_per_adu=0.1).max() == 65535


def test_binned_pixels_are_added_up_after_the_read_out() -> None:
    frame = read(mode=SensorMode(binning=2), read_noise=0.3, electrons_per_adu=0.1, offset=200.0, **EVEN)[0]
    assert frame.shape == (128, 128)
    assert frame.mean() == pytest.approx(800.0, abs=0.2)
    assert frame.std() == pytest.approx(2 * np.sqrt(3.0**2 + 1 / 12), rel=0.02)


def test_both_detectors_work_on_its_frames() -> None:
    """Expected of 18,000 atoms and 6,000 empty sites: see docs/explanation/virtual-images.md."""
    random = RandomStream(5)
    settings = SimulationSettings.model_validate({"image": {"sensor": "qcmos"}})
    world = VirtualSimulation(settings, Context("simulation", random=random))
    world.open()
    world.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    camera: dict[str, Any] = {"offset": 200.0, "threshold": 0.0}
    weighted = WeightedSettings(
        photoelectrons=36.0,
        background=0.2225,
        counts_per_photoelectron=1 / 0.11,
        read_noise=0.27 / 0.11,
        em_register=False,
        **camera,
    )
    detectors = (
        ThresholdDetector(
            ThresholdSettings(offset=200.0, threshold=155.0, width=15.0, shape="disc"), Context("detector")
        ),
        WeightedDetector(weighted, Context("detector")),
    )
    errors, n = np.zeros((2, 2)), np.zeros(2)
    for shot in range(60):
        random.begin_shot(shot, 0)
        world.begin_shot()
        world.load(0.0, 0.5)
        before = world.truth()
        frame = world.expose(0.5, EXPOSURE_S)
        survivors = before & world.truth()
        n += survivors.sum(), (~before).sum()
        for errors_here, detector in zip(errors, detectors, strict=True):
            seen, _ = detector.detect(frame)
            errors_here += (survivors & ~seen).sum(), (seen & ~before).sum()
    mean_error = (errors / n).mean(axis=1)
    assert mean_error[0] < 1e-2
    assert mean_error[1] < 1e-3
