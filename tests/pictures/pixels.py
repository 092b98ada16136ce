"""Pictures read back, and what is where in them."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from scipy import ndimage
from scipy.spatial.distance import cdist

Pixels = NDArray[np.int64]


def decoded(png: bytes, mode: str | None = None) -> Pixels:
    """The pixels of a PNG, as they are or in another mode; damaged data fail."""
    with Image.open(io.BytesIO(png), formats=["PNG"]) as picture:
        picture.verify()  # checksums, which decoding ignores
    with Image.open(io.BytesIO(png), formats=["PNG"]) as picture:
        return np.asarray(picture if mode is None else picture.convert(mode)).astype(np.int64)


def is_colour(pixels: Pixels, colour: Any) -> NDArray[np.bool_]:
    """True where a picture has a colour, or nearly."""
    return np.abs(pixels - np.round(255 * np.array(to_rgb(colour)))).max(axis=2) < 12


def spots(wanted: NDArray[np.bool_], least: int = 10) -> NDArray[np.float64]:
    """The centres (x, y) of connected pixels, at least so many to a spot."""
    labels = np.zeros(wanted.shape, np.int64)
    ndimage.label(wanted, output=labels)
    kept = [i for i, size in enumerate(np.bincount(labels.ravel()).tolist()) if i and size >= least]
    return np.array(ndimage.center_of_mass(wanted, labels, kept)).reshape(-1, 2)[:, ::-1]


def are_at(found: NDArray[np.float64], expected: ArrayLike) -> bool:
    """True if spots lie as the expected places (x, y) do, neither turned nor mirrored."""

    def normalised(places: NDArray[np.float64]) -> NDArray[np.float64]:
        return (places - places.mean(axis=0)) / places.std(axis=0)

    wanted = np.asarray(expected, np.float64)
    if len(found) != len(wanted):
        return False
    distances = cdist(normalised(found), normalised(wanted))
    return bool((distances.min(axis=0) < 0.05).all() and (distances.min(axis=1) < 0.05).all())


def on_lattice(sites: ArrayLike) -> NDArray[np.float64]:
    """Places (x, y) of sites (row, column) on the triangular lattice, in units of the spacing, y down."""
    row, col = np.asarray(sites, np.float64).T
    return np.stack([col + row / 2, row * np.sqrt(3) / 2], axis=1)
