"""Instruments that break one promise each."""

from typing import Any, ClassVar

from labseq.errors import LimitError
from labseq.testing import DeviceContract
from labseq.testing.fakes import RecordingDevice

from .planted import Planted


class Suite(DeviceContract):
    commands: ClassVar = {"on": {}, "off": {}}
    values: ClassVar = ("state",)
    excessive_commands: ClassVar = {"too bright": ("on", {"power": 100.0})}


class Right(RecordingDevice):
    def command(self, name: str, **arguments: Any) -> None:
        if arguments.get("power", 0.0) > 1.0:
            raise LimitError("the power", arguments["power"], 1.0)
        super().command(name, **arguments)


class CannotTellItsState(Right):
    def read(self, name: str) -> Any:
        super().read(name)
        raise NotImplementedError


class RaisesKeyError(Right):
    def command(self, name: str, **arguments: Any) -> None:
        if name not in self.commands:
            raise KeyError(name)
        super().command(name, **arguments)


class IgnoresUnknownCommands(Right):
    def command(self, name: str, **arguments: Any) -> None:
        if name in self.commands:
            super().command(name, **arguments)


class AnswersNone(Right):
    def read(self, name: str) -> Any:
        return super().read(name) if name in self.values else None


class ObeysAnyPower(RecordingDevice):
    pass


PLANTED = Planted(
    Suite(),
    Right,
    (
        (CannotTellItsState, "test_does_what_it_declares"),
        (RaisesKeyError, "test_refuses_unknown_commands"),
        (IgnoresUnknownCommands, "test_refuses_unknown_commands"),
        (AnswersNone, "test_refuses_unknown_values"),
        (ObeysAnyPower, "test_refuses_what_exceeds_limits"),
    ),
)
