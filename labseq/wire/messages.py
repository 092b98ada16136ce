"""A message: one part of msgpack for its structure, a raw one for all small arrays, and some for each other.

Nothing that arrives is executed: it can become plain values, arrays of numbers, the types of :data:`TYPES`
and the errors of :mod:`labseq.errors`, whose own constructors check their values.
"""

from __future__ import annotations

import dataclasses
import math
import re
import sys
from collections.abc import Mapping, Sequence, Set as AbstractSet
from enum import Enum
from pathlib import PurePath
from typing import Any, Final, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from labseq import errors, model
from labseq.errors import DeviceError, LabseqError
from labseq.messages import error_text, format_error, one_line, visible

Part: TypeAlias = bytes | memoryview

MAX_HEADER: Final = 1 << 20
"""Largest first part, in bytes."""
MAX_PART: Final = 1 << 26
"""Largest part, in bytes; a frame of 4096 x 4096 pixels has half of that."""
SMALL: Final = 1 << 14
"""Arrays of at most so many bytes share a part."""
ALIGNMENT: Final = 16
"""Where arrays begin in it, in bytes."""
MAX_PARTS: Final = 256
MAX_DEPTH: Final = 16
MAX_DIMENSIONS: Final = 4

_NUMBERS: Final = re.compile(r"[|<](?:b1|[iu][1248]|f[48])")
_TEXT: Final = re.compile(r"\|S\d{1,4}|<U\d{1,4}")

TYPES: Final[Mapping[str, type]] = {
    one.__name__: one
    for one in (
        model.AxisTones,
        model.CalibrationEntry,
        model.CameraFacts,
        model.Frame,
        model.LineProgram,
        model.LineSpec,
        model.LinesFacts,
        model.LossSpec,
        model.MotionSpec,
        model.RfSpec,
        model.SiteGrid,
        model.ToneProgram,
        model.TweezersFacts,
        errors.Problem,
    )
}
"""The types that a message may contain, by name."""
_FIELDS: Final = {name: [f.name for f in dataclasses.fields(one) if f.init] for name, one in TYPES.items()}
_ARRAY, _OBJECT, _TUPLE, _SET = 1, 2, 3, 4


class MessageError(ValueError):
    """A message that is damaged, too large, or contains what no message may contain."""


def pack(value: Any) -> list[Part]:
    """The parts of a message.

    Raises:
        MessageError: The value contains something that cannot be sent, or is too large.
    """
    import msgpack

    arrays: list[Part] = []
    small = bytearray()

    def substitute(one: Any) -> Any:
        if isinstance(one, np.ndarray):
            place, dtype, shape, about = _described(one, arrays, small)
            return msgpack.ExtType(_ARRAY, inner([place, dtype, list(shape), about]))
        if (fields := _FIELDS.get(type(one).__name__)) and type(one) is TYPES[type(one).__name__]:
            return msgpack.ExtType(_OBJECT, inner([type(one).__name__, [getattr(one, f) for f in fields]]))
        if isinstance(one, tuple):
            return msgpack.ExtType(_TUPLE, inner(list(cast("tuple[Any]", one))))
        if isinstance(one, AbstractSet):
            return msgpack.ExtType(_SET, inner(sorted(cast("AbstractSet[Any]", one))))
        return _plain(one)

    def inner(one: Any) -> bytes:
        return cast("bytes", msgpack.packb(one, default=substitute, strict_types=True))

    try:
        header = inner(value)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise MessageError(f"it cannot be sent: {format_error(error)}") from error
    parts: list[Part] = [header, bytes(small), *arrays] if small or arrays else [header]
    if len(header) > MAX_HEADER or len(parts) > MAX_PARTS or max(map(len, parts)) > MAX_PART:
        raise MessageError(f"it is too large to be sent: at most {MAX_PARTS} parts of {MAX_PART >> 20} MB")
    return parts


