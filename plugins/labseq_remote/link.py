"""The connection of a driver, made when it is first needed, and the calls over it."""

from __future__ import annotations

import weakref
from typing import Any, Protocol

from labseq.plugin import Context, DeviceError
from labseq_remote.connection import Connection
from labseq_remote.settings import RemoteSettings


class Link:
    """The connection of a driver, made when it is first needed, and again after it was closed.

    Args:
        settings: Address and name of the device, and key of its server.
        context: The driver's context.
        kind: Kind of the device.
    """

    def __init__(self, settings: RemoteSettings, context: Context, kind: str) -> None:
        self.settings = settings
        self.name = context.name or kind
        self.is_open = False
        self._context = context
        self._kind = kind
        self._connection: Connection | None = None
        self._state: dict[str, Any] = {}
        self._about: dict[str, Any] = {}

    def connect(self) -> Connection:
        """The connection.

        Raises:
            DeviceError: The server does not answer, or refuses.
        """
        if self._connection is None:
            connection = Connection(self.settings, self._context, self._kind, self._state)
            self._connection = connection
            weakref.finalize(self, connection.abandon)
            self._about = connection.about
        return self._connection

    def call(self, name: str, *args: Any, **named: Any) -> Any:
        """Call a method of the open device.

        Raises:
            DeviceError: The device is not open, or the connection is lost.
        """
        if not self.is_open:
            raise DeviceError(self.name, f"it is not open (at {self.settings.address})")
        return self.connect().call(name, *args, **named)

    def call_if_able(self, name: str, default: Any = None) -> Any:
        """Call an optional method if the served driver has it."""
        return self.call(name) if name in self.about["abilities"] else default

    @property
    def about(self) -> dict[str, Any]:
        """Facts about the server and its driver."""
        if not self._about:
            self.connect()
        return self._about

    def known(self, name: str, default: Any) -> Any:
        """The value of a property after the last call."""
        if not self._about:
            self.connect()
        return self._state.get(name, default)

    def open(self) -> None:
        """Connect, and open the device for this client alone."""
        if self._connection is not None and self._connection.life.lost:
            self.end()
        try:
            self.connect().call("open", stoppable=False)
        except BaseException:
            self.end()
            raise
        self.is_open = True

    def make_safe(self) -> None:
        """Make the device safe if it was opened."""
        if self.is_open:
            self.connect().make_safe()

    def close(self) -> None:
        """Close the device, and end the connection."""
        if not self.is_open:
            return self.end()
        self.is_open = False
        connection = self.connect()
        try:
            if not connection.is_hanging:  # otherwise the server closes the device
                connection.call("close", stoppable=False)
        finally:
            self.end()

    def end(self) -> None:
        """End the connection."""
        connection, self._connection, self.is_open = self._connection, None, False
        if connection is not None:
            connection.close()

    def describe(self) -> dict[str, Any]:
        """The device's description, with its address."""
        about = self.about
        remote = {
            "address": self.settings.address,
            "device": self.settings.device,
            "host": about["host"],
            "labseq": about["labseq"],
            "settings": about["settings"],
        }
        return {**self.connect().call("describe"), "remote": remote}


class Linked(Protocol):
    """A driver whose methods are carried out on another computer."""

    link: Link


def called(name: str) -> Any:
    """A method that is carried out at the server, with the role's meaning."""

    def method(driver: Linked, /, *args: Any, **named: Any) -> Any:
        return driver.link.call(name, *args, **named)

    method.__name__ = name
    return method


def called_if_able(name: str, default: Any = None) -> Any:
    """An optional method that is carried out at the server. Without it the default is returned."""

    def method(driver: Linked) -> Any:
        return driver.link.call_if_able(name, default)

    method.__name__ = name
    return method


def known(name: str, default: Any) -> Any:
    """A property with its value at the server after the last call."""
    return property(lambda driver: driver.link.known(name, default))
