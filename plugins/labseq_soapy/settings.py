"""Settings of the driver."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Final, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from labseq.plugin import Duration, Frequency, FrequencyComb, Settings, clean, closest, one_of, setting_error

SIMULATED = "simulated"
"""The device that needs no radio."""
LEAST: Final[Mapping[str, float]] = {
    "speed": 1e-4,
    "buffer": 1e-4,
    "patience": 0.0,
    "record": 0.0,
    "channels": 1.0,
    "coerce_rate": 0.0,
}
"""Arguments of the simulated radio that are numbers, and the least that they may be."""
WORDS: Final[Mapping[str, tuple[str, ...]]] = {"fault": ("absent",), "folder": ()}
"""Those that are not, and what they may be; none: anything."""

Channel: TypeAlias = Annotated[int, Field(ge=0, le=15)]
Rate: TypeAlias = Annotated[Frequency, Field(gt=0)]


class SoapySettings(Settings):
    """Static tweezers on a software-defined radio."""

    device: str = Field(
        default="driver=uhd",
        min_length=1,
        description="what opens the radio, as in `SoapySDRUtil --find`; `simulated` for one that exists only "
        "in software",
    )
    stream: str = Field(
        default="",
        description="arguments of its stream, for example the size of its buffers: `SoapySDRUtil --probe`",
    )
    row_channel: Channel = Field(default=0, description="output that drives the row axis")
    column_channel: Channel = Field(default=1, description="output that drives the column axis")
    sample_rate: Rate = Field(
        default=40e6,
        description="samples per second; the tones may span 80 % of it around the local oscillator",
    )
    bandwidth: Rate | None = Field(
        default=None, description="of the radio's analog filters; none: as the radio chooses"
    )
    local_oscillator: Rate | None = Field(
        default=None,
        description="centre of the radio's band, for both outputs; none: a third of a site beside the tone "
        "in the middle, so that its leakage and the tones' images fall between the tweezers",
    )
    row_frequency: FrequencyComb = Field(default=FrequencyComb(), description="tones of the rows")
    column_frequency: FrequencyComb = Field(default=FrequencyComb(), description="tones of the columns")
    tone_tolerance: Annotated[Frequency, Field(gt=0, le=1e3)] = Field(
        default=1.0, description="how far a tone may be from the one that was asked for"
    )
    row_gain: float | None = Field(
        default=None, description="gain of the row output in dB; none: the lowest that it has"
    )
    column_gain: float | None = Field(default=None, description="the same of the column output")
    antenna: str = Field(default="", description="name of the connectors, if there are several")
    clock_source: str = Field(
        default="", description="reference of the radio's clocks, for example `external`; none: its own"
    )
    max_depth: Annotated[float, Field(ge=1, allow_inf_nan=False)] = Field(
        default=1.0, description="greatest depth, as a fraction of the nominal depth"
    )
    fade: Annotated[Duration, Field(le=1.0)] = Field(
        default=1e-3,
        description="time in which new amplitudes take the place of the old while the array is on",
    )
    switch: Annotated[Duration, Field(le=1.0)] = Field(
        default=10e-3,
        description="time of the ramps by which the array is turned on, and off when all is made safe",
    )
    on_exit: Literal["ramp_down", "hold"] = Field(
        default="ramp_down",
        description="what becomes of the light when labseq is killed or hangs: ramped down, or held until "
        "labseq opens the radio anew",
    )
    patience: Annotated[Duration, Field(ge=0.2, le=3600)] = Field(
        default=5.0, description="with `ramp_down`: how long labseq may be silent before it counts as hung"
    )

    @property
    def is_simulated(self) -> bool:
        """Whether there is no radio; arguments of the simulated one may follow the name, after a comma."""
        return self.device.partition(",")[0] == SIMULATED

    @property
    def simulated_arguments(self) -> dict[str, str]:
        """What stands behind the name of a simulated radio."""
        pairs = (pair.partition("=") for pair in self.device.split(",")[1:])
        return {key.strip(): value.strip() for key, _, value in pairs}

    @model_validator(mode="after")
    def _simulated_radio_knows_its_arguments(self) -> Self:
        if self.is_simulated:
            for key, value in self.simulated_arguments.items():
                self._check_argument(key, value)
        return self

    def _check_argument(self, key: str, value: str) -> None:
        known = (*LEAST, *WORDS)
        if key not in known:
            meant = closest(key, known)
            hint = f"did you mean '{meant}'?" if meant else ""
            raise setting_error(
                f"the simulated radio has no argument '{clean(key)}'", one_of(known), hint, at=("device",)
            )
        came = f"{key} of the simulated radio is '{clean(value)}'"
        if (words := WORDS.get(key)) is not None:
            if not value or (words and value not in words):
                raise setting_error(came, one_of(words) if words else "a folder", at=("device",))
            return
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not LEAST[key] <= number < math.inf:
            raise setting_error(came, f"a number, at least {LEAST[key]:g}", at=("device",))

    @model_validator(mode="after")
    def _two_outputs(self) -> Self:
        if self.row_channel == self.column_channel:
            both = f"row_channel and column_channel are both {self.row_channel}"
            raise ValueError(f"{both}; expected one output for each axis")
        return self
