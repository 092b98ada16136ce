"""A virtual instrument, and the stand-in for any whose driver is missing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from labseq.plugin import Context, DeviceError, one_of
from labseq_virtual.settings import DeviceSettings


class VirtualDevice:
    """Remembers what it was told.

    The value ``state`` is the last command ("closed" before ``open``, "ready"
    after it, "safe" in the safe state). Arguments of a command are kept as values
    of the same name: after ``command("set", power=0.5)``, ``read("power")`` is 0.5.

    Args:
        settings: Its commands and values.
        context: Its name.
    """

    def __init__(self, settings: DeviceSettings, context: Context) -> None:
        self._name = context.name or "device"
        self._commands = settings.commands
        self._values: dict[str, Any] = {**settings.values, "state": "closed"}
        self._is_open = False

    def open(self) -> None:
        """Get ready."""
        self._is_open = True
        self._values["state"] = "ready"

    def close(self) -> None:
        """Disconnect; legal in any state."""
        self._is_open = False
        self._values["state"] = "closed"

    def safe_state(self) -> None:
        """Make the output harmless; legal in any state."""
        if self._is_open:
            self._values["state"] = "safe"

    def command(self, name: str, **arguments: Any) -> None:
        """Carry out a command.

        Raises:
            DeviceError: Not open, or a command that it does not know.
        """
        self._check_open()
        if self._commands and name not in self._commands:
            raise DeviceError(self._name, f"unknown command '{name}'; expected {one_of(self._commands)}")
        self._values.update(arguments)
        self._values["state"] = name

    def read(self, name: str) -> Any:
        """Read a value.

        Raises:
            DeviceError: Not open, or a value that it does not know.
        """
        self._check_open()
        if name not in self._values:
            raise DeviceError(self._name, f"unknown value '{name}'; expected {one_of(sorted(self._values))}")
        return self._values[name]

    def describe(self) -> Mapping[str, Any]:
        """Model, commands and values."""
        return {"model": "virtual device", "commands": list(self._commands), "values": dict(self._values)}

    def _check_open(self) -> None:
        if not self._is_open:
            raise DeviceError(self._name, "not open; call open() first")
