"""Settings of the driver."""

from __future__ import annotations

from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from labseq import Duration, Settings
from labseq.config.fields import misfit

SIMULATED: Final = "simulated"
"""The port that needs no box."""

MAX_LIGHTS_OUT_S: Final = 65.0


class TtlSettings(Settings):
    """A timing box with labseq's firmware."""

    port: str = Field(
        default=SIMULATED,
        min_length=1,
        description='serial port of the box, "/dev/ttyACM0"; `simulated`: a box that is simulated',
    )
    serial_number: Annotated[int, Field(ge=0, le=0xFFFF)] | None = Field(
        default=None, description="serial number that the box must have; none: any"
    )
    start: Literal["serial", "external"] = Field(
        default="serial",
        description="what starts a program that was fired: the serial line, or the next rising edge at the "
        "box's start input",
    )
    lights_out: Annotated[Duration, Field(le=MAX_LIGHTS_OUT_S)] = Field(
        default=0.0,
        description="how long the box waits for a word of labseq before it turns all lines off, while no "
        "program runs; 0: for ever",
    )
    simulated_by: Literal["python", "simavr"] = Field(
        default="python",
        description="what a simulated box is: `python`, a model of it, or `simavr`, the firmware itself on a "
        "simulated processor",
    )

    @property
    def is_simulated(self) -> bool:
        """Whether there is no box."""
        return self.port == SIMULATED

    @model_validator(mode="after")
    def _somebody_starts_it(self) -> Self:
        if self.is_simulated and self.start == "external":
            raise misfit("nobody gives a simulated box its external start", "`start: serial`", at=("start",))
        return self
