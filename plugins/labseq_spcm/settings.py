"""Settings of the driver. The motion and voltages are set in the same section of the profile."""

from __future__ import annotations

from typing import Annotated, Final, Literal, Self, TypeAlias

from pydantic import Field, field_validator, model_validator

from labseq.plugin import Duration, FilePath, Frequency, Settings, Voltage, format_quantity
from labseq_spcm import limits
from labseq_spcm.models import ANY, MODELS, Model

Mode: TypeAlias = Literal["sequence", "replay", "fifo", "stream"]
Channel: TypeAlias = Literal[0, 1, 2, 3]

NO_TRIGGER: Final = "takes no external trigger, since a stream waits for nothing; use `mode: sequence`"


class KeepWarmSettings(Settings):
    """A tone on each axis that plays whenever no program does, so that the AODs stay warm."""

    row_frequency: Frequency = Field(description="tone of the row axis, in the AOD's band and off the atoms")
    column_frequency: Frequency = Field(description="tone of the column axis, likewise")
    amplitude: Annotated[float, Field(gt=0, le=1)] | None = Field(
        default=None,
        description="part of full scale, on both axes. With none, the mean power of as many tones as the "
        "profile allows at once",
    )


class CardFaults(Settings):
    """Differences of the simulated card from the driver's assumptions, by default none."""

    copies_samples: bool = Field(
        default=False,
        description="samples are copied when they are handed over, as with a NETBOX or a bounce buffer",
    )
    position_lag: Duration = Field(default=0.0, description="how late the position of a transfer is reported")
    fifo_short: int = Field(
        default=0, ge=0, description="bytes by which the card's buffer is shorter than its nominal size"
    )
    pinning: Duration = Field(default=0.0, description="time to name a transfer buffer")
    underrun_not_ready: bool = Field(
        default=False, description="a card that ran dry reports the overrun, but not that it is ready"
    )
    slow_small_blocks: bool = Field(
        default=False, description="small notify sizes slow the bus down, as in the manual's table"
    )
    first_contact: FilePath | None = Field(
        default=None,
        description="file of `labseq first-contact` with the behaviour of the simulated card, or none for "
        "what the driver assumes",
    )


