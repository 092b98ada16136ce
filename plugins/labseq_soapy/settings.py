"""Settings of the driver."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from labseq.plugin import Duration, Frequency, FrequencyComb, Settings
from labseq_soapy.radios import Bus, too_fast

Channel: TypeAlias = Annotated[int, Field(ge=0, le=15)]
Rate: TypeAlias = Annotated[Frequency, Field(gt=0)]


class SoapySettings(Settings):
    """Static tweezers on a software-defined radio."""

    device: str = Field(
        default="driver=uhd",
        min_length=1,
        description="arguments that open it, as in `SoapySDRUtil --find`, or `simulated` for a radio "
        "that exists only in software",
    )
    stream: str = Field(
        default="",
        description="arguments of its stream, such as the size of its buffers (see `SoapySDRUtil --probe`)",
    )
    bus: Bus | None = Field(
        default=None, description="its connection, for `labseq check`, or none for its fastest"
    )
    row_channel: Channel = Field(default=0, description="output that drives the row axis")
    column_channel: Channel = Field(default=1, description="output that drives the column axis")
    sample_rate: Rate = Field(
        default=40e6,
        description="samples per second. The tones may span 80 % of it around the local oscillator",
    )
    bandwidth: Rate | None = Field(
        default=None, description="bandwidth of the analog filters, or none to let the radio choose"
    )
    local_oscillator: Rate | None = Field(
        default=None,
        description="centre of the band of both outputs. With none, a third of a site from the tone "
        "in the middle, so that its leakage and the tones' images fall between the tweezers",
    )
    lo_offset: Frequency = Field(
        default=0.0,
        description="moves the local oscillator away from there, to outside the tones. Some radios "
        "shift the samples back. With others the sample rate must cover the tones and this offset",
    )
    row_frequency: FrequencyComb = Field(default=FrequencyComb(), description="tones of the rows")
    column_frequency: FrequencyComb = Field(default=FrequencyComb(), description="tones of the columns")
    tone_tolerance: Annotated[Frequency, Field(gt=0, le=1e3)] = Field(
        default=1.0, description="how far a tone may be from its exact frequency"
    )
    row_gain: float | None = Field(
        default=None, description="gain of the row output in dB, or none for its lowest"
    )
    column_gain: float | None = Field(default=None, description="the same for the column output")
    antenna: str = Field(default="", description="name of the connectors, if there are several")
    clock_source: str = Field(
        default="", description="reference of the radio's clocks, such as `external`, or empty for its own"
    )
    max_depth: Annotated[float, Field(ge=1, allow_inf_nan=False)] = Field(
        default=1.0, description="greatest depth, as a fraction of the nominal depth"
    )
    fade: Annotated[Duration, Field(le=1.0)] = Field(
        default=1e-3,
        description="time in which new amplitudes replace the old ones while the array is on",
    )
    switch: Annotated[Duration, Field(le=1.0)] = Field(
        default=10e-3,
        description="duration of the ramps that turn the array on, and off in the safe state",
    )
    max_disturbances: Annotated[int, Field(ge=0)] = Field(
        default=10,
        description="how often the radio may run out of samples, or miss a packet of them, in a minute while "
        "the array is on. The shot is repeated each time. Above this number the run ends",
    )
    after_run: Literal["off", "on"] = Field(
        default="off",
        description="the light after a run that took all its shots, ramped down or left on until the next "
        "labseq opens the radio (a run, `labseq devices`, `labseq safe`)",
    )
    patience: Annotated[Duration, Field(ge=0.2, le=3600)] = Field(
        default=5.0, description="with `ramp_down`, how long labseq may be silent before it counts as hung"
    )

    @property
    def is_simulated(self) -> bool:
        """Whether the radio is simulated. Its arguments may follow after a comma."""
        return self.device.partition(",")[0] == "simulated"

    def identities(self) -> tuple[str, ...]:
        """Names of the radio, which only one process can use."""
        arguments = sorted(part.strip() for part in self.device.split(","))
        return () if self.is_simulated else (f"radio {','.join(arguments)}",)

    def warnings(self) -> Iterator[tuple[tuple[str, ...], str, str]]:
        """Warn of a sample rate that the radio or its connection cannot keep up with."""
        found = too_fast(self.device, self.bus, self.stream, self.sample_rate)
        if found is not None:
            why, most_hz = found
            yield ("sample_rate",), why, f"a sample_rate up to {most_hz / 1e6:g} MHz"

    @model_validator(mode="after")
    def _check_simulated_radio(self) -> Self:
        if self.is_simulated:
            from labseq_soapy_sim.radio import read_arguments

            read_arguments(self.device)
        return self

    @model_validator(mode="after")
    def _two_outputs(self) -> Self:
        if self.row_channel == self.column_channel:
            both = f"row_channel and column_channel are both {self.row_channel}"
            raise ValueError(f"{both}; expected one output for each axis")
        return self
