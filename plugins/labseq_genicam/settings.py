"""Settings of the driver."""

from __future__ import annotations

from typing import Annotated, Final, Literal, TypeAlias

from pydantic import Field, NonNegativeInt, field_validator

from labseq.plugin import Duration, Fraction, Frequency, IndustrialCameraSettings, Settings

PixelFormat: TypeAlias = Literal["Mono8", "Mono10", "Mono12", "Mono14", "Mono16"]

FORMATS: Final[tuple[PixelFormat, ...]] = ("Mono16", "Mono14", "Mono12", "Mono10", "Mono8")
"""Pixel formats, the one with the most bits first."""

SIMULATED: Final = "simulated"
"""The camera that needs no camera."""


class FaultSettings(Settings):
    """Failures to rehearse with the simulated camera; none by default."""

    packet_loss: Fraction = Field(
        default=0.0, description="fraction of the network packets of frames that are never sent"
    )
    failed_frames: tuple[NonNegativeInt, ...] = Field(
        default=(), description="frames that lose half of their packets, counted from 0 since it was opened"
    )
    late_by: Duration = Field(default=0.0, description="how late each frame comes")
    unplugged_at: NonNegativeInt | None = Field(
        default=None, description="frame at which the camera is gone, counted likewise; none: never"
    )
    busy: bool = Field(default=False, description="another program controls the camera")
    ignores_triggers: bool = Field(default=False, description="its software trigger leads nowhere")


class GenicamSettings(IndustrialCameraSettings):
    """A GigE Vision or USB3 Vision camera."""

    camera: str | None = Field(
        default=None,
        min_length=1,
        description="serial number, id or IP address of the camera; none: the only one that is connected; "
        "`simulated`: a camera on this computer's own network, which shows the simulated atoms",
    )
    model: str | None = Field(default=None, description="model that the camera must be; none: any")
    serial: str | None = Field(default=None, description="serial number that the camera must have; none: any")
    pixel_format: PixelFormat | None = Field(
        default=None, description="bits of a pixel; none: as many as the camera has"
    )
    gain: float | None = Field(
        default=None,
        ge=-100,
        le=1e6,
        description="analogue gain in the camera's unit, mostly dB; none: as the camera is set",
    )
    frame_rate: Annotated[Frequency, Field(gt=0)] | None = Field(
        default=None,
        description="exposures per second with the internal trigger, as `100 Hz`; none: each begins at the "
        "end of the read-out before",
    )
    packet_size: Annotated[int, Field(ge=576, le=65535)] | None = Field(
        default=None,
        description="bytes of a network packet (GigE); none: as the camera is set, or less if that does not "
        "come through",
    )
    packet_timeout: Annotated[Duration, Field(gt=0)] = Field(
        default=20e-3, description="after which time a missing network packet is asked for again (GigE)"
    )
    frame_timeout: Annotated[Duration, Field(gt=0)] = Field(
        default=0.5, description="after which time without a packet an incomplete frame is given up (GigE)"
    )
    faults: FaultSettings = Field(
        default=FaultSettings(), description="failures to rehearse with the simulated camera"
    )

    @field_validator("camera", "serial", mode="before")
    @classmethod
    def _number_is_text(cls, value: object) -> object:
        """YAML takes a serial number without quotes for a number."""
        return str(value) if type(value) is int else value
