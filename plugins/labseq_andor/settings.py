"""Settings of the driver."""

from __future__ import annotations

from typing import Annotated, Final, Literal, Self

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from labseq.plugin import Duration, Frequency, PositiveDuration
from labseq.plugin.camera import CameraSettings, Cooling
from labseq_andor.heads import IXON_897, Head, known_head, readout_s

SIMULATED: Final = "simulated"
"""Value of `camera` for the simulated camera."""

HIGH_GAIN: Final = 300
"""EM gain above which the register ages fast. The SDK calls higher gains "advanced"."""


class AndorSettings(CameraSettings):
    """An Andor EMCCD camera, through Andor's SDK2."""

    camera: Literal["connected", "simulated"] = Field(
        default="connected",
        description="the camera connected to this computer, or a simulated one",
    )
    serial: int = Field(
        default=0, ge=0, description="serial number of the camera, or 0 for the only one connected"
    )
    model: str = Field(
        default="",
        description="beginning of the camera's model name, such as DU-897. Other models are refused, and "
        "sensor and read-out time are known before the camera is opened",
    )
    sdk: str = Field(
        default="", description="file of Andor's library, or empty for where Andor's installer puts it"
    )
    arming_time: Duration = Field(
        default=5.5e-3,
        description="time from arming for a series until it can be triggered, for budgets. Simulated "
        "cameras take this long",
    )
    em_gain: PositiveInt = Field(
        default=1, le=1000, description="mean gain of the EM register during exposures, or 1 for none"
    )
    allow_high_gain: bool = Field(
        default=False, description="allow an EM gain above 300, at which the register ages fast"
    )
    amplifier: Literal["em", "conventional"] = Field(
        default="em", description="output amplifier, either behind the EM register or the conventional one"
    )
    readout_rate: Annotated[Frequency, Field(gt=0)] | None = Field(
        default=None, description="pixels per second, such as `10 MHz`, or none for the fastest"
    )
    preamp_gain: PositiveFloat | None = Field(
        default=None, description="gain of the pre-amplifier that the camera offers, or none for its first"
    )
    vertical_shift_speed: PositiveDuration | None = Field(
        default=None,
        description="time to shift the rows by one, such as `0.5 us`, or none for Andor's recommendation",
    )
    frame_transfer: bool = Field(
        default=False,
        description="expose the next frame while one is read. Light is then collected between exposures too",
    )
    isolated_crop: bool = Field(
        default=False,
        description="read the region as if it were the whole sensor, which is faster. No light may "
        "fall on the rest of the sensor. Needs frame_transfer",
    )
    baseline_clamp: bool = Field(default=True, description="let the camera stabilize its offset")
    shutter: Literal["open", "auto"] = Field(
        default="open",
        description="`open` keeps it open between exposures. `auto` does not, which wears it out",
    )
    shutter_opens_at: Literal["high", "low"] = Field(
        default="high", description="level of the shutter output that opens an external shutter"
    )
    trigger_edge: Literal["rising", "falling"] = Field(
        default="rising", description="edge at the trigger input that starts an exposure"
    )
    fast_trigger: bool = Field(
        default=False,
        description="accept an external trigger before the sensor's cleaning cycle has ended",
    )
    fan: Literal["full", "low", "off"] = Field(
        default="full", description="speed of the fan, `off` only with cooling water"
    )
    cooling: Cooling | None = Field(
        default=None, description="temperature of the sensor, or none to leave the cooler as it is"
    )
    cooler_after_close: Literal["keep", "off"] = Field(
        default="keep", description="whether the cooler stays on when the camera is closed"
    )

    @property
    def head(self) -> Head | None:
        """The head that `model` names, None if it is not known."""
        return known_head(self.model)

    def readout_s(self, head: Head | None, sensor_shape: tuple[int, int] | None) -> float:
        """Estimated read-out time in seconds, an iXon 897's if the head is not known."""
        head = head or IXON_897
        return readout_s(
            self.readout_rate or head.rates_hz(self.amplifier)[0],
            self.vertical_shift_speed or head.shifts_s[head.recommended_shift],
            sensor_shape or head.sensor_shape,
            self.mode,
            isolated_crop=self.isolated_crop,
        )

    def identities(self) -> tuple[str, ...]:
        """Names of the camera, which only one process can use."""
        return () if self.camera == SIMULATED else (f"Andor camera {self.serial or '(the only one)'}",)

    @model_validator(mode="after")
    def _gain_is_allowed(self) -> Self:
        if self.em_gain > HIGH_GAIN and not self.allow_high_gain:
            text = f"em_gain is {self.em_gain}, but above {HIGH_GAIN} the EM register ages fast"
            raise ValueError(f"{text}; lower it, or set `allow_high_gain: true`")
        if self.em_gain > 1 and self.amplifier == "conventional":
            text = f"em_gain is {self.em_gain}, but the conventional amplifier has no EM register"
            raise ValueError(f"{text}; use `amplifier: em`, or leave em_gain out")
        return self

    @model_validator(mode="after")
    def _bulb_is_possible(self) -> Self:
        if self.line_trigger == "bulb" and self.frame_transfer and "885" not in self.model:
            text = "no iXon but the 885 has `line_trigger: bulb` with frame transfer"
            raise ValueError(f"{text}; set `frame_transfer: false`, or `line_trigger: external`")
        return self

    @model_validator(mode="after")
    def _crop_is_possible(self) -> Self:
        if not self.isolated_crop:
            return self
        if self.region is None:
            raise ValueError("isolated_crop needs a `region`, the part of the sensor to use")
        if not self.frame_transfer or self.amplifier != "em":
            raise ValueError("isolated_crop needs `frame_transfer: true` and `amplifier: em`")
        return self
