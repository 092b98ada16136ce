"""Address and name of a remote device, and the key of its server."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import AfterValidator, Field

from labseq.plugin import Settings, Text, setting_error, wire


def _address(value: str) -> str:
    try:
        wire.parse_address(value)
    except ValueError as error:
        raise setting_error(
            f"'{value[:60]}' is not an address", "tcp://HOST:PORT, such as tcp://camera-pc:5760"
        ) from error
    return value


class RemoteSettings(Settings):
    """The server of a device, its name there, and its key."""

    address: Annotated[str, AfterValidator(_address)] = Field(
        description="address of the server, as `labseq serve-devices` prints it (tcp://HOST:PORT)"
    )
    device: Text = Field(description="role or name of the device in the profile of its computer")
    server_key: Text | None = Field(
        default=None, description="name of the server's public key in the folder `known` (default: the host)"
    )

    @property
    def host(self) -> str:
        """Host of the server."""
        return wire.parse_address(self.address)[0]

    @property
    def port(self) -> int:
        """Port of the server."""
        return wire.parse_address(self.address)[1]

    @property
    def plain(self) -> bool:
        """Whether the server is on this computer and needs no keys."""
        return wire.is_loopback(self.host) and not self.server_key

    def identities(self) -> Sequence[str]:
        """The device at its address."""
        return (f"{self.device} at {self.address}",)
