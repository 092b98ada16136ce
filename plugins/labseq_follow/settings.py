"""Settings of the devices that connect an external control system."""

from __future__ import annotations

from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from labseq.plugin import PositiveDuration, setting_error, wire
from labseq.plugin.leader import LeaderSettings
from labseq.plugin.messages import clean
from labseq.plugin.serial import port_identities

SIMULATED: Final = "simulated"


class LinkSettings(LeaderSettings):
    """Settings for any connection."""

    leader: Literal["real", "simulated"] = Field(
        default="real", description="with `simulated` a simulated control system sends `go`, as in a dry run"
    )
    loads: bool = Field(
        default=False,
        description="load atoms at `go`, unless there are some, with a real control system and a simulated "
        "lab",
    )
    light: Literal["own", "asked"] = Field(
        default="own",
        description="with `asked` labseq asks the control system for the imaging light at each image, with "
        "`own` it does not ask",
    )
    light_timeout: PositiveDuration = Field(
        default=1.0, description="longest time for the control system to turn the imaging light on or off"
    )


class TcpLeaderSettings(LinkSettings):
    """An external control system that connects over TCP."""

    host: Annotated[str, Field(min_length=1)] = Field(
        default="127.0.0.1", description="address of this computer on which labseq listens"
    )
    port: int = Field(
        default=5750, ge=0, le=65535, description="port on which labseq listens, or 0 for any free port"
    )
    allow_remote: bool = Field(
        default=False,
        description="whether other computers may connect, with the token that labseq keeps in "
        "`leader.token` of its state folder",
    )

    def identities(self) -> tuple[str, ...]:
        """Identifiers that only one process can use at a time."""
        return (f"TCP port {self.port}",) if self.port else ()

    @model_validator(mode="after")
    def _check_host(self) -> Self:
        if not self.allow_remote and not wire.is_loopback(self.host):
            what = f"host is '{clean(self.host)}', which other computers can reach"
            hint = "or set 'allow_remote: true' if nobody else can listen on the network"
            raise setting_error(
                what, "an address that only this computer can reach, such as 127.0.0.1", hint, at=("host",)
            )
        return self


class SerialLeaderSettings(LinkSettings):
    """An external control system on a serial line with 8 data bits, no parity and 1 stop bit."""

    port: Annotated[str, Field(min_length=1)] = Field(
        description="the port, such as `/dev/ttyUSB0`, `COM3` or a URL of pyserial"
    )
    baud_rate: int = Field(default=115200, ge=1, description="bits per second")

    def identities(self) -> tuple[str, ...]:
        """Identifiers that only one process can use at a time."""
        return port_identities(self.port)
