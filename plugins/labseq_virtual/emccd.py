"""The frame of an EMCCD camera, photoelectron by photoelectron."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from labseq_virtual.image_settings import ImageSettings


def render(
    settings: ImageSettings,
    positions_px: NDArray[np.float64],
    shining: NDArray[np.float64],
    exposure_s: float,
    rng: np.random.Generator,
) -> NDArray[np.uint16]:
    """Draw a frame.

    Each photoelectron is drawn by itself: how many an atom gives (Poisson), where
    each falls (Gaussian spot about the atom, sampled by the pixels without any
    approximation), and what the EM register makes of it (exponential of mean
    ``em_gain``: the law of a register of many stages with a high gain, which gives
    the excess noise factor of 2). Stray light and clock-induced charge are
    photoelectrons anywhere on the sensor; read noise and offset come last.

    Args:
        settings: Constants of optics and camera.
        positions_px: float64 (n_atoms, 2), (y, x) of each atom.
        shining: float64 (n_atoms,), how long each atom shines, as a fraction of
            the exposure.
        exposure_s: Exposure time, in seconds.
        rng: Random numbers of the shot.

    Returns:
        uint16 (height, width), in counts.
    """
    height, width = settings.frame
    n_pixels = height * width
    brightness = exposure_s / settings.exposure
    dark_per_pixel = settings.background * brightness + settings.clock_induced_charge
    anywhere = rng.integers(0, n_pixels, rng.poisson(dark_per_pixel * n_pixels), dtype=np.int32)
    from_atoms = _fallen(settings, positions_px, settings.photoelectrons * brightness * shining, rng)
    pixel = np.concatenate([from_atoms, anywhere])
    gain_adu = settings.em_gain / settings.electrons_per_adu
    signal = rng.standard_exponential(len(pixel), dtype=np.float32)
    counts = rng.standard_normal(n_pixels, dtype=np.float32)
    counts *= np.float32(settings.read_noise / settings.electrons_per_adu)
    counts += np.float32(settings.offset + 0.5)  # the half turns the cut to integers into rounding
    counts += np.bincount(pixel, signal, n_pixels) * gain_adu
    return np.clip(counts, 0, 65535, out=counts).astype(np.uint16).reshape(height, width)


def _fallen(
    settings: ImageSettings,
    positions_px: NDArray[np.float64],
    mean: NDArray[np.float64],
    rng: np.random.Generator,
) -> NDArray[np.int32]:
    """Flat pixel index of each photoelectron of the atoms; those beside the sensor are left out."""
    height, width = settings.frame
    n_electrons = rng.poisson(mean)
    spot_px = np.float32(settings.spot / settings.pixel_size)
    fallen = rng.standard_normal((2, int(n_electrons.sum())), dtype=np.float32)
    fallen *= spot_px
    fallen += np.repeat(positions_px.T.astype(np.float32), n_electrons, axis=1)
    y, x = np.rint(fallen).astype(np.int32)
    inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
    return (y * np.int32(width) + x)[inside]
