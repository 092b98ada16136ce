"""Positions of the sites on the camera, and the region around each."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveInt, field_validator

from labseq.errors import ConfigError, DeviceError, LimitError
from labseq.files import open_ordinary
from labseq.model import Frame, SiteGrid
from labseq.model.grid import read_only
from labseq.roles import Context
from labseq.settings import Angle, FilePath, Length, Settings

Floats = NDArray[np.float64]

PositiveLength = Annotated[Length, Field(gt=0)]
Thresholds: TypeAlias = float | FilePath | tuple[tuple[float, ...], ...]
"""One number for all sites, a number for each, or the path of a .npy file with a number for each."""

COLUMNS: Final = ("row", "col", "y", "x")

UNREADABLE: Final = (OSError, ValueError, TypeError, MemoryError, OverflowError)
"""Exceptions of :func:`read_npy` for a file that it cannot read."""
_MAX_BYTES: Final = 1 << 26


class SiteSettings(Settings):
    """Positions of the sites on the frames.

    The file in `sites` takes precedence over the calibration of sites in use, and that
    over the geometry set here.
    """

    sites: FilePath | None = Field(
        default=None,
        description="file with the place of each site in pixels, for an irregular array; .npy of (y, x), "
        "shape [rows, cols, 2], or .csv with the columns row, col, y, x",
    )
    frame: tuple[PositiveInt, PositiveInt] = Field(
        default=(512, 512),
        description="[height, width] in pixels of the frames that `sites` and `centre_px` belong to",
    )
    centre_px: tuple[float, float] = Field(
        default=(255.5, 255.5),
        description="[y, x] of the grid's centre in pixels, where whole numbers are centres of pixels",
    )
    pixel_size: PositiveLength = Field(
        default=0.35e-6, description="size of a camera pixel in the atom plane"
    )
    angle: Angle = Field(default=0.0, description="rotation of the grid on the frame, clockwise")
    region: PositiveInt = Field(
        default=5, description="width of the region of interest around each site, an odd number of pixels"
    )

    @field_validator("region")
    @classmethod
    def _region_is_odd(cls, region: int) -> int:
        if region % 2 == 0:
            raise ValueError(f"{region} is even; choose an odd width, for example {region + 1}")
        return region


def site_pixels(
    grid: SiteGrid, pixel_size_m: float, centre_px: tuple[float, float], angle_rad: float = 0.0
) -> NDArray[np.float64]:
    """Map the sites onto the camera.

    Args:
        grid: The grid of sites. Its centre is the origin of its positions.
        pixel_size_m: Size of a camera pixel in the atom plane, in metres.
        centre_px: (y, x) of the grid's centre. Whole numbers are the centres of pixels, so the centre of a
            512 x 512 frame is (255.5, 255.5).
        angle_rad: Rotation of the grid about its centre. Positive is clockwise on the screen, where y points
            down.

    Returns:
        float64 (n_rows, n_cols, 2), (y, x) of each site in pixels.

    Example:
        >>> grid = SiteGrid(1, 2, spacing_m=4e-6)
        >>> site_pixels(grid, 1e-6, (10.0, 20.0)).tolist()
        [[[10.0, 18.0], [10.0, 22.0]]]
    """
    x_m, y_m = grid.positions_m[..., 0], grid.positions_m[..., 1]
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    y_px = centre_px[0] + (x_m * sin + y_m * cos) / pixel_size_m
    x_px = centre_px[1] + (x_m * cos - y_m * sin) / pixel_size_m
    return np.stack([y_px, x_px], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class KnownSites:
    """Positions of the sites.

    Attributes:
        positions_px: float64 (n_rows, n_cols, 2), (y, x) of each site in pixels. Read-only.
        frame: (height, width) of the frames that they belong to.
        source: Their source, for messages, such as "the calibration of sites a1b2c3d4e5f6".
        remedy: What to do if they do not match the frames, for messages.
    """

    positions_px: Floats
    frame: tuple[int, int]
    source: str
    remedy: str

    def __post_init__(self) -> None:
        positions = read_only(self.positions_px, np.float64, (-1, -1, 2), "positions_px")
        object.__setattr__(self, "positions_px", positions)


def known_sites(settings: SiteSettings, context: Context) -> KnownSites:
    """The sites from the file in ``sites``, else from the calibration in use, else from the geometry.

    Raises:
        ConfigError: The file cannot be read, or does not have one position for each site.
    """
    if settings.sites is not None:
        return KnownSites(
            read_sites(settings.sites, context.grid.shape),
            settings.frame,
            f"the sites in {settings.sites}",
            "check the file and the detector's `frame`",
        )
    entry = context.calibrations.get("sites")
    if entry is not None:
        height, width = (int(n) for n in entry.values["frame"])
        return KnownSites(
            entry.values["positions_px"],
            (height, width),
            f"the calibration of sites {entry.id}",
            "calibrate the sites with this camera, crop it as it was then, or use another calibration",
        )
    return KnownSites(
        site_pixels(context.grid, settings.pixel_size, settings.centre_px, settings.angle),
        settings.frame,
        "the detector's settings",
        "calibrate the sites, or check the detector's `centre_px`, `pixel_size`, `angle` and `frame`",
    )


def read_sites(path: Path, shape: tuple[int, int]) -> Floats:
    """Read the positions of the sites of an irregular array.

    Args:
        path: A .npy file of floats (n_rows, n_cols, 2) with (y, x) in pixels, or a
            text file with the columns row, col, y and x, named in its first line
            and separated by commas, and one line for each site.
        shape: (n_rows, n_cols) of the grid.

    Returns:
        float64 (n_rows, n_cols, 2).

    Raises:
        ConfigError: The file cannot be read, or does not have one position for each site.
    """
    try:
        positions = read_npy(path) if path.suffix == ".npy" else _table(path, shape)
    except (*UNREADABLE, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigError(
            f"the sites cannot be read from '{path}': {reason}; expected a .npy file of floats "
            f"(n_rows, n_cols, 2), (y, x) in pixels, or a .csv file with the columns {', '.join(COLUMNS)}"
        ) from error
    if positions.shape != (*shape, 2) or not np.isfinite(positions).all():
        came = f"of shape {positions.shape}" if positions.shape != (*shape, 2) else "not all finite"
        raise ConfigError(
            f"the sites in '{path}' are {came}; expected (y, x) for each of {shape[0]} x {shape[1]} sites, "
            f"shape {(*shape, 2)}"
        )
    return positions


def read_npy(path: Path) -> Floats:
    """Read the numbers of a .npy file, or raise one of :data:`UNREADABLE`."""
    return np.lib.format.read_array(io.BytesIO(_data_in(path)), allow_pickle=False).astype(np.float64)


def _data_in(path: Path) -> bytes:
    with open_ordinary(path) as file:
        data = file.read(_MAX_BYTES + 1)
    if len(data) > _MAX_BYTES:
        raise ValueError(f"it is larger than {_MAX_BYTES >> 20} MiB")
    return data


def _table(path: Path, shape: tuple[int, int]) -> Floats:
    positions = np.full((*shape, 2), np.nan)
    with io.TextIOWrapper(io.BytesIO(_data_in(path)), encoding="utf-8-sig", newline="") as file:
        table = csv.DictReader(file, skipinitialspace=True)
        missing = [name for name in COLUMNS if name not in (table.fieldnames or ())]
        if missing:
            raise ValueError(f"it has no column '{missing[0]}'")
        for line in table:
            try:
                row, col = int(line["row"]), int(line["col"])
                place = float(line["y"]), float(line["x"])
            except (TypeError, ValueError):
                raise ValueError(f"line {table.line_num} does not have four numbers") from None
            if not (0 <= row < shape[0] and 0 <= col < shape[1]):
                raise ValueError(
                    f"line {table.line_num} has site ({row}, {col}), which the grid does not have"
                )
            if not np.isnan(positions[row, col, 0]):
                raise ValueError(f"line {table.line_num} has site ({row}, {col}), like an earlier line")
            positions[row, col] = place
    unplaced = np.argwhere(np.isnan(positions[..., 0]))
    if len(unplaced):
        raise ValueError(f"{len(unplaced)} sites are missing, such as ({unplaced[0, 0]}, {unplaced[0, 1]})")
    return positions


def region_corners(known: KnownSites, region: int) -> NDArray[np.int64]:
    """(y, x) of the first pixel of each site's square, int64 (n_sites, 2), row by row.

    The square is centred on the pixel nearest to the site.

    Args:
        known: Positions of the sites.
        region: Width of the squares, odd.

    Raises:
        LimitError: A square reaches over the edge of the frame.
    """
    height, width = known.frame
    corners = np.rint(known.positions_px.reshape(-1, 2)).astype(np.int64) - region // 2
    outside = np.any((corners < 0) | (corners + region > (height, width)), axis=1)
    if outside.any():
        first = int(np.argmax(outside))
        row, col = divmod(first, known.positions_px.shape[1])
        y, x = corners[first]
        last = region - 1
        raise LimitError(
            f"the region of interest of site ({row}, {col}), according to {known.source},",
            f"rows {y} to {y + last} and columns {x} to {x + last} of the frame",
            f"a frame of {height} x {width} pixels",
            f"{known.remedy}, or use a smaller `region`",
        )
    return corners


def checked_image(frame: Frame, known: KnownSites, name: str) -> NDArray[np.uint16]:
    """The image of a frame, if it has the size that the sites belong to.

    Raises:
        DeviceError: It has another size or dtype. ``name`` is the name of the detector.
    """
    image = frame.image
    if image.shape != known.frame or image.dtype != np.uint16:
        height, width = known.frame
        raise DeviceError(
            name,
            f"the frame is {image.dtype} {image.shape}, but according to {known.source} the sites are on "
            f"uint16 frames of ({height}, {width}); {known.remedy}",
        )
    return image
