"""What any other instrument promises."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from labseq.errors import DeviceError
from labseq.roles import Device
from labseq.testing.contracts.hardware import Action, Factory, HardwareContract
from labseq.testing.contracts.promises import doing, promise, refusal


class DeviceContract(HardwareContract[Device]):
    """Promises of an instrument with commands and values.

    Attributes:
        commands: Every command of the device, with arguments that it accepts.
        excessive_commands: Commands with arguments beyond a limit of the device:
            description -> (command, arguments).
        values: Every value that it can be asked for.
    """

    role: ClassVar[str] = "instrument_7"
    commands: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    excessive_commands: ClassVar[Mapping[str, tuple[str, Mapping[str, Any]]]] = {}
    values: ClassVar[Sequence[str]] = ()

    def work(self, device: Device) -> None:
        """Every command."""
        for name, arguments in self.commands.items():
            device.command(name, **arguments)

    def uses(self) -> Mapping[str, Action[Device]]:
        """Every command and every value."""
        commands = {f"command('{name}')": self._command(name, given) for name, given in self.commands.items()}
        return {**commands, **{f"read('{name}')": _read(name) for name in self.values}}

    def states(self) -> Mapping[str, Action[Device]]:
        """After each command."""
        return {f"after '{name}'": self._command(name, given) for name, given in self.commands.items()}

    def excesses(self) -> Mapping[str, Action[Device]]:
        """What ``excessive_commands`` lists."""
        return {what: self._command(*command) for what, command in self.excessive_commands.items()}

    @promise("every command and value that the device declares works")
    def test_does_what_it_declares(self, factory: Factory[Device]) -> None:
        """In the order in which the test lists them."""
        with self.opened(factory) as (device, _):
            for name, arguments in self.commands.items():
                with doing(f"command('{name}')"):
                    device.command(name, **arguments)
            for name in self.values:
                with doing(f"read('{name}')"):
                    device.read(name)

    @promise("an unknown command raises a DeviceError that names the known ones")
    def test_refuses_unknown_commands(self, factory: Factory[Device]) -> None:
        """Who mistypes a command wants to see which there are."""
        with self.opened(factory) as (device, _):
            error = refusal(DeviceError, "an unknown command", device.command, "no_such_command")
            missing = [name for name in self.commands if name not in str(error)]
            assert not missing, f"'{error}' does not name {', '.join(missing)}"

    @promise("an unknown value raises a DeviceError that names the known ones")
    def test_refuses_unknown_values(self, factory: Factory[Device]) -> None:
        """Likewise."""
        with self.opened(factory) as (device, _):
            error = refusal(DeviceError, "an unknown value", device.read, "no_such_value")
            missing = [name for name in self.values if name not in str(error)]
            assert not missing, f"'{error}' does not name {', '.join(missing)}"

    def _command(self, name: str, arguments: Mapping[str, Any]) -> Action[Device]:
        return lambda device: device.command(name, **arguments)


def _read(name: str) -> Action[Device]:
    return lambda device: device.read(name)