class SpcmSettings(Settings):
    """Mobile tweezers on a Spectrum M4i.66xx."""

    card: str = Field(
        default="/dev/spcm0",
        min_length=1,
        description="device name in the vendor's driver, or `simulated` for a card only in software",
    )
    model: str = Field(
        default="",
        description="product name that the card must have, such as M4i.6631-x8, or M4i.6631-x8-hbw with that "
        "option, to check its limits before it is opened, or empty for any",
    )
    serial: int = Field(default=0, ge=0, description="serial number that the card must have, or 0 for any")
    mode: Mode = Field(
        default="sequence",
        description="`sequence` uploads a program in parts while an idle loop plays, then jumps to it. "
        "`replay` uploads it whole, then plays it. `fifo` streams it while it is being rendered. "
        "`stream` does so too, spliced into silence that the card plays all the time",
    )
    sample_rate: Frequency = Field(
        default=625e6, description="samples per second, which the card rounds to 8 Hz"
    )
    row_channel: Channel = Field(default=0, description="output that drives the row axis")
    column_channel: Channel | None = Field(
        default=None, description="output that drives the column axis. With none, the other of 0 and 1"
    )
    trigger: Literal["software", "external"] = Field(
        default="software",
        description="what starts a program, the driver or an edge at the input Ext0, also from a line with "
        "`triggers: mobile_tweezers`",
    )
    trigger_level: Annotated[Voltage, Field(ge=-10, le=10)] = Field(
        default=1.5, description="level of the edge, in steps of 10 mV"
    )
    trigger_edge: Literal["rising", "falling"] = Field(default="rising", description="which edge counts")
    trigger_50_ohm: bool = Field(default=False, description="terminate Ext0 with 50 Ohm instead of 1 kOhm")
    reference_clock: Frequency | None = Field(
        default=None,
        ge=limits.REFERENCE_HZ[0],
        le=limits.REFERENCE_HZ[1],
        description="external reference of the sample clock, or none for the card's own",
    )
    fill: Annotated[Duration, Field(ge=1e-3, le=1.0)] | None = Field(
        default=None,
        description="playing time to render ahead. With none, 20 ms for stream, 8 ms for fifo. fifo takes "
        "it roughly, because the card takes powers of two",
    )
    look_ahead: Annotated[Duration, Field(gt=0, le=10e-3)] | None = Field(
        default=None,
        description="for `stream`, how far ahead of the outputs a program begins, and how long it takes at "
        "most to reach them. With none, 0.25 ms, or more if the card's buffers hold more at this sample rate",
    )
    notify_size: int = Field(
        default=1 << 16,
        ge=1 << 12,
        le=1 << 19,
        description="for `stream`, bytes after which the card reports what it has fetched, a power of two. "
        "Programs begin at multiples of it",
    )
    card_buffer: int = Field(
        default=1 << 17,
        ge=1 << 13,
        le=1 << 24,
        description="for `stream`, bytes of on-board memory to use, a power of two, at least 2 notify_size",
    )
    faults: CardFaults = Field(
        default=CardFaults(), description="how the simulated card differs from what a real card should do"
    )
    keep_warm: KeepWarmSettings | None = Field(
        default=None, description="for `sequence` and `stream`, tones off the atoms between programs"
    )

    @field_validator("model")
    @classmethod
    def _check_model(cls, name: str) -> str:
        if name and name not in MODELS:
            raise ValueError(f"expected one of {', '.join(MODELS)}")
        return name

    @property
    def limits(self) -> Model:
        """Limits of the card, as far as the profile names it."""
        return MODELS.get(self.model, ANY)

    @property
    def outputs(self) -> tuple[int, int]:
        """The outputs of rows and columns."""
        column = 1 - self.row_channel if self.column_channel is None else self.column_channel
        return self.row_channel, column

    @property
    def row_index(self) -> int:
        """Place of the row axis in a pair of samples, which is in ascending order of the outputs."""
        return int(self.outputs[0] > self.outputs[1])

    @field_validator("sample_rate")
    @classmethod
    def _check_rate(cls, rate_hz: float) -> float:
        low, high = ANY.rate_hz
        if not low <= rate_hz <= high:
            raise ValueError(f"expected {_hz(low)} to {_hz(high)}")
        for start, end in limits.RATE_GAPS_HZ:
            if start < rate_hz < end:
                gap = f"from {_hz(start)} to {_hz(end)}"
                raise ValueError(f"the card's clock has a gap {gap}; expected a rate outside of it")
        return rate_hz

    def identities(self) -> tuple[str, ...]:
        """The names of the card, which only one process can use."""
        serial = (f"Spectrum card {self.serial}",) if self.serial else ()
        return () if self.card == "simulated" else (f"Spectrum {self.card}", *serial)

    @model_validator(mode="after")
    def _check_outputs(self) -> Self:
        row, column = self.outputs
        if column < 0:
            raise ValueError(
                f"row_channel is {row}; expected column_channel, which is only left out for 0 and 1"
            )
        if row == column:
            raise ValueError(f"row_channel and column_channel are both {row}; expected two outputs")
        if self.model and max(row, column) >= self.limits.n_outputs:
            numbers = " and ".join(map(str, range(self.limits.n_outputs)))
            channels = f"row_channel is {row} and column_channel {column}"
            raise ValueError(f"{channels}; expected two of the {self.model}'s: {numbers}")
        return self

    @model_validator(mode="after")
    def _check_bus_rate(self) -> Self:
        if self.mode not in ("fifo", "stream"):
            return self
        if self.card.upper().startswith("TCPIP"):
            needed = f"{limits.FRAME_BYTES * self.sample_rate / 1e9:.2g} GB/s"
            raise ValueError(
                f"`mode: {self.mode}` needs {needed}, which the network to {self.card} does not carry; "
                "use `mode: replay`"
            )
        if self.sample_rate > self.limits.fifo_rate_hz:
            rate, most = _hz(self.sample_rate), _hz(self.limits.fifo_rate_hz)
            raise ValueError(
                f"sample_rate is {rate}, but the bus carries at most {most} on two channels; lower it, or "
                "use `mode: sequence`"
            )
        return self

    @field_validator("notify_size", "card_buffer")
    @classmethod
    def _check_power_of_two(cls, n_bytes: int) -> int:
        if n_bytes & (n_bytes - 1):
            raise ValueError("expected a power of two")
        return n_bytes

    @model_validator(mode="after")
    def _check_stream(self) -> Self:
        if self.keep_warm is not None and self.mode not in ("sequence", "stream"):
            raise ValueError(
                f"keep_warm is set, but `mode: {self.mode}` leaves the AODs dark while it uploads "
                "programs; use `mode: sequence`, or leave keep_warm out"
            )
        if self.mode != "stream":
            return self
        if self.trigger == "external":
            raise ValueError(f"`mode: stream` {NO_TRIGGER}")
        if self.card_buffer < 2 * self.notify_size:
            least = f"at least twice notify_size, {2 * self.notify_size}"
            why = "the card reports whole blocks, and is started when it has one"
            raise ValueError(f"card_buffer is {self.card_buffer}; expected {least}, since {why}")
        least_s = self._buffered_s(self.sample_rate)
        if self.look_ahead is not None and self.look_ahead < least_s:
            look_ahead, least = (format_quantity(s, "time") for s in (self.look_ahead, least_s))
            raise ValueError(
                f"look_ahead is {look_ahead}; expected at least {least}, for the card's own buffers and two "
                "blocks of notify_size at this sample_rate"
            )
        return self

    def _buffered_s(self, sample_rate_hz: float) -> float:
        n_bytes = self.card_buffer + limits.OUTPUT_FIFO_BYTES + 2 * self.notify_size
        return n_bytes / limits.FRAME_BYTES / sample_rate_hz

    @property
    def overhead_per_cycle_s(self) -> float:
        """Time from a cycle's plan to its light in the present mode (measured, see the timing budget)."""
        from labseq_spcm.certificate import permitted

        mode = permitted(self)[0].mode
        return {"replay": 20e-3, "sequence": 6e-3, "fifo": 17e-3, "stream": 3e-3}[mode]

    @property
    def fill_s(self) -> float:
        """Playing time that is rendered ahead, of the modes that render while they play."""
        return self.fill or {"fifo": 8e-3, "stream": 20e-3}[self.mode]

    def look_ahead_s(self, sample_rate_hz: float) -> float:
        """The look-ahead at the rate that the card's clock really makes."""
        return self.look_ahead or max(250e-6, self._buffered_s(sample_rate_hz))


def _hz(value: float) -> str:
    return format_quantity(value, "frequency")
