"""Settings of the driver."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from labseq.plugin import Frequency, Settings
from labseq_pulseblaster.models import MODELS, Model


class FaultSettings(Settings):
    """Failures of the simulated board."""

    missing: bool = Field(default=False, description="no board is connected")
    in_use: bool = Field(default=False, description="another program holds the board")
    clock: Annotated[Frequency, Field(gt=0)] | None = Field(
        default=None, description="clock of the board, if it differs from the clock of its `model`"
    )
    unplugged: bool = Field(default=False, description="the board does not answer once a program was fired")
    no_edge: bool = Field(default=False, description="the edge at the trigger input never comes")


class PulseBlasterSettings(Settings):
    """Lines on a PulseBlaster of SpinCore."""

    driver: Literal["installed", "simulated"] = Field(
        default="installed", description="with `simulated`, a library with a simulated board replaces SpinAPI"
    )
    model: Literal[
        "PB24-100-4k", "PB24-100-32k", "PBESR-PRO-250", "PBESR-PRO-300", "PBESR-PRO-400", "PBESR-PRO-500"
    ] = Field(description="the board, since its library does not know its clock and memory")
    board_number: Annotated[int, Field(ge=0)] = Field(
        default=0, description="which of several boards, as SpinAPI counts them from 0"
    )
    external_trigger: bool = Field(
        default=False, description="an edge at the board's trigger input starts a program that was fired"
    )
    faults: FaultSettings = Field(default=FaultSettings(), description="failures of the simulated board")

    @property
    def is_simulated(self) -> bool:
        """Whether there is no board."""
        return self.driver == "simulated"

    @property
    def facts(self) -> Model:
        """Limits of the board."""
        return MODELS[self.model]

    def identities(self) -> tuple[str, ...]:
        """Names of the board, which only one process can use."""
        return () if self.is_simulated else (f"SpinCore board {self.board_number}",)