def _described(array: NDArray[Any], arrays: list[Part], small: bytearray) -> list[Any]:
    """Where an array is, its dtype and its shape.

    The place is [index of its part, where it begins there]. Small arrays share the first part after the
    header, because a part costs more than copying.
    """
    dtype = array.dtype
    if not dtype.isnative or sys.byteorder == "big":
        dtype = dtype.newbyteorder("<")
    if array.dtype is not dtype or not array.flags.c_contiguous:
        array = np.ascontiguousarray(array, dtype).reshape(array.shape)
    if array.nbytes <= SMALL:
        place = [1, len(small)]
        small.extend(array.tobytes() + bytes(ALIGNMENT - array.nbytes % ALIGNMENT))  # never nothing
    else:
        place = [len(arrays) + 2, 0]
        arrays.append(array.reshape(-1).view(np.uint8).data)
    if dtype.names is None:
        return [place, _dtype_text(dtype), array.shape, {}]
    columns = [[name, _dtype_text(dtype[name])] for name in dtype.names]
    return [place, columns, array.shape, dict((array.dtype.metadata or {}).get("descriptions", {}))]


def _dtype_text(dtype: np.dtype[Any]) -> str:
    if _NUMBERS.fullmatch(dtype.str) or _TEXT.fullmatch(dtype.str):
        return dtype.str
    raise TypeError(f"an array of {dtype}")


def _plain(one: Any) -> Any:
    """A value that msgpack knows, for one of a kindred type."""
    if isinstance(one, Enum):
        return one.value
    if isinstance(one, bool | np.bool_):
        return bool(one)
    if isinstance(one, np.generic):
        return one.item()
    for kind in (int, float, str):
        if isinstance(one, kind):
            return kind(one)
    if isinstance(one, PurePath):
        return str(one)
    if isinstance(one, Mapping):
        return {str(key): item for key, item in cast("Mapping[Any, Any]", one).items()}
    if isinstance(one, Sequence):
        return list(cast("Sequence[Any]", one))
    raise TypeError(f"a value of the type {type(one).__name__}")


def unpack(parts: Sequence[Part]) -> Any:
    """The value that a message contains; its arrays are read-only and share the memory of the parts.

    Sizes and shapes are checked before anything is made of them.

    Raises:
        MessageError: It is damaged, too large, or contains what no message may contain.
    """
    import msgpack

    if not 1 <= len(parts) <= MAX_PARTS:
        raise MessageError(f"it has {len(parts)} parts; expected 1 to {MAX_PARTS}")
    depth = 0

    def rebuild(code: int, data: bytes) -> Any:
        nonlocal depth
        depth += 1
        if depth > MAX_DEPTH:
            raise MessageError("it is nested too deep")
        content = inner(data)
        depth -= 1
        if not isinstance(content, list):
            raise MessageError("it is damaged")
        if code == _ARRAY:
            return _array(parts, cast("list[Any]", content))
        if code == _OBJECT:
            return _object(cast("list[Any]", content))
        if code in (_TUPLE, _SET):
            return tuple(content) if code == _TUPLE else frozenset(content)
        raise MessageError(f"it contains something of the unknown type {code}")

    def inner(data: Part) -> Any:
        return msgpack.unpackb(data, ext_hook=rebuild, strict_map_key=True)

    header = memoryview(parts[0])
    if len(header) > MAX_HEADER:
        raise MessageError(f"its first part has {len(header)} bytes; expected at most {MAX_HEADER}")
    try:
        return inner(header)
    except MessageError:
        raise
    except Exception as error:  # of msgpack's many kinds, and of constructors
        raise MessageError(f"it is damaged: {format_error(error)[:200]}") from error


