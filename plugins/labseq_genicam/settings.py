"""Settings of the driver."""

from __future__ import annotations

from typing import Annotated, Final, Literal, TypeAlias

from pydantic import Field, NonNegativeInt

from labseq.plugin import Duration, Fraction, Frequency, PositiveDuration, Settings
from labseq.plugin.camera import IndustrialCameraSettings

PixelFormat: TypeAlias = Literal["Mono8", "Mono10", "Mono12", "Mono14", "Mono16"]

FORMATS: Final[tuple[PixelFormat, ...]] = ("Mono16", "Mono14", "Mono12", "Mono10", "Mono8")
"""Pixel formats, the one with the most bits first."""

SIMULATED: Final = "simulated"
"""Value of `camera` for the simulated camera."""


class FaultSettings(Settings):
    """Failures of the simulated camera; none by default."""

    packet_loss: Fraction = Field(
        default=0.0, description="fraction of the network packets of frames that are never sent"
    )
    failed_frames: tuple[NonNegativeInt, ...] = Field(
        default=(),
        description="frames that lose half of their packets, counted from 0 since the camera was opened",
    )
    late_by: Duration = Field(default=0.0, description="delay of each frame")
    unplugged_at: NonNegativeInt | None = Field(
        default=None,
        description="number, from 0 at opening, of the frame at which it is unplugged; none: never",
    )
    busy: bool = Field(default=False, description="another program controls the camera")
    ignores_triggers: bool = Field(default=False, description="the camera ignores software triggers")


class GenicamSettings(IndustrialCameraSettings):
    """A GigE Vision or USB3 Vision camera."""

    camera: str | None = Field(
        default=None,
        min_length=1,
        description="serial number, id or IP address of the camera; none: the only one that is connected; "
        "`simulated`: a camera on this computer's loopback network that sees the simulated atoms",
    )
    model: str | None = Field(default=None, description="model that the camera must be; none: any")
    serial: str | None = Field(default=None, description="serial number that the camera must have; none: any")
    pixel_format: PixelFormat | None = Field(
        default=None, description="bits of a pixel; none: the most that the camera offers"
    )
    gain: float | None = Field(
        default=None,
        ge=-100,
        le=1e6,
        description="analogue gain in the camera's unit, mostly dB; none: as the camera is set",
    )
    frame_rate: Annotated[Frequency, Field(gt=0)] | None = Field(
        default=None,
        description="exposures per second with the internal trigger, such as `100 Hz`; none: each begins "
        "when the one before is read out",
    )
    packet_size: Annotated[int, Field(ge=576, le=65535)] | None = Field(
        default=None,
        description="bytes of a network packet (GigE); none: as the camera is set, or less if the network "
        "does not transmit that",
    )
    packet_timeout: PositiveDuration = Field(
        default=20e-3, description="time after which a missing network packet is requested again (GigE)"
    )
    frame_timeout: PositiveDuration = Field(
        default=0.5, description="time without a packet after which an incomplete frame is abandoned (GigE)"
    )
    faults: FaultSettings = Field(default=FaultSettings(), description="failures of the simulated camera")

    def identities(self) -> tuple[str, ...]:
        """What only one process can use of it."""
        return () if self.camera == SIMULATED else (f"GenICam camera {self.camera or '(the only one)'}",)
