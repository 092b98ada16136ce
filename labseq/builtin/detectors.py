"""Settings of the built-in detectors."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, field_validator

from labseq.settings import Angle, FilePath, Fraction, Length, Settings

PositiveLength = Annotated[Length, Field(gt=0)]
Thresholds: TypeAlias = float | FilePath | tuple[tuple[float, ...], ...]


class _RegionSettings(Settings):
    """Where the sites are on the frames.

    The file in `sites` counts before a calibration of sites that is in use, and that
    before the geometry that is set here.
    """

    sites: FilePath | None = Field(
        default=None,
        description="file with the place of each site, for an irregular array: .npy of (y, x), shape "
        "[rows, cols, 2], or .csv with the columns row, col, y, x; in pixels",
    )
    frame: tuple[PositiveInt, PositiveInt] = Field(
        default=(512, 512),
        description="[height, width] in pixels of the frames that `sites` and `centre_px` belong to",
    )
    centre_px: tuple[float, float] = Field(
        default=(255.5, 255.5),
        description="[y, x] of the grid's centre in pixels; whole numbers are the middles of pixels",
    )
    pixel_size: PositiveLength = Field(
        default=0.35e-6, description="size of a camera pixel in the atom plane"
    )
    angle: Angle = Field(default=0.0, description="rotation of the grid on the frame, clockwise")
    region: PositiveInt = Field(
        default=5, description="width of the region of interest around each site, in pixels; odd"
    )

    @field_validator("region")
    @classmethod
    def _region_is_odd(cls, region: int) -> int:
        if region % 2 == 0:
            raise ValueError(f"{region} is even; a region has a pixel in its middle: choose {region + 1}")
        return region


class ThresholdSettings(_RegionSettings):
    """A region of interest and a threshold per site.

    The defaults fit the virtual lab: they give the paper's mean detection
    fidelity of 99.946 % on its frames.
    """

    shape: Literal["square", "disc"] = Field(default="square", description="shape of the region of interest")
    offset: float = Field(default=500.0, description="counts of a dark pixel")
    threshold: Thresholds = Field(
        default=1630.0,
        description="counts over the offset, summed over the region, above which there is an atom, "
        "unless a calibration of thresholds is in use: one number, one for each site (rows of numbers), or "
        "the path of a .npy file with one for each site",
    )
    width: PositiveFloat = Field(
        default=130.0,
        description="distance of the counts from the threshold at which the confidence reaches 0.76",
    )


class WeightedSettings(_RegionSettings):
    """The likelihood of an atom from spot-shaped weights, with the neighbours' light undone.

    Fewer errors than with `threshold`, for more to be known of the camera. The
    defaults fit the virtual lab.
    """

    region: PositiveInt = Field(
        default=9,
        description="width of the square of pixels that is weighed around each site; odd, and at least "
        "six times the width of the spot",
    )
    spot: PositiveLength = Field(
        default=0.42e-6, description="width (1 sigma of a Gaussian) of an atom's image in the atom plane"
    )
    photoelectrons: Annotated[float, Field(gt=0, le=5000)] = Field(
        default=60.0, description="mean photoelectrons of an atom in an exposure"
    )
    background: Annotated[float, Field(ge=1e-4, le=1000)] = Field(
        default=0.375,
        description="mean photoelectrons of a pixel without atoms: stray light, dark current, clock-induced "
        "charge",
    )
    filling: Fraction = Field(
        default=0.75,
        description="fraction of the sites that hold atoms: how much light neighbours are expected to give",
    )
    offset: float = Field(default=500.0, description="counts of a dark pixel")
    counts_per_photoelectron: PositiveFloat = Field(
        default=60.0, description="mean counts of one photoelectron: the EM gain over the electrons per count"
    )
    read_noise: NonNegativeFloat = Field(
        default=16.0, description="read noise in counts r.m.s.; rounding to whole counts is added"
    )
    em_register: bool = Field(
        default=True,
        description="whether photoelectrons are multiplied with the excess noise of an EM register (true for "
        "an EMCCD with a high gain, false for a CMOS camera or a gain that is off)",
    )
    threshold: Thresholds = Field(
        default=0.0,
        description="log-odds above which there is an atom; lower misses fewer atoms and imagines more; used "
        "unless a calibration of thresholds is in use: one number, one for each site (rows of numbers), or "
        "the path of a .npy file with one for each site",
    )
    width: PositiveFloat = Field(
        default=2.0,
        description="distance of the log-odds from the threshold at which the confidence reaches 0.76; "
        "with 2 the confidence is that of the likelihood",
    )
