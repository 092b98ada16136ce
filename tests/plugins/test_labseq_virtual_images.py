"""What the virtual camera sees: where the spots are, how bright, their wings, and parts of the sensor."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_virtual.images import Images, corner_distance, photoelectrons, site_brightness, site_spots
from labseq_virtual.sensors import View
from labseq_virtual.settings import ImageSettings, SimulationSettings
from labseq_virtual.simulation import VirtualSimulation
from numpy.typing import NDArray
from pydantic import ValidationError

from labseq.detection.sites import site_pixels
from labseq.plugin import Context, LimitError, SensorMode, SiteGrid
from labseq.roles import WHOLE_SENSOR

GRID = SiteGrid()
Floats = NDArray[np.float64]
QUIET: dict[str, Any] = {"background": 0.0, "clock_induced_charge": 0.0, "read_noise": 0.0, "offset": 0.0}


def spots(**image: Any) -> Floats:
    return site_spots(ImageSettings.model_validate(image), GRID)


def light(
    positions_px: Floats, mean: float, mode: SensorMode = WHOLE_SENSOR, **image: Any
) -> NDArray[np.int32]:
    view = View.of(ImageSettings.model_validate(image), mode)
    rng = np.random.default_rng(0)
    return photoelectrons(view, positions_px, np.full(len(positions_px), mean), rng, mode.binning)


def take(
    exposure_s: float = 45e-3, seed: int = 1, mode: SensorMode = WHOLE_SENSOR, **image: Any
) -> NDArray[np.uint16]:
    """A frame with an atom on every site."""
    optics = ImageSettings.model_validate(image)
    row, col = np.indices(GRID.shape).reshape(2, -1)
    images = Images(optics, GRID, seed, mode)
    frame = images.take(row, col, np.ones(len(row)), exposure_s, np.random.default_rng(2))
    assert frame.shape == mode.frame_shape(optics.frame)
    return frame


@settings(max_examples=30)
@given(st.floats(-np.pi, np.pi), st.tuples(st.floats(-50, 600), st.floats(-50, 600)), st.floats(0.1e-6, 1e-6))
def test_without_distortion_the_sites_are_where_the_detectors_look(
    angle: float, centre: tuple[float, float], pixel: float
) -> None:
    found = spots(angle=angle, centre_px=centre, pixel_size=pixel)
    np.testing.assert_allclose(found, site_pixels(GRID, pixel, centre, angle), atol=1e-9)


def test_a_stretch_makes_one_direction_longer_than_the_other() -> None:
    straight = spots(angle=0.03) - 255.5
    along_x = spots(angle=0.03, stretch=0.1) - 255.5
    np.testing.assert_allclose(along_x[..., 1] / straight[..., 1], np.sqrt(1.1))
    np.testing.assert_allclose(along_x[..., 0] / straight[..., 0], np.sqrt(1 / 1.1))
    turned = spots(angle=0.03, stretch=0.1, stretch_angle=np.pi / 2) - 255.5
    np.testing.assert_allclose(turned[..., 0] / straight[..., 0], np.sqrt(1.1))
    slanted = spots(stretch=0.1, stretch_angle=0.4) - 255.5
    to_frame = np.linalg.lstsq((spots() - 255.5).reshape(-1, 2), slanted.reshape(-1, 2))[0]
    values, vectors = np.linalg.eigh(to_frame)
    np.testing.assert_allclose(values[1] / values[0], 1.1)
    np.testing.assert_allclose(np.abs(vectors[:, 1]), [np.sin(0.4), np.cos(0.4)])


def test_a_barrel_moves_the_corner_inwards_and_nothing_in_the_middle() -> None:
    optics = ImageSettings(barrel=0.1)
    straight, bent = spots(), spots(barrel=0.1)
    far = corner_distance(optics, straight)
    np.testing.assert_allclose(corner_distance(optics, bent), far * (1 - 0.1 * far**2))
    assert corner_distance(optics, np.array([-0.5, -0.5])) == pytest.approx(1.0)
    assert corner_distance(optics, np.array([255.5, 255.5])) == 0.0


def test_the_spots_are_drawn_at_these_places() -> None:
    geometry: dict[str, Any] = {"angle": 0.035, "stretch": 0.1, "barrel": 0.02, "centre_px": (262.3, 249.1)}
    frame = take(photoelectrons=2e4, em_gain=1.0, electrons_per_adu=1.0, **QUIET, **geometry).astype(float)
    for y, x in spots(**geometry)[::5, ::4].reshape(-1, 2):
        top, left = round(y) - 5, round(x) - 5
        part = frame[top : top + 11, left : left + 11]
        rows, cols = np.indices(part.shape)
        found = np.array([(part * rows).sum(), (part * cols).sum()]) / part.sum() + [top, left]
        np.testing.assert_allclose(found, [y, x], atol=0.06)


def test_vignetting_darkens_the_corner() -> None:
    optics, rng = ImageSettings(vignetting=0.4), np.random.default_rng(0)
    places = np.array([[[255.5, 255.5], [-0.5, 511.5], [255.5, 511.5]]])
    np.testing.assert_allclose(site_brightness(optics, places, rng), [[1.0, 0.6, 0.8]])


def test_the_brightness_of_sites_belongs_to_the_machine() -> None:
    bright: dict[str, Any] = QUIET | {"em_gain": 1.0, "electrons_per_adu": 1.0, "photoelectrons": 1e4}

    def brightness(seed: int, spread: float) -> Floats:
        frame = take(seed=seed, brightness_spread=spread, **bright)
        corners = np.rint(spots()).astype(int).reshape(-1, 2) - 5
        return np.array([float(frame[y : y + 11, x : x + 11].sum()) for y, x in corners])

    one = brightness(1, 0.1)
    assert one.std() / one.mean() == pytest.approx(0.1, rel=0.15)
    np.testing.assert_allclose(brightness(1, 0.1), one)
    assert np.corrcoef(brightness(2, 0.1), one)[0, 1] < 0.2
    assert brightness(1, 0.0).std() / 1e4 < 0.02


def test_wings_give_neighbours_the_fraction_of_the_light_that_theory_says() -> None:
    """The wings on a rectangle are its solid angle seen from a width above, over 2 pi."""
    halo, width, pixel = 0.3, 1e-6, 0.35e-6
    found = light(np.array([[100.0, 100.0]]), 4e6, halo=halo, halo_width=width, pixel_size=pixel)
    neighbour = found[98:103, 111:116].sum() / found.sum()  # 4.55 um beside

    def corner(y: float, x: float) -> float:
        return float(np.arctan2(y * x, np.sqrt(x**2 + y**2 + 1)))

    y, (x0, x1) = 2.5 * pixel / width, np.array([10.5, 15.5]) * pixel / width
    expected = halo * (corner(y, x1) - corner(-y, x1) - corner(y, x0) + corner(-y, x0)) / (2 * np.pi)
    assert expected > 0.001
    assert neighbour == pytest.approx(expected * 4e6 / found.sum(), rel=0.02)
    inside = found[100 - 40 : 101 + 40, 100 - 40 : 101 + 40].sum() / 4e6
    assert 1 - inside == pytest.approx(halo * width / (40.5 * pixel), rel=0.25)  # a square, not a circle


@settings(max_examples=15)
@given(st.integers(0, 200), st.integers(0, 200), st.integers(1, 150), st.integers(1, 150))
def test_a_region_is_that_part_of_the_sensor(y: int, x: int, height: int, width: int) -> None:
    whole = light(spots().reshape(-1, 2), 100.0)
    part = light(spots().reshape(-1, 2), 100.0, SensorMode((y, x, height, width)))
    np.testing.assert_array_equal(part, whole[y : y + height, x : x + width])


def test_binning_adds_pixels_up() -> None:
    whole = light(spots().reshape(-1, 2), 100.0)
    binned = light(spots().reshape(-1, 2), 100.0, SensorMode(binning=4))
    np.testing.assert_array_equal(binned, whole.reshape(128, 4, 128, 4).sum(axis=(1, 3)))


@pytest.mark.parametrize("sensor", ["emccd", "qcmos"])
def test_binned_frames_hold_the_same_light(sensor: str) -> None:
    image: dict[str, Any] = {"sensor": sensor, "offset": 0.0, "qcmos": {"offset": 0.0}, "read_noise": 0.0}
    plain, binned = (take(mode=SensorMode((10, 20, 400, 440), b), **image) for b in (1, 2))
    assert binned.shape == (200, 220)
    assert binned.sum() == pytest.approx(plain.sum(), rel=0.03)


def test_a_part_of_the_sensor_reads_out_faster() -> None:
    def fraction(mode: SensorMode, **image: Any) -> float:
        return View.of(ImageSettings.model_validate(image), mode).readout_fraction

    part, binned = SensorMode((0, 0, 256, 128)), SensorMode(binning=2)
    assert fraction(WHOLE_SENSOR) == 1.0
    assert fraction(part) == 0.125
    assert fraction(binned) == 0.25
    assert fraction(part, sensor="qcmos") == 0.5
    assert fraction(binned, sensor="qcmos") == 1.0


def test_impossible_settings_are_refused() -> None:
    with pytest.raises(ValidationError, match=r"greater than -0\.5"):
        ImageSettings(stretch=-0.9)


@pytest.mark.parametrize(
    ("mode", "image", "reason"),
    [
        (SensorMode((0, 500, 20, 20)), {}, r"\[0, 500, 20, 20\]; the limit is its 512 x 512 pixels"),
        (SensorMode((-1, 0, 20, 20)), {}, "the region of the sensor"),
        (SensorMode((0, 0, 21, 20), 2), {}, "the binning is 2; the limit is a divisor of the 21 x 20 pixels"),
        (SensorMode(em_gain=30.0), {"sensor": "qcmos"}, "30; the limit is 1"),
    ],
)
def test_a_sensor_refuses_impossible_modes(mode: SensorMode, image: dict[str, Any], reason: str) -> None:
    simulation = VirtualSimulation(SimulationSettings.model_validate({"image": image}), Context("simulation"))
    for use in (simulation.readout_fraction, simulation.prepare_sensor):
        with pytest.raises(LimitError, match=reason):
            use(mode)
