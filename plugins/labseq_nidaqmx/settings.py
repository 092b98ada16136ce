"""Settings of the driver."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from labseq.plugin import Duration, Frequency, Settings, Voltage, setting_error


class LevelSettings(Settings):
    """The levels of a line on an analogue output."""

    on: Voltage = Field(description="level while the line is on")
    off: Voltage = Field(default=0.0, description="level while the line is off, and in the safe state")

    @model_validator(mode="after")
    def _check_levels(self) -> Self:
        if self.on == self.off:
            raise setting_error("the levels for on and off are the same", "two levels", at=("on",))
        return self


class FaultSettings(Settings):
    """Cards to simulate, and what goes wrong with them."""

    card: Literal["PCIe-6363", "PCI-6259", "USB-6008"] = Field(
        default="PCIe-6363", description="product that every card of the profile is"
    )
    missing: bool = Field(default=False, description="no card is connected")
    in_use: bool = Field(default=False, description="another program holds the lines")
    underflow: Duration | None = Field(
        default=None, description="time after its first edge at which a card runs out of samples"
    )
    unplugged: bool = Field(default=False, description="the cards do not answer once a program was fired")
    no_edge: bool = Field(default=False, description="the edge at `trigger` never comes")


class NidaqmxSettings(Settings):
    """Lines on cards of National Instruments."""

    driver: Literal["installed", "simulated"] = Field(
        default="installed",
        description="with `simulated`, simulated cards in place of NI-DAQmx",
    )
    rate: Annotated[Frequency, Field(gt=0)] = Field(
        default=1e6,
        description="samples per second of all outputs. Edges fall on multiples of its inverse. NI-DAQmx "
        "keeps every sample of a step in memory",
    )
    trigger: str = Field(
        default="",
        description="terminal whose rising edge starts a program that was fired, such as `/Dev1/PFI0`. "
        "If empty, the computer starts it",
    )
    levels: dict[str, LevelSettings] = Field(
        default={}, description="name of each line on an analogue output -> its levels"
    )
    faults: FaultSettings = Field(
        default=FaultSettings(), description="the simulated cards and their failures"
    )

    @property
    def is_simulated(self) -> bool:
        """Whether there is no card."""
        return self.driver == "simulated"

    def identities(self) -> tuple[str, ...] | None:
        """None, since NI-DAQmx itself keeps other processes from cards in use."""
        return () if self.is_simulated else None
