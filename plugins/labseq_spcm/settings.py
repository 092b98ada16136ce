"""Settings of the driver. The motion and voltages are set in the same section of the profile."""

from __future__ import annotations

from typing import Annotated, Literal, Self, TypeAlias

from pydantic import Field, field_validator, model_validator

from labseq.plugin import Duration, Frequency, Settings, Voltage, format_quantity
from labseq_spcm import limits

Mode: TypeAlias = Literal["replay", "fifo", "dds"]
Channel: TypeAlias = Literal[0, 1]


class KeepWarmSettings(Settings):
    """A tone on each axis that plays whenever no program does, so that the AODs stay warm."""

    row_frequency: Frequency = Field(description="tone of the row axis: within the AOD's band, off the atoms")
    column_frequency: Frequency = Field(description="tone of the column axis, likewise")
    amplitude: Annotated[float, Field(gt=0, le=1)] | None = Field(
        default=None,
        description="of full scale, on both axes; none: the mean power of as many tones as the profile "
        "allows at once",
    )


class SpcmSettings(Settings):
    """Mobile tweezers on a Spectrum M4i.66xx."""

    card: str = Field(
        default="/dev/spcm0",
        min_length=1,
        description="device name in the vendor's driver; `simulated` for a card that exists only in "
        "software, `simulated@FOLDER/NAME` for one that outlives the process",
    )
    serial: int = Field(default=0, ge=0, description="serial number that the card must have; 0: any")
    mode: Mode = Field(
        default="replay",
        description="replay: uploaded whole, then played; fifo: streamed while it is being rendered; "
        "dds: the card's own tones, at most 20 + 1 or 16 + 5",
    )
    sample_rate: Frequency = Field(
        default=625e6, description="samples per second of replay and fifo; the card rounds it to 8 Hz"
    )
    row_channel: Channel = Field(default=0, description="output that drives the row axis")
    column_channel: Channel = Field(default=1, description="output that drives the column axis")
    trigger: Literal["software", "external"] = Field(
        default="software",
        description="what starts a program: the driver, or an edge at the input Ext0, also from a line with "
        "`triggers: mobile_tweezers`",
    )
    trigger_level: Annotated[Voltage, Field(ge=-10, le=10)] = Field(
        default=1.5, description="level of the edge, in steps of 10 mV"
    )
    trigger_edge: Literal["rising", "falling"] = Field(default="rising", description="which edge counts")
    trigger_50_ohm: bool = Field(
        default=False, description="terminate Ext0 with 50 Ohm; otherwise it has 1 kOhm"
    )
    reference_clock: Frequency | None = Field(
        default=None,
        ge=limits.REFERENCE_HZ[0],
        le=limits.REFERENCE_HZ[1],
        description="external reference of the sample clock; none: the card's own",
    )
    fill: Annotated[Duration, Field(ge=1e-3, le=1.0)] = Field(
        default=8e-3,
        description="fifo: playing time that is rendered ahead, about: the card takes powers of two",
    )
    keep_warm: KeepWarmSettings | None = Field(
        default=None, description="tones off the atoms between programs; none: silence"
    )

    @field_validator("sample_rate")
    @classmethod
    def _check_rate(cls, rate_hz: float) -> float:
        low, high = limits.SAMPLE_RATE_HZ
        if not low <= rate_hz <= high:
            raise ValueError(f"expected {_hz(low)} to {_hz(high)}")
        for start, end in limits.RATE_GAPS_HZ:
            if start < rate_hz < end:
                gap = f"from {_hz(start)} to {_hz(end)}"
                raise ValueError(f"the card's clock has a gap {gap}; expected a rate outside of it")
        return rate_hz

    def identities(self) -> tuple[str, ...]:
        """What only one process can use of it."""
        serial = (f"Spectrum card {self.serial}",) if self.serial else ()
        return () if self.card == "simulated" else (f"Spectrum {self.card}", *serial)

    @model_validator(mode="after")
    def _check_channels_and_rate(self) -> Self:
        if self.row_channel == self.column_channel:
            raise ValueError(f"row_channel and column_channel are both {self.row_channel}; expected 0 and 1")
        if self.mode == "fifo" and self.sample_rate > limits.FIFO_RATE_HZ:
            rate, most = _hz(self.sample_rate), _hz(limits.FIFO_RATE_HZ)
            raise ValueError(
                f"sample_rate is {rate}, but the bus carries at most {most} on two channels; lower it, or "
                "use mode: replay"
            )
        return self


def _hz(value: float) -> str:
    return format_quantity(value, "frequency")
