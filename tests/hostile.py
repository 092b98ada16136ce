"""Exceptions that are hard to print, catch or log, as a driver could raise them."""

from __future__ import annotations

from typing import Any

from labseq.errors import DeviceError, TransientError


class BrokenStrError(RuntimeError):
    def __str__(self) -> str:
        raise RuntimeError("no text")

    __repr__ = __str__


class LeavingStrError(Exception):
    def __str__(self) -> str:
        raise SystemExit(0)


class RecursiveStrError(Exception):
    def __str__(self) -> str:
        return f"{self}"


class WrongStrError(Exception):
    def __str__(self) -> Any:
        return 5  # noqa: PLE0307 - the point


class TrickyClass(Exception):  # noqa: N818
    """``isinstance`` asks the object for its class."""

    @property
    def __class__(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        raise OSError("no class")

    @property
    def __cause__(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        raise OSError("no cause")

    def __eq__(self, other: object) -> bool:
        raise OSError("no comparison")

    __hash__ = None  # type: ignore[assignment]


class OwnBase(BaseException):
    pass


class BrokenDeviceError(DeviceError):
    def __init__(self) -> None:  # which leaves its attributes out
        pass

    def __str__(self) -> str:
        raise ValueError("no text")


N_HUGE = 5_000_000
HOSTILE: dict[str, BaseException] = {
    "broken text": BrokenStrError(),
    "text that exits": LeavingStrError(),
    "recursive text": RecursiveStrError(),
    "text that is none": WrongStrError(),
    "tricky class": TrickyClass("stuck"),
    "base exception": OwnBase("stuck"),
    "interrupt": KeyboardInterrupt(),
    "exit": SystemExit(0),
    "generator exit": GeneratorExit(),
    "no memory": MemoryError(),
    "huge": RuntimeError("x" * N_HUGE),
    "escapes": RuntimeError("stuck\n\x1b[2J\x07\r\udc80"),
    "group": ExceptionGroup("two", [BrokenStrError(), ValueError("1")]),
    "broken error of labseq": BrokenDeviceError(),
    "huge error of labseq": DeviceError("camera", "x" * N_HUGE),
    "escapes in an error of labseq": DeviceError("camera", "stuck\x1b[2J"),
}
"""What it is -> the exception."""
LOST = TransientError("\x1b[2J" + "x" * N_HUGE, "camera")
