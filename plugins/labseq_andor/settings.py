"""Settings of the driver."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Final, Literal, Self

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from labseq.plugin import CameraSettings, CoolingSettings, Duration, Frequency
from labseq_andor.heads import HEADS, IXON_897, Head, ReadOut, known_head

SIMULATED: Final = "simulated"
"""The camera that needs no camera."""

HIGH_GAIN: Final = 300
"""EM gain above which the register ages fast; the SDK calls the range beyond it advanced."""


class AndorSettings(CameraSettings):
    """An Andor EMCCD camera, by Andor's SDK2."""

    camera: Literal["connected", "simulated"] = Field(
        default="connected",
        description="the camera at this computer, or one that exists only in software",
    )
    serial: int = Field(
        default=0, ge=0, description="serial number that the camera must have; 0: any, if there is one only"
    )
    model: str = Field(
        default="",
        description="what the model that answers must begin with, as DU-897; with it, sensor and read-out "
        "time are known before the camera is opened",
    )
    sdk: str = Field(default="", description="file of Andor's library; none: where Andor's installer puts it")
    em_gain: PositiveInt = Field(
        default=1, le=1000, description="mean gain of the EM register in exposures; 1: none"
    )
    allow_high_gain: bool = Field(
        default=False, description="allow an EM gain above 300, at which the register ages fast"
    )
    amplifier: Literal["em", "conventional"] = Field(
        default="em", description="the sensor's output: through the EM register, or past it"
    )
    readout_rate: Annotated[Frequency, Field(gt=0)] | None = Field(
        default=None, description="pixels per second, as `10 MHz`; none: the amplifier's fastest"
    )
    preamp_gain: PositiveFloat | None = Field(
        default=None, description="gain before the converter, as the camera names it; none: its first"
    )
    vertical_shift_speed: Annotated[Duration, Field(gt=0)] | None = Field(
        default=None,
        description="time to shift the rows by one, as `0.5 us`; none: what the maker recommends",
    )
    frame_transfer: bool = Field(
        default=False,
        description="expose the next frame while one is read; light is then collected between exposures too",
    )
    isolated_crop: bool = Field(
        default=False,
        description="read the region as if there were no other sensor, which is faster; no light may "
        "fall on the rest. Needs frame_transfer",
    )
    baseline_clamp: bool = Field(default=True, description="let the camera hold its offset steady")
    shutter: Literal["open", "auto"] = Field(
        default="open", description="open: also between exposures; auto: in exposures only, which wears it"
    )
    shutter_opens_at: Literal["high", "low"] = Field(
        default="high", description="level of the shutter output that opens an external shutter"
    )
    trigger_edge: Literal["rising", "falling"] = Field(
        default="rising", description="edge at the trigger input that starts an exposure"
    )
    fast_trigger: bool = Field(
        default=False,
        description="external trigger: do not wait until a cleaning cycle of the sensor has ended",
    )
    fan: Literal["full", "low", "off"] = Field(
        default="full", description="the fan; off only with cooling water"
    )
    cooling: CoolingSettings | None = Field(
        default=None, description="how cold the sensor shall be; none: the cooler is left as it is"
    )
    cooler_after_close: Literal["keep", "off"] = Field(
        default="keep", description="whether the cooler stays on when the camera is closed"
    )

    @property
    def head(self) -> Head | None:
        """The head that `model` names; None if it is not known."""
        return known_head(self.model)

    def head_for(self, sensor_shape: tuple[int, int]) -> Head:
        """A head for the simulated camera: what the settings ask for, as far as one is known.

        Args:
            sensor_shape: (height, width) of the simulated sensor.
        """
        head = self.head
        if head is None:
            heads = sorted(HEADS, key=lambda head: head.sensor_shape != sensor_shape)
            having = [head for head in heads if self.readout_rate in (None, *self._rates_hz(head))]
            head = (having or heads)[0]
        return replace(head, model=self.model.upper() or head.model, sensor_shape=sensor_shape)

    def readout_s(self, head: Head | None, sensor_shape: tuple[int, int] | None) -> float:
        """Estimated read-out time in seconds; that of an iXon 897 for a head that is not known."""
        head = head or IXON_897
        shift_s = self.vertical_shift_speed or head.shifts_s[head.recommended_shift]
        read_out = ReadOut(self.readout_rate or self._rates_hz(head)[0], shift_s, self.isolated_crop)
        return read_out.duration_s(sensor_shape or head.sensor_shape, self.mode)

    def _rates_hz(self, head: Head) -> tuple[float, ...]:
        return head.em_rates_hz if self.amplifier == "em" else head.conventional_rates_hz

    @model_validator(mode="after")
    def _gain_is_allowed(self) -> Self:
        if self.em_gain > HIGH_GAIN and not self.allow_high_gain:
            text = f"em_gain is {self.em_gain}: above {HIGH_GAIN} the EM register ages fast"
            raise ValueError(f"{text}; lower it, or set `allow_high_gain: true`")
        if self.em_gain > 1 and self.amplifier == "conventional":
            text = f"em_gain is {self.em_gain}, but the conventional amplifier has no EM register"
            raise ValueError(f"{text}; use `amplifier: em`, or leave em_gain out")
        return self

    @model_validator(mode="after")
    def _crop_is_possible(self) -> Self:
        if not self.isolated_crop:
            return self
        if self.region is None:
            raise ValueError("isolated_crop needs a `region`: the part of the sensor that is used")
        if not self.frame_transfer or self.amplifier != "em":
            raise ValueError("isolated_crop needs `frame_transfer: true` and `amplifier: em`")
        return self
