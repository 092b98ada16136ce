"""Settings of the drivers for GenICam cameras."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Final, Literal, Self, TypeAlias

from pydantic import Field, NonNegativeInt, field_validator, model_validator

from labseq.plugin import Duration, Fraction, Frequency, LimitError, PositiveDuration, Settings
from labseq.plugin.camera import CameraSettings

PixelFormat: TypeAlias = Literal["Mono8", "Mono10", "Mono12", "Mono14", "Mono16"]

BITS: Final[Mapping[str, int]] = {"Mono16": 16, "Mono14": 14, "Mono12": 12, "Mono10": 10, "Mono8": 8}
"""Bits of a pixel, by pixel format, the most first."""

SIMULATED: Final = "simulated"
"""Value of `camera` for the simulated camera."""


class StandardSettings(CameraSettings):
    """Settings of every camera with the features of the GenICam standard."""

    camera: str | None = Field(
        default=None, min_length=1, description="which camera, or none for the only one connected"
    )
    model: str | None = Field(default=None, description="model that the camera must be, or none for any")
    pixel_format: PixelFormat | None = Field(
        default=None, description="bits of a pixel, or none for the most that the camera offers"
    )
    readout: Duration = Field(
        default=5e-3,
        description="time from the end of an exposure until its frame can be read, for budgets. The "
        "simulated camera takes this long",
    )
    arming_time: Duration = Field(
        default=40e-3,
        description="time from arming for a series until it can be triggered, for budgets. Simulated "
        "cameras take this long",
    )
    frame_rate: Annotated[Frequency, Field(gt=0)] | None = Field(
        default=None,
        description="exposures per second with the internal trigger, such as `100 Hz`. With none, each "
        "begins when the previous frame is read out",
    )
    trigger_line: str = Field(
        default="Line1", min_length=1, description="input of the external trigger, as the camera calls it"
    )
    trigger_edge: Literal["rising", "falling"] = Field(
        default="rising", description="edge of the external trigger that starts an exposure"
    )
    gain: float | None = Field(
        default=None,
        ge=-100,
        le=1e6,
        description="analogue gain in the camera's unit, mostly dB, or none to keep the present gain",
    )
    gain_raw: int | None = Field(
        default=None,
        ge=0,
        description="analogue gain in steps of the camera, for older cameras that have no `gain`",
    )
    packet_size: Annotated[int, Field(ge=220, le=65535)] | None = Field(
        default=None, description="bytes of a network packet (GigE), or none to keep the present size"
    )
    packet_delay: Duration | None = Field(
        default=None,
        description="pause between two network packets (GigE), for cameras on one cable, or none to keep "
        "the present pause",
    )

    @field_validator("camera", "serial", mode="before", check_fields=False)
    @classmethod
    def _number_is_text(cls, value: object) -> object:
        """YAML reads a serial number without quotes as a number."""
        return str(value) if type(value) is int else value

    @model_validator(mode="after")
    def _one_gain(self) -> Self:
        if self.gain is not None and self.gain_raw is not None:
            raise ValueError("gain and gain_raw are both set; set one of them")
        return self

    def region_on(self, sensor_shape: tuple[int, int], name: str) -> tuple[int, int, int, int]:
        """First row, first column, height and width of the region on a sensor of (height, width) pixels.

        Raises:
            LimitError: It goes beyond the sensor of the camera ``name``.
        """
        y, x, height, width = self.mode.region or (0, 0, *sensor_shape)
        if y + height > sensor_shape[0] or x + width > sensor_shape[1]:
            end, size = f"row {y + height}, column {x + width}", "{} x {} pixels".format(*sensor_shape)
            hint = "choose a smaller or another region"
            raise LimitError(f"{name}: end of the region", end, f"the sensor's {size}", hint)
        return y, x, height, width


class FaultSettings(Settings):
    """Failures of the simulated camera, by default none."""

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
        description="number, from 0 at opening, of the frame at which it is unplugged, or none for never",
    )
    busy: bool = Field(default=False, description="another program controls the camera")
    ignores_triggers: bool = Field(default=False, description="the camera ignores software triggers")


class GenicamSettings(StandardSettings):
    """A GigE Vision or USB3 Vision camera."""

    camera: str | None = Field(
        default=None,
        min_length=1,
        description="serial number, id or IP address of the camera, or none for the only one connected. "
        "`simulated` is a camera on this computer's loopback network that sees the simulated atoms",
    )
    serial: str | None = Field(default=None, description="serial number of the camera, or none for any")
    packet_timeout: PositiveDuration = Field(
        default=20e-3, description="time after which a missing network packet is requested again (GigE)"
    )
    frame_timeout: PositiveDuration = Field(
        default=0.5, description="time without a packet after which an incomplete frame is abandoned (GigE)"
    )
    faults: FaultSettings = Field(default=FaultSettings(), description="failures of the simulated camera")

    def identities(self) -> tuple[str, ...]:
        """Names of the camera, which only one process can use."""
        return () if self.camera == SIMULATED else (f"GenICam camera {self.camera or '(the only one)'}",)
