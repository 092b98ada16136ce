"""Images of atoms, with positions and brightness of their spots, and the frames of an exposure."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Occupancy, RandomStream, SensorMode, SiteGrid
from labseq.plugin.simulation import WHOLE_SENSOR
from labseq_virtual.sensors import Emccd, Qcmos, View, normal_below
from labseq_virtual.settings import ImageSettings, SimulationSettings


def site_spots(settings: ImageSettings, grid: SiteGrid) -> NDArray[np.float64]:
    """Centres of the sites' spots on the full sensor, float64 (n_rows, n_cols, 2), (y, x) in pixels."""
    return on_sensor(settings, grid.positions_m)


def on_sensor(settings: ImageSettings, positions_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Images of places in the atom plane on the full sensor.

    The plane is rotated, stretched along an axis of the frame, shifted to the grid's centre, and distorted
    radially by the lenses.

    Args:
        settings: Constants of the optics.
        positions_m: float64 (..., 2), (x, y) from the grid's centre.

    Returns:
        float64 (..., 2), (y, x) in pixels.
    """
    to_axis, ratio = settings.stretch_angle, math.sqrt(1 + settings.stretch)
    stretched = _rotation(to_axis) @ np.diag([1 / ratio, ratio]) @ _rotation(-to_axis)
    to_frame = stretched @ _rotation(settings.angle)
    straight = positions_m[..., ::-1] @ to_frame.T / settings.pixel_size + settings.centre_px
    bent = 1 - settings.barrel * corner_distance(settings, straight) ** 2
    return middle(settings) + (straight - middle(settings)) * bent[..., None]


def site_brightness(
    settings: ImageSettings, spots: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Brightness of an atom on each site, relative to one in the middle of the frame.

    Returns:
        float64 (n_rows, n_cols).
    """
    spread = np.maximum(0.0, 1 + settings.brightness_spread * rng.standard_normal(spots.shape[:2]))
    return spread * np.maximum(0.0, 1 - settings.vignetting * corner_distance(settings, spots) ** 2)


def photoelectrons(
    settings: View,
    spots: NDArray[np.float64],
    mean: NDArray[np.float64],
    rng: np.random.Generator,
    binning: int = 1,
) -> NDArray[np.int32]:
    """Draw the photoelectrons of atoms on each pixel that is read.

    The number from each atom is Poisson distributed, and each photoelectron is drawn on its own. Its
    position is Gaussian in the spot, so the sampling by pixels is exact. The fraction ``halo`` lies in
    wings of density w / (2 pi (r^2 + w^2)^(3/2)), which decay as the mean of an Airy pattern does.

    Args:
        settings: Constants of the optics, and the part of the sensor that is read.
        spots: float64 (n_atoms, 2), (y, x) of each atom's spot on the sensor.
        mean: float64 (n_atoms,), mean photoelectrons of each atom.
        rng: Random numbers of the shot.
        binning: Pixels of the sensor per pixel of the frame, along each axis.

    Returns:
        int32 (height, width).
    """
    from labseq_virtual import image_kernels as kernels

    n_each = rng.poisson(mean)
    n = int(n_each.sum())
    offset = rng.standard_normal((n, 2), np.float32)
    offset *= np.float32(settings.spot / settings.pixel_size)
    if settings.halo > 0:
        wide = np.flatnonzero(rng.random(n, np.float32) < settings.halo)
        offset[wide] = _wings(len(wide), rng) * (settings.halo_width / settings.pixel_size)
    top, left, height, width = settings.region
    light = np.zeros((height // binning, width // binning), np.int32)
    kernels.scatter(offset, spots, n_each, top, left, binning, light)
    return light


def middle(settings: ImageSettings) -> NDArray[np.float64]:
    """The middle of the sensor, (y, x)."""
    return (np.array(settings.frame) - 1) / 2


def corner_distance(settings: ImageSettings, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of places (..., 2) from the middle of the sensor, where 1 is the corner."""
    return np.linalg.norm(places - middle(settings), axis=-1) / math.hypot(*(np.array(settings.frame) / 2))


def _wings(n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Positions (n, 2) in wings of width 1, where isotropic light from a point 1 above the plane meets it."""
    cosine = 1.0 - rng.random(n)
    radius = np.sqrt(1 / cosine**2 - 1)
    angle = 2 * np.pi * rng.random(n)
    return np.stack([radius * np.sin(angle), radius * np.cos(angle)], axis=1)


def _rotation(angle_rad: float) -> NDArray[np.float64]:
    """Rotation of (y, x) clockwise on the screen."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[cos, sin], [-sin, cos]])


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """The light of tweezers on a sensor.

    Attributes:
        positions_m: float64 (..., 2), (x, y) in the atom plane, from the grid's centre.
        mean: float64 (...), mean photoelectrons of each tweezer in the settings' exposure.
    """

    positions_m: NDArray[np.float64]
    mean: NDArray[np.float64]


def tweezer_photoelectrons(
    view: View, light: Light, fraction: float, rng: np.random.Generator, binning: int = 1
) -> NDArray[np.int32]:
    """Draw the photoelectrons of tweezers on each pixel that is read, as Gaussian spots with shot noise.

    Vignetting dims them like the light of atoms.

    Args:
        view: Constants of the optics, and the part of the sensor that is read.
        light: The tweezers.
        fraction: Detected fraction of their light, relative to ``light.mean``.
        rng: Random numbers of the shot.
        binning: Pixels of the sensor per pixel of the frame, along each axis.

    Returns:
        int32 (height, width).
    """
    places = on_sensor(view, light.positions_m)
    relative = np.maximum(0.0, 1 - view.vignetting * corner_distance(view, places) ** 2)
    top, left, height, width = view.region
    sigma = view.spot / view.pixel_size
    along_y, along_x = (
        np.diff(normal_below(np.arange(0, n + 1, binning) + first - 0.5 - place.reshape(-1, 1), sigma))
        for n, first, place in ((height, top, places[..., 0]), (width, left, places[..., 1]))
    )
    on_pixel = (along_y * (fraction * light.mean * relative).reshape(-1, 1)).T @ along_x
    return rng.poisson(on_pixel).astype(np.int32)


class Images:
    """Draws frames of atoms on the sites in one mode of the sensor. ``seed`` is the machine's seed.

    Raises:
        LimitError: The sensor has no such mode.
    """

    def __init__(
        self, settings: ImageSettings, grid: SiteGrid, seed: int, mode: SensorMode = WHOLE_SENSOR
    ) -> None:
        rng = RandomStream(seed, "simulation.image").machine()
        self._view = view = View.of(settings, mode)
        self._is_lit = mode.shutter_open
        self._spots = site_spots(view, grid)
        self._brightness = site_brightness(view, self._spots, rng)
        self._sensor = Emccd(view) if view.sensor == "emccd" else Qcmos(view, rng)

    def warm(self) -> None:
        """Compute the data shared by all frames."""
        self._sensor.warm()

    def take(
        self,
        row: NDArray[np.int64],
        col: NDArray[np.int64],
        shining: NDArray[np.float64],
        exposure_s: float,
        rng: np.random.Generator,
        tweezers: Sequence[Light] = (),
    ) -> NDArray[np.uint16]:
        """Draw a frame, uint16 (height, width), of atoms that shine for a fraction of the exposure each.

        ``row``, ``col`` and ``shining`` have the shape (n_atoms,). ``tweezers`` is other light on the sensor.
        """
        view = self._view
        efficiency = self._sensor.quantum_efficiency * exposure_s / view.exposure
        mean = view.photoelectrons * efficiency * shining * self._brightness[row, col] * self._is_lit
        light = photoelectrons(view, self._spots[row, col], mean, rng, self._sensor.binning)
        for one in tweezers:
            light += tweezer_photoelectrons(view, one, efficiency, rng, self._sensor.binning)
        return self._sensor.read(light, exposure_s, rng)


class Exposure:
    """Takes frames of the atoms."""

    def __init__(self, grid: SiteGrid, settings: SimulationSettings, seed: int) -> None:
        self._settings = settings
        self._grid = grid
        self._seed = seed
        self._images: dict[SensorMode, Images] = {}
        self._light_hz = -math.log1p(-settings.imaging_loss) / settings.imaging_loss_exposure

    def prepare(self, mode: SensorMode) -> None:
        """Compute the data shared by all frames of a mode.

        Raises:
            LimitError: The sensor has no such mode.
        """
        self._images_of(mode).warm()

    def take(
        self,
        occupied: Occupancy,
        exposure_s: float,
        random: np.random.Generator,
        mode: SensorMode = WHOLE_SENSOR,
        light_on: float = 1.0,
        tweezer_power: NDArray[np.float64] | None = None,
    ) -> tuple[NDArray[np.uint16], Counter[str]]:
        """Take a frame. Imaging light heats some atoms out of their tweezers, and they shine until then.

        A closed shutter keeps the light only from the sensor, not from the atoms.

        Args:
            occupied: bool (n_rows, n_cols), sites that hold an atom. Changed in place.
            exposure_s: Exposure time, in seconds.
            random: Random numbers of the shot.
            mode: How the sensor is exposed and read.
            light_on: Fraction of the exposure with imaging light. At 0 there is no stray light either.
            tweezer_power: float64 (n_rows, n_cols), power of the static tweezers, whose light a closed
                shutter also keeps from the sensor.

        Returns:
            The frame, uint16 (height, width), read-only, and the numbers of atoms lost to imaging and vacuum.
        """
        images = self._images_of(mode if light_on > 0 else replace(mode, shutter_open=False))
        row, col = np.nonzero(occupied)
        light_hz = self._light_hz * light_on
        rate_hz = light_hz + 1.0 / self._settings.lifetime
        life_s = random.exponential(1.0 / rate_hz, len(row))
        shining = np.minimum(life_s / exposure_s, 1.0) * light_on
        full, tweezers = self._settings.image.tweezer_light, list[Light]()
        if tweezer_power is not None and mode.shutter_open and full > 0:
            tweezers.append(Light(self._grid.positions_m, full * tweezer_power))
        image = images.take(row, col, shining, exposure_s, random, tweezers)
        image.flags.writeable = False
        lost = life_s < exposure_s
        occupied[row[lost], col[lost]] = False
        n_lost = int(np.count_nonzero(lost))
        n_by_light = int(random.binomial(n_lost, light_hz / rate_hz))
        return image, Counter(imaging=n_by_light, vacuum=n_lost - n_by_light)

    def _images_of(self, mode: SensorMode) -> Images:
        """The images of a mode. All share the seed, so a region shows exactly that part of the sensor."""
        if mode not in self._images:
            self._images[mode] = Images(self._settings.image, self._grid, self._seed, mode)
        return self._images[mode]
