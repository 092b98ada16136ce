"""The EMCCD, its register and the qCMOS sensor, against theory and against a simulation of each stage."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_virtual.images import photoelectrons
from labseq_virtual.sensors import N_ONE_BY_ONE, CountDistribution, Emccd, Qcmos, Register, View, power_of_two
from labseq_virtual.settings import ImageSettings, SimulationSettings
from labseq_virtual.simulation import VirtualSimulation
from numpy.typing import NDArray

from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq.detection.weighted import WeightedDetector, WeightedSettings
from labseq.plugin import Context, DepthRamp, RandomStream, SensorMode
from labseq.roles import WHOLE_SENSOR

EXPOSURE_S = 45e-3
NOWHERE = np.empty((0, 2))


def render(
    positions_px: NDArray[np.float64] = NOWHERE, exposure_s: float = EXPOSURE_S, **image: Any
) -> NDArray[np.float64]:
    dark = {"background": 0.0, "clock_induced_charge": 0.0}
    view = View.of(ImageSettings.model_validate(dark | image))
    rng = np.random.default_rng(0)
    light = photoelectrons(view, positions_px, np.full(len(positions_px), view.photoelectrons), rng)
    frame = Emccd(view).read(light, exposure_s, rng)
    assert frame.dtype == np.uint16
    assert frame.shape == view.frame
    return frame.astype(float)


def test_a_dark_frame_is_offset_and_read_noise() -> None:
    frame = render(read_noise=80.0, electrons_per_adu=5.0, offset=500.0)
    assert frame.mean() == pytest.approx(500.0, abs=0.15)
    assert frame.std() == pytest.approx(np.sqrt(16.0**2 + 1 / 12), rel=0.01)


def test_stray_light_grows_with_the_exposure_and_clock_induced_charge_does_not() -> None:
    short, long = (render(background=1.0, exposure_s=s).mean() - 500 for s in (EXPOSURE_S, 3 * EXPOSURE_S))
    assert long / short == pytest.approx(3.0, rel=0.02)
    short, long = (render(clock_induced_charge=1.0, exposure_s=s).mean() - 500 for s in (1e-3, 1.0))
    assert long / short == pytest.approx(1.0, rel=0.02)


def test_an_atom_is_a_gaussian_spot_at_its_place() -> None:
    place = np.array([[100.3, 200.6]])
    frame = render(place, photoelectrons=2e5, read_noise=0.0, em_gain=10.0) - 500
    y, x = np.indices(frame.shape)
    n = frame.sum()
    assert n == pytest.approx(2e5 * 10 / 5, rel=0.02)
    centre = np.array([(frame * y).sum(), (frame * x).sum()]) / n
    np.testing.assert_allclose(centre, place[0], atol=0.02)
    width = np.sqrt([(frame * (y - centre[0]) ** 2).sum() / n, (frame * (x - centre[1]) ** 2).sum() / n])
    np.testing.assert_allclose(width, np.sqrt(1.2**2 + 1 / 12), rtol=0.01)


def test_light_beside_the_sensor_is_lost() -> None:
    corner = np.array([[-0.5, -0.5], [1e4, 1e4], [-50.0, 3.0]])
    frame = render(corner, photoelectrons=1e4, read_noise=0.0, em_gain=10.0) - 500
    assert frame.sum() == pytest.approx(1e4 * 10 / 5 / 4, rel=0.05)
    assert frame[:8, :8].sum() == frame.sum()


def count_errors(
    n_shots: int, image: dict[str, Any], *detectors: ThresholdDetector | WeightedDetector
) -> NDArray[np.float64]:
    """Atoms missed, atoms, empty sites taken for full and empty sites, (n_detectors, 4)."""
    random = RandomStream(3)
    settings = SimulationSettings.model_validate({"image": image})
    simulation = VirtualSimulation(settings, Context("simulation", random=random))
    simulation.open()
    simulation.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    counts = np.zeros((len(detectors), 4))
    for shot in range(n_shots):
        random.begin_shot(shot, 0)
        simulation.begin_shot()
        simulation.load(0.0, 0.5)
        empty = ~simulation.truth()
        frame = simulation.expose(0.5, EXPOSURE_S)
        atoms = ~empty & simulation.truth()
        for row, detector in zip(counts, detectors, strict=True):
            seen, *_ = detector.detect(frame)
            row += (atoms & ~seen).sum(), atoms.sum(), (seen & empty).sum(), empty.sum()
    return counts


def test_the_shipped_detector_reaches_the_papers_fidelity() -> None:
    """Mean fidelity 99.946 %: of 4,000 empty sites 4 look full, of 12,000 atoms 0.7 are missed."""
    detector = ThresholdDetector(ThresholdSettings(), Context("detector"))
    ((missed, n_atoms, imagined, n_empty),) = count_errors(40, {}, detector)
    assert missed <= 5
    assert 0 < imagined <= 13
    assert n_atoms + n_empty > 15_000


def test_both_detectors_work_on_frames_of_a_qcmos_camera() -> None:
    """See docs/explanation/virtual-images.md."""
    context = Context("detector")
    threshold = ThresholdSettings(offset=200.0, threshold=155.0, width=15.0, shape="disc")
    weighted = WeightedSettings(
        photoelectrons=36.0,
        background=0.2225,
        counts_per_photoelectron=1 / 0.11,
        read_noise=0.27 / 0.11,
        em_register=False,
        offset=200.0,
        threshold=0.0,
    )
    detectors = ThresholdDetector(threshold, context), WeightedDetector(weighted, context)
    counts = count_errors(20, {"sensor": "qcmos"}, *detectors)
    errors = (counts[:, 0] / counts[:, 1] + counts[:, 2] / counts[:, 3]) / 2
    assert errors[0] < 1e-2
    assert errors[1] < 1e-3


@pytest.mark.parametrize("gain", [1.0, 300.0])
def test_dark_pixels_from_the_table_are_like_pixels_followed_step_by_step(gain: float) -> None:
    image = ImageSettings(background=1.5, em_gain=gain, read_noise=9.0, electrons_per_adu=3.0)
    camera, rng = Emccd(View.of(image)), np.random.default_rng(4)
    frame = camera.read(np.zeros((512, 512), np.int32), EXPOSURE_S, rng).ravel()
    electrons = camera.register.multiply(rng.poisson(1.505, frame.size), rng)
    followed = np.rint((electrons + 9.0 * rng.standard_normal(frame.size)) / 3.0 + 500)
    edges = np.arange(frame.min(), frame.max() + 1)
    below = [np.searchsorted(np.sort(x), edges, "right") / x.size for x in (frame, followed)]
    assert np.abs(below[0] - below[1]).max() < 1.95 * np.sqrt(2 / frame.size)


def test_light_too_bright_for_a_table_is_followed_step_by_step() -> None:
    frame = render(background=400.0, em_gain=300.0, read_noise=0.0) - 500
    assert frame.mean() == pytest.approx(400 * 60, rel=0.002)
    assert frame.var() == pytest.approx(1.976 * 400 * 60**2, rel=0.02)


def test_without_gain_it_is_a_plain_ccd() -> None:
    frame = render(background=12.0, em_gain=1.0, read_noise=3.0, electrons_per_adu=0.5)
    assert frame.mean() - 500 == pytest.approx(24.0, rel=0.005)
    assert frame.var() == pytest.approx((12.0 + 3.0**2) / 0.5**2, rel=0.02)  # Poisson's, once


def test_a_pixel_and_the_register_hold_a_limited_number_of_electrons() -> None:
    place = np.array([[100.0, 100.0]])
    quiet: dict[str, Any] = {"photoelectrons": 1e6, "read_noise": 0.0, "electrons_per_adu": 20.0}
    assert render(place, em_gain=1.0, full_well=30e3, **quiet).max() == 500 + 30e3 / 20
    assert render(place, em_gain=100.0, register_well=400e3, **quiet).max() == 500 + 400e3 / 20
    full = render(background=150.0, em_gain=100.0, register_well=10e3, read_noise=0.0)
    assert full.max() == 500 + 10e3 / 5
    assert (full == full.max()).mean() > 0.9


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
GAINS = (1.0, 1.02, 3.0, 300.0, 1000.0)
KOLMOGOROV = 1.95
"""Over the root of the number of draws: the distance that 1 of 1,000 right samples exceeds."""


def exact(register: Register, n_electrons: int) -> Floats:
    """Law of the output for a fixed number of electrons in, worked out beside the plugin."""
    n_values = power_of_two((n_electrons + 9 * (2 * n_electrons) ** 0.5 + 45) * register.gain)
    s = np.exp(-2j * np.pi * np.fft.rfftfreq(n_values))
    for _ in range(register.n_stages):
        s = s * (1 - register.p) + register.p * s**2
    return np.fft.irfft(s**n_electrons, n_values)


def stage_by_stage(register: Register, n_electrons: Ints, rng: np.random.Generator) -> Ints:
    """Every electron in every stage."""
    n = n_electrons.copy()
    for _ in range(register.n_stages):
        n += rng.binomial(n, register.p)
    return n


def distance(sample: Ints, other: Ints) -> float:
    """Kolmogorov-Smirnov distance of two samples, in units of its scale."""
    edges = np.arange(max(sample.max(), other.max()) + 2)
    one, two = (np.searchsorted(np.sort(x), edges, "right") / len(x) for x in (sample, other))
    return float(np.abs(one - two).max() / np.sqrt(1 / len(sample) + 1 / len(other)))


def distance_to(sample: Ints, probability: Floats) -> float:
    """The same of a sample and a probability."""
    found = np.cumsum(np.bincount(sample, minlength=len(probability))) / len(sample)
    return float(np.abs(found[: len(probability)] - np.cumsum(probability)).max() * np.sqrt(len(sample)))


@pytest.mark.parametrize(("gain", "n_electrons"), [(1.5, 1), (10.0, N_ONE_BY_ONE + 1), (300.0, 4)])
def test_the_output_is_that_of_every_electron_in_every_stage(gain: float, n_electrons: int) -> None:
    register, rng = Register(536, gain), np.random.default_rng(5)
    n = np.full(3000, n_electrons)
    assert distance(register.multiply(n, rng), stage_by_stage(register, n, rng)) < KOLMOGOROV


@pytest.mark.parametrize("gain", GAINS)
@pytest.mark.parametrize("n_electrons", [1, 10])
def test_few_electrons_follow_the_exact_probability(gain: float, n_electrons: int) -> None:
    register = Register(604, gain)
    drawn = register.multiply(np.full(30_000, n_electrons), np.random.default_rng(1))
    assert distance_to(drawn, exact(register, n_electrons)) < KOLMOGOROV


@pytest.mark.parametrize("gain", [1.02, 300.0])
def test_many_electrons_follow_it_within_two_in_ten_thousand(gain: float) -> None:
    register, n_electrons = Register(536, gain), N_ONE_BY_ONE + 1
    drawn = register.multiply(np.full(100_000, n_electrons), np.random.default_rng(2))
    allowed = 2e-4 * np.sqrt(len(drawn))
    assert distance_to(drawn, exact(register, n_electrons)) < KOLMOGOROV + allowed


@pytest.mark.parametrize(("gain", "n_stages"), [(1.0, 536), (1.02, 100), (300.0, 536), (1000.0, 536)])
def test_gain_and_excess_noise_are_those_of_theory(gain: float, n_stages: int) -> None:
    """Variance over gain^2 for a Poisson input of 1: Robbins and Hadwen 2003."""
    register = Register(n_stages, gain)
    n_values = power_of_two(60 * gain + 64)
    probability, n = register.output(1.0, n_values), np.arange(n_values)
    mean = probability @ n
    assert mean == pytest.approx(gain, rel=1e-9)
    assert probability @ (n - mean) ** 2 / gain**2 == pytest.approx(register.excess_noise, rel=1e-8)


@settings(max_examples=20)
@given(st.floats(1.0, 2000.0) | st.floats(0.0, 1e-6).map(lambda over: 1 + over), st.integers(100, 600))
def test_no_electron_is_lost_in_the_register(gain: float, n_stages: int) -> None:
    n = np.arange(300)
    out = Register(n_stages, gain).multiply(n, np.random.default_rng(0))
    assert (out >= n).all()
    assert out.sum() <= n.sum() * gain * 1.2 + 1


@settings(max_examples=30)
@given(st.lists(st.integers(0, 5), min_size=1, max_size=40).filter(any), st.integers(0, 1000))
def test_a_distribution_draws_each_number_with_its_probability(weights: list[int], first: int) -> None:
    probability = CountDistribution.of(np.array(weights, float), first)
    drawn = np.empty(4000, np.int32)
    probability.draw(drawn, np.random.default_rng(7))
    often = np.bincount(drawn - first, minlength=len(weights))
    expected = 4000 * np.array(weights) / sum(weights)
    assert (often[expected == 0] == 0).all()
    assert (np.abs(often - expected) <= 6 * np.sqrt(expected)).all()


def test_the_table_covers_all_random_words() -> None:
    probability = CountDistribution.of(np.array([0.25, 0.75]))
    assert probability.edges.tolist() == [2**30 - 1, 2**32 - 1]
    small = np.array([1e-15, 1.0, 1e-9, 1e-15])
    assert CountDistribution.of(small).first == 1
    assert len(CountDistribution.of(small).edges) == 2


def test_sums_are_those_of_single_draws() -> None:
    probability, n_each = CountDistribution.of(np.array([0.5, 0.2, 0.3]), 3), np.array([0, 3, 1, 0, 5])
    drawn = np.empty(9, np.int32)
    probability.draw(drawn, np.random.default_rng(1))
    ends = np.cumsum(n_each)
    expected = [int(drawn[end - n : end].sum()) for n, end in zip(n_each, ends, strict=True)]
    assert probability.draw_sums(n_each, np.random.default_rng(1)).tolist() == expected


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
    view = View.of(ImageSettings.model_validate(image | {"qcmos": {"dark_current": 0.0} | qcmos}), mode)
    camera, rng = Qcmos(view, np.random.default_rng(1)), np.random.default_rng(2)
    light = np.full(view.region[2:], electrons, np.int32)
    return np.stack([camera.read(light, EXPOSURE_S, rng) for _ in range(n_frames)]).astype(float)


def test_a_dark_qcmos_frame_is_offset_and_read_noise() -> None:
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
    frames = read(n_frames=30, read_noise=0.43, read_noise_spread=0.3, electrons_per_adu=0.02)
    noise = frames.std(axis=0, ddof=1) * 0.02
    assert np.sqrt((noise**2).mean()) == pytest.approx(0.43, rel=0.02)
    assert np.log(noise).std() == pytest.approx(np.hypot(0.3, 1 / np.sqrt(60)), rel=0.06)


def test_offset_and_gain_have_a_fixed_pattern() -> None:
    dark = read(n_frames=30, read_noise=0.1, offset_spread=2.0, gain_spread=0.0).mean(axis=0)
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
