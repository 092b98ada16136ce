"""How the parts of the simulator declare which SDK functions they implement.

A method marked with :func:`implements` takes the inputs of the C function. It returns a return code, or the
outputs: these are then written through the pointers at the end of the C function's arguments.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from labseq_andor.codes import Code

F = TypeVar("F", bound=Callable[..., "Code | tuple[Any, ...]"])

TEXT_BYTES: Final = 256
"""Size of the buffers for texts whose length the SDK does not pass."""

_MARK: Final = "_labseq_andor_sim"


@dataclass(frozen=True, slots=True)
class Function:
    """An SDK function.

    Attributes:
        method: Its implementation.
        n_outputs: Number of pointers at its end that outputs are written to.
        only_idle: It is refused with DRV_ACQUIRING while the camera acquires.
        waits: It waits, so other calls must be possible meanwhile.
    """

    method: Callable[..., Code | tuple[Any, ...]]
    n_outputs: int
    only_idle: bool
    waits: bool

    def call(self, arguments: Sequence[Any]) -> int:
        """Call it with the arguments of the C function; returns its return code."""
        n_inputs = len(arguments) - self.n_outputs
        result = self.method(*arguments[:n_inputs])
        if isinstance(result, Code):
            return result
        for pointer, value in zip(arguments[n_inputs:], result, strict=True):
            if isinstance(value, str):
                write_text(pointer, value)
            else:
                pointer[0] = value
        return Code.SUCCESS


def implements(
    *names: str, outputs: int = 0, only_idle: bool = False, waits: bool = False
) -> Callable[[F], F]:
    """Mark a method as the implementation of SDK functions; see :class:`Function`."""

    def mark(method: F) -> F:
        setattr(method, _MARK, (names, outputs, only_idle, waits))
        return method

    return mark


def functions_of(part: object) -> Mapping[str, Function]:
    """SDK functions that an object implements, by name."""
    found: dict[str, Function] = {}
    for attribute in vars(type(part)).values():
        if (mark := getattr(attribute, _MARK, None)) is not None:
            names, *rules = mark
            found |= dict.fromkeys(names, Function(attribute.__get__(part), *rules))
    return found


def names_in(*classes: type) -> frozenset[str]:
    """Names of the SDK functions that objects of some classes implement."""
    marks = [getattr(attribute, _MARK, None) for kind in classes for attribute in vars(kind).values()]
    return frozenset(name for mark in marks if mark is not None for name in mark[0])


def write_text(address: int, text: str, length: int = TEXT_BYTES) -> Code:
    """Write text with its closing zero to an address, at most ``length`` bytes."""
    encoded = text.encode()[: length - 1] + b"\0"
    ctypes.memmove(address, encoded, len(encoded))
    return Code.SUCCESS


def check_index(index: int, values: Sequence[object], otherwise: Code = Code.P1INVALID) -> Code:
    """SUCCESS for an index of the values, else the code for an invalid argument."""
    return Code.SUCCESS if 0 <= index < len(values) else otherwise
