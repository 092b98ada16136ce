"""How the parts of the simulator declare which SDK functions they implement.

A method marked with :func:`implements` takes the inputs of the C function, and returns its outputs: these are
written through the pointers at the end of the C function's arguments. Where it refuses a call, it raises
:class:`Refused`; where it returns a :class:`Code`, the C function does, too. Functions that have only outputs
are listed in the dictionary ``getters`` of the class.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, TypeVar

from labseq_andor.codes import Code

F = TypeVar("F", bound=Callable[..., object])
T = TypeVar("T")

TEXT_BYTES: Final = 256
"""Size of the buffers for texts whose length the SDK does not pass."""

ALL: Final = -1
"""Number of outputs of a function without inputs."""

_MARK: Final = "_labseq_andor_sim"


class Refused(Exception):  # noqa: N818 - it is a return code of the SDK, not an error of labseq
    """An SDK function refuses a call, with this return code."""

    def __init__(self, code: Code) -> None:
        self.code = code
        super().__init__(code)


def require(is_valid: object, code: Code = Code.P1INVALID) -> None:
    """Refuse a call unless a condition holds."""
    if not is_valid:
        raise Refused(code)


def pick(values: Sequence[T], index: int, code: Code = Code.P1INVALID) -> T:
    """One of some values; refuses an index that is out of range."""
    require(0 <= index < len(values), code)
    return values[index]


@dataclass(frozen=True, slots=True)
class Function:
    """An SDK function.

    Attributes:
        method: Its implementation.
        n_outputs: Number of pointers at its end that outputs are written to.
        only_idle: It is refused with DRV_ACQUIRING while the camera acquires.
        waits: It waits, so other calls must be possible meanwhile.
    """

    method: Callable[..., object]
    n_outputs: int = 0
    only_idle: bool = False
    waits: bool = False

    def call(self, arguments: Sequence[Any]) -> int:
        """Call it with the arguments of the C function; returns its return code."""
        n_inputs = 0 if self.n_outputs == ALL else len(arguments) - self.n_outputs
        try:
            result = self.method(*arguments[:n_inputs])
        except Refused as refused:
            return refused.code
        if isinstance(result, Code):
            return result
        outputs: Sequence[Any] = [] if result is None else result if isinstance(result, tuple) else [result]
        for pointer, value in zip(arguments[n_inputs:], outputs, strict=True):
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
    found = {name: Function(partial(get, part), ALL) for name, get in getters_of(type(part)).items()}
    for attribute in vars(type(part)).values():
        if (mark := getattr(attribute, _MARK, None)) is not None:
            names, *rules = mark
            found |= dict.fromkeys(names, Function(attribute.__get__(part), *rules))
    return found


def names_in(*classes: type) -> frozenset[str]:
    """Names of the SDK functions that objects of some classes implement."""
    marks = [getattr(attribute, _MARK, None) for kind in classes for attribute in vars(kind).values()]
    names = {name for mark in marks if mark is not None for name in mark[0]}
    return frozenset(names.union(*map(getters_of, classes)))


def getters_of(kind: type) -> Mapping[str, Callable[[Any], object]]:
    """Functions that only read something: by name, what gets their outputs from an object of a class."""
    return getattr(kind, "getters", {})


def write_text(address: int, text: str, length: int = TEXT_BYTES) -> None:
    """Write text with its closing zero to an address, at most ``length`` bytes."""
    encoded = text.encode()[: length - 1] + b"\0"
    ctypes.memmove(address, encoded, len(encoded))
