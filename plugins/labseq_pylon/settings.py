"""Settings of the driver."""

from __future__ import annotations

from typing import Annotated, Final, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from labseq.plugin.camera import IndustrialCameraSettings

PixelFormat: TypeAlias = Literal["Mono8", "Mono10", "Mono12", "Mono16"]

BITS: Final[dict[PixelFormat, int]] = {"Mono16": 16, "Mono12": 12, "Mono10": 10, "Mono8": 8}
"""Bits of a pixel, by pixel format, the most first."""

SIMULATED: Final = "simulated"
"""Value of `camera` for the simulated camera."""


class PylonSettings(IndustrialCameraSettings):
    """A Basler camera."""

    camera: str | None = Field(
        default=None,
        min_length=1,
        description="serial number of the camera; none: the only one that is connected; `simulated`: pylon's "
        "emulated camera, which sees the simulated atoms",
    )
    model: str | None = Field(default=None, description='expected model, such as "acA1920-40um"; none: any')
    pixel_format: PixelFormat | None = Field(
        default=None, description="bits of a pixel; none: the most that the camera offers"
    )
    gain: float | None = Field(
        default=None, ge=-100, le=100, description="analogue gain in dB; none: as the camera is set"
    )
    gain_raw: int | None = Field(
        default=None,
        ge=0,
        description="analogue gain in steps of the camera, for older cameras that have no gain in dB",
    )
    packet_size: Annotated[int, Field(ge=220, le=16404)] | None = Field(
        default=None, description="bytes of a network packet (GigE); none: as the camera is set"
    )

    def identities(self) -> tuple[str, ...]:
        """What only one process can use of it."""
        return () if self.camera == SIMULATED else (f"Basler camera {self.camera or '(the only one)'}",)

    @model_validator(mode="after")
    def _one_gain(self) -> Self:
        if self.gain is not None and self.gain_raw is not None:
            raise ValueError("gain and gain_raw are both set; set one of them")
        return self
