"""Settings of the driver."""

from __future__ import annotations

from itertools import combinations
from typing import Annotated, Final, Literal, Self, TypeAlias

from pydantic import AfterValidator, Field, model_validator

from labseq.plugin import Duration, Settings, setting_error
from labseq.plugin.leader import LeaderSettings
from labseq.plugin.serial import port_identities
from labseq_ttl.protocol import CHANNELS

SIMULATED: Final = "simulated"
"""The port that needs no box."""

MAX_WATCHDOG_S: Final = 65.0
MAX_DEADLINE_S: Final = 1000.0


def _is_output(channel: int) -> int:
    if channel not in CHANNELS:
        raise ValueError(f"expected an output of the box: {', '.join(map(str, CHANNELS))}")
    return channel


Channel: TypeAlias = Annotated[int, AfterValidator(_is_output)]
"""Number of an output of the box."""


class GoSettings(LeaderSettings):
    """An external control system, whose `go` is a rising edge at the start input (D8). Outputs answer."""

    deadline: Annotated[Duration, Field(ge=0.1, le=MAX_DEADLINE_S)] = Field(
        default=10.0,
        description="longest time from `go` to `ready` or `failed`, which the box keeps even without labseq",
    )
    busy: Channel | None = Field(
        default=None, description="output that is high from `go` to the end of the shot"
    )
    ready: Channel | None = Field(
        default=None, description="output that goes high when the shot is over, until the next `go`"
    )
    failed: Channel | None = Field(
        default=None, description="output that goes high when it failed or was late, until the next `go`"
    )
    active_low: bool = Field(default=False, description="these outputs are low when they are active")

    @property
    def outputs(self) -> dict[str, int]:
        """Name -> channel of each output that is wired."""
        pins = {"busy": self.busy, "ready": self.ready, "failed": self.failed}
        return {name: pin for name, pin in pins.items() if pin is not None}

    @property
    def polarity(self) -> int:
        """Outputs that are low when they are on, bit n for channel n."""
        return sum(1 << pin for pin in self.outputs.values()) if self.active_low else 0

    @model_validator(mode="after")
    def _check_outputs(self) -> Self:
        pins = self.outputs
        if not {"ready", "failed"} <= set(pins):
            missing = "ready" if "ready" not in pins else "failed"
            raise setting_error(f"'{missing}' has no output", "outputs for 'ready' and 'failed'")
        for (first, a), (second, b) in combinations(pins.items(), 2):
            if a == b:
                raise setting_error(
                    f"'{first}' and '{second}' are both on output {a}", "one each", at=(second,)
                )
        return self


class TtlSettings(Settings):
    """A timing box with labseq's firmware."""

    port: str = Field(
        default=SIMULATED,
        min_length=1,
        description='serial port of the box, "/dev/ttyACM0", or `simulated` for a simulated box',
    )
    serial_number: Annotated[int, Field(ge=0, le=0xFFFF)] | None = Field(
        default=None, description="serial number that the box must have, or none for any"
    )
    start: Literal["serial", "external"] = Field(
        default="serial",
        description="what starts a program that was fired, the serial line or the next rising edge at the "
        "box's start input",
    )
    watchdog_timeout: Annotated[Duration, Field(le=MAX_WATCHDOG_S)] = Field(
        default=2.0,
        description="how long the box waits for a sign of life from labseq before it turns all lines off, "
        "while no program runs, or 0 for ever",
    )
    go: GoSettings | None = Field(
        default=None,
        description="lets an external control system start the shots through the box, see "
        "[the guide](../how-to/follow.md)",
    )

    @property
    def is_simulated(self) -> bool:
        """Whether there is no box."""
        return self.port == SIMULATED

    def identities(self) -> tuple[str, ...]:
        """Names of the box, which only one process can use."""
        number = () if self.serial_number is None else (f"timing box {self.serial_number}",)
        return () if self.is_simulated else (*port_identities(self.port), *number)

    @model_validator(mode="after")
    def _check_start(self) -> Self:
        if self.is_simulated and self.start == "external":
            raise setting_error("a simulated box has no external start", "`start: serial`", at=("start",))
        if self.go is not None and self.start == "external":
            what = "the start input cannot take `go` and start programs too"
            raise setting_error(what, "`start: serial` with 'go'", at=("start",))
        return self
