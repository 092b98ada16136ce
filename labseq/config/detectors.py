"""Settings of the detector that comes with labseq."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt, field_validator

from labseq.config.settings import Angle, FilePath, Length, Settings


class ThresholdSettings(Settings):
    """A region of interest and a threshold per site.

    The defaults fit the virtual lab: they give the paper's mean detection
    fidelity of 99.946 % on its frames.
    """

    frame: tuple[PositiveInt, PositiveInt] = Field(
        default=(512, 512), description="[height, width] in pixels of the frames that the sites were found on"
    )
    centre_px: tuple[float, float] = Field(
        default=(255.5, 255.5),
        description="[y, x] of the grid's centre in pixels; whole numbers are the middles of pixels",
    )
    pixel_size: Annotated[Length, Field(gt=0)] = Field(
        default=0.35e-6, description="size of a camera pixel in the atom plane"
    )
    angle: Angle = Field(default=0.0, description="rotation of the grid on the frame, clockwise")
    region: PositiveInt = Field(
        default=5, description="width of the region of interest around each site, in pixels; odd"
    )
    shape: Literal["square", "disc"] = Field(default="square", description="shape of the region of interest")
    offset: float = Field(default=500.0, description="counts of a dark pixel")
    threshold: float | FilePath | tuple[tuple[float, ...], ...] = Field(
        default=1630.0,
        description="counts over the offset, summed over the region, above which there is an atom: "
        "one number, one for each site (rows of numbers), or the path of a .npy file with one for each site",
    )
    width: PositiveFloat = Field(
        default=130.0,
        description="distance of the counts from the threshold at which the confidence reaches 0.76",
    )

    @field_validator("region")
    @classmethod
    def _region_is_odd(cls, region: int) -> int:
        if region % 2 == 0:
            raise ValueError(f"{region} is even; a region has a pixel in its middle: choose {region + 1}")
        return region