def _array(parts: Sequence[Part], content: list[Any]) -> NDArray[Any]:
    place, dtype, shape, about = content
    if isinstance(dtype, list):
        columns = [(str(name), _known_dtype(one)) for name, one in cast("list[Any]", dtype)]
        kind = np.dtype(columns, metadata={"descriptions": dict(about)})
    else:
        kind = _known_dtype(dtype)
    if (
        not isinstance(shape, list)
        or len(cast("list[Any]", shape)) > MAX_DIMENSIONS
        or any(type(n) is not int or not 0 <= n <= MAX_PART * MAX_PARTS for n in cast("list[Any]", shape))
    ):
        raise MessageError("an array has a wrong shape")
    wanted = math.prod(cast("list[int]", shape)) * kind.itemsize
    data = _data(parts, place, wanted)
    if data.nbytes != wanted:
        raise MessageError(f"an array of shape {tuple(shape)} has {data.nbytes} bytes; expected {wanted}")
    array = np.frombuffer(data, kind).reshape(shape) if wanted else np.empty(shape, kind)
    if not array.flags.aligned:  # kernels are compiled for aligned arrays
        array = array.copy()
    array.flags.writeable = False
    return array


def _data(parts: Sequence[Part], place: Any, n_bytes: int) -> memoryview:
    """The bytes of an array, from their place as :func:`_described` gives it."""
    part, begin = place
    if type(part) is not int or type(begin) is not int or not 1 <= part < len(parts) or begin < 0:
        raise MessageError("an array is missing")
    return memoryview(parts[part])[begin : begin + n_bytes]


def _known_dtype(text: Any) -> np.dtype[Any]:
    if not isinstance(text, str) or not (_NUMBERS.fullmatch(text) or _TEXT.fullmatch(text)):
        raise MessageError(f"an array has the unknown dtype {str(text)[:20]!r}")
    return np.dtype(text)


def _object(content: list[Any]) -> Any:
    name, values = content
    if not isinstance(name, str) or name not in TYPES or not isinstance(values, list):
        raise MessageError(f"it contains the unknown type {str(name)[:40]!r}")
    fields = _FIELDS[name]
    if len(cast("list[Any]", values)) != len(fields):
        raise MessageError(f"a {name} has {len(values)} values; expected {len(fields)}")
    return TYPES[name](**dict(zip(fields, cast("list[Any]", values), strict=True)))


_ERRORS: Final = {
    name: one for name, one in vars(errors).items() if isinstance(one, type) and issubclass(one, LabseqError)
}


def report_error(error: BaseException) -> dict[str, Any]:
    """An error as a value for a message: its class, its text and its values."""
    kind = next((one.__name__ for one in type(error).__mro__ if _ERRORS.get(one.__name__) is one), "")
    if not kind:
        return {"class": "", "text": format_error(error), "values": {}}
    values: dict[str, Any] = {}
    for key, value in vars(error).items():
        plain = value is None or isinstance(value, bool | int | float | str)
        values[key] = value if plain or key in ("problems", "setting", "known", "site") else str(value)
    text = "\n".join(map(visible, str(error).splitlines())) if kind == "ConfigError" else error_text(error)
    return {"class": kind, "text": text, "values": values}


def error_of(report: Any, name: str, where: str) -> LabseqError:
    """The error that was reported from another computer, as one of the same class.

    Args:
        report: What :func:`report_error` made of it.
        name: What the profile of this computer calls the device.
        where: The address of the other computer, for the message.
    """
    try:
        kind, text, values = str(report["class"]), str(report["text"]), dict(report["values"])
    except (TypeError, KeyError, ValueError):
        return DeviceError(name, f"an error that cannot be read came from {where}")
    cls = _ERRORS.get(kind)
    if cls is None:
        return DeviceError(name, f"{text} (at {where})")
    text = f"{text} (at {where})"
    if issubclass(cls, DeviceError | errors.TransientError) and {"device", "message"} <= values.keys():
        values["device"], values["message"] = name, f"{one_line(str(values['message']))} (at {where})"
        text = f"{name}: {values['message']}"
    made = cls.__new__(cls)
    made.args = (text,)
    made.__dict__.update(values)
    return made
