"""Exceptions that a driver may raise although no error of labseq is among them."""

from __future__ import annotations


class OwnBase(BaseException):
    pass


N_HUGE = 5_000_000
HOSTILE: dict[str, BaseException] = {
    "base exception": OwnBase("stuck"),
    "interrupt": KeyboardInterrupt(),
    "exit": SystemExit(0),
    "generator exit": GeneratorExit(),
    "no memory": MemoryError(),
    "huge": RuntimeError("x" * N_HUGE),
    "escapes": RuntimeError("stuck\n\x1b[2J\x07\r\udc80"),
    "group": ExceptionGroup("two", [OSError("stuck"), ValueError("1")]),
}
"""What it is -> the exception."""
