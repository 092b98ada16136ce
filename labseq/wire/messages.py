"""Messages, with a msgpack part for the structure, a raw part for small arrays, and one per large array.

Nothing that arrives is executed. It can only become plain values, arrays of numbers, the types of
:data:`TYPES` and the errors of :mod:`labseq.errors`, whose own constructors check their values.
"""

from __future__ import annotations

import dataclasses
import gc
import math
import re
import sys
from collections.abc import Generator, Mapping, Sequence, Set as AbstractSet
from contextlib import contextmanager
from enum import Enum
from pathlib import PurePath
from typing import Any, Final, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from labseq import errors, model
from labseq.errors import DeviceError, LabseqError
from labseq.messages import error_text, format_error, one_line, visible
from labseq.model import SiteGrid

Part: TypeAlias = bytes | memoryview

MAX_HEADER: Final = 1 << 20
"""Largest first part, in bytes."""
MAX_PART: Final = 1 << 26
"""Largest part, in bytes, which is twice a frame of 4096 x 4096 pixels."""
SMALL: Final = 1 << 14
"""Arrays of up to this many bytes share a part, because a part costs more than copying them."""
ALIGNMENT: Final = 16
"""Arrays in the shared part begin at multiples of this number of bytes."""
MAX_PARTS: Final = 256
MAX_MESSAGE: Final = 1 << 28
"""Largest sum of all parts, in bytes."""
MAX_DEPTH: Final = 16
MAX_SITES: Final = 1_000_000
"""Maximum number of sites of all grids in a message, as in a profile. A grid computes all positions."""

_NUMBERS: Final = re.compile(r"[|<](?:b1|[iu][1248]|f[48])")
_TEXT: Final = re.compile(r"(?:\|S|<U)[1-9]\d{0,3}")

TYPES: Final[Mapping[str, type]] = {
    cls.__name__: cls
    for cls in (
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
_FIELDS: Final = {name: [f.name for f in dataclasses.fields(cls) if f.init] for name, cls in TYPES.items()}
_ARRAY, _OBJECT, _TUPLE, _SET = 1, 2, 3, 4


class MessageError(ValueError):
    """A message that is damaged, too large, or contains a value that messages cannot carry."""


def pack(value: Any) -> list[Part]:
    """Convert a value to the parts of a message.

    Raises:
        MessageError: The value contains something that cannot be sent, or is too large.
    """
    import msgpack

    arrays: list[Part] = []
    small = bytearray()

    def substitute(item: Any) -> Any:
        if isinstance(item, np.ndarray):
            place, dtype, shape, descriptions = _add_array(item, arrays, small)
            return msgpack.ExtType(_ARRAY, inner([place, dtype, list(shape), descriptions]))
        if (fields := _FIELDS.get(type(item).__name__)) and type(item) is TYPES[type(item).__name__]:
            return msgpack.ExtType(_OBJECT, inner([type(item).__name__, [getattr(item, f) for f in fields]]))
        if isinstance(item, tuple):
            return msgpack.ExtType(_TUPLE, inner(list(cast("tuple[Any]", item))))
        if isinstance(item, AbstractSet):
            return msgpack.ExtType(_SET, inner(sorted(cast("AbstractSet[Any]", item))))
        return _plain(item)

    def inner(item: Any) -> bytes:
        return cast("bytes", msgpack.packb(item, default=substitute, strict_types=True))

    try:
        header = inner(value)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise MessageError(f"it cannot be sent: {format_error(error)}") from error
    parts: list[Part] = [header, bytes(small), *arrays] if small or arrays else [header]
    sizes = [len(part) for part in parts]
    is_large = sizes[0] > MAX_HEADER or max(sizes) > MAX_PART or sum(sizes) > MAX_MESSAGE
    if is_large or len(parts) > MAX_PARTS:
        most = f"{MAX_PARTS} parts of {MAX_PART >> 20} MiB, {MAX_MESSAGE >> 20} MiB in all"
        raise MessageError(f"it is too large to be sent; the limit is {most}")
    return parts


def _add_array(array: NDArray[Any], arrays: list[Part], small: bytearray) -> list[Any]:
    """Add an array to the parts of a message.

    Returns:
        The array's place [index of the part, first byte], dtype, shape, and descriptions of the columns.
    """
    dtype = array.dtype
    if not dtype.isnative or sys.byteorder == "big":
        dtype = dtype.newbyteorder("<")
    if array.dtype is not dtype or not array.flags.c_contiguous:
        array = np.ascontiguousarray(array, dtype).reshape(array.shape)
    if array.nbytes <= SMALL:
        place = [1, len(small)]
        small.extend(array.tobytes() + bytes(ALIGNMENT - array.nbytes % ALIGNMENT))  # never empty
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


def _plain(value: Any) -> Any:
    """Convert a value to the closest type of msgpack."""
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, np.generic):
        return value.item()
    for kind in (int, float, str):
        if isinstance(value, kind):
            return kind(value)
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): item for key, item in cast("Mapping[Any, Any]", value).items()}
    if isinstance(value, Sequence):
        return list(cast("Sequence[Any]", value))
    raise TypeError(f"a value of the type {type(value).__name__}")


def unpack(parts: Sequence[Part]) -> Any:
    """Convert a message to its value. The arrays are read-only and share the memory of the parts.

    Sizes and shapes are checked before they are used. No byte belongs to two arrays, so all arrays
    together are no larger than the message.

    Raises:
        MessageError: The message is damaged, too large, or contains a value that messages cannot carry.
    """
    import msgpack

    if not 1 <= len(parts) <= MAX_PARTS:
        raise MessageError(f"it has {len(parts)} parts; expected 1 to {MAX_PARTS}")
    if (n_bytes := sum(map(len, parts))) > MAX_MESSAGE:
        raise MessageError(f"it has {n_bytes} bytes; expected at most {MAX_MESSAGE}")
    depth, n_sites = 0, 0
    unused = [0] * len(parts)  # the first byte of each part that no array has used yet

    def rebuild(code: int, data: bytes) -> Any:
        nonlocal depth, n_sites
        depth += 1
        if depth > MAX_DEPTH:
            raise MessageError("it is nested too deeply")
        content = inner(data)
        depth -= 1
        if not isinstance(content, list):
            raise MessageError("it is damaged")
        if code == _ARRAY:
            return _array(parts, cast("list[Any]", content), unused)
        if code == _OBJECT:
            n_sites += _count_sites(cast("list[Any]", content))
            if n_sites > MAX_SITES:
                raise MessageError(f"its grids have more than {MAX_SITES} sites")
            return _object(cast("list[Any]", content))
        if code in (_TUPLE, _SET):
            return tuple(content) if code == _TUPLE else frozenset(content)
        raise MessageError(f"it contains a value of the unknown type {code}")

    def inner(data: Part) -> Any:
        # msgpack reserves memory for the length that a list announces, so first check that it has these items
        scanner = msgpack.Unpacker(read_size=len(data) + 1, max_buffer_size=MAX_HEADER + 1)
        scanner.feed(data)
        scanner.skip()
        return msgpack.unpackb(data, ext_hook=rebuild, strict_map_key=True)

    header = memoryview(parts[0])
    if len(header) > MAX_HEADER:
        raise MessageError(f"its first part has {len(header)} bytes; expected at most {MAX_HEADER}")
    try:
        with _no_collections():
            return inner(header)
    except MessageError:
        raise
    except Exception as error:  # msgpack and constructors raise many kinds
        raise MessageError(f"it is damaged: {format_error(error)[:200]}") from error


@contextmanager
def _no_collections() -> Generator[None]:
    """Context manager without garbage collection, which takes most of the time for a list of many lists."""
    is_collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if is_collecting:
            gc.enable()


def _array(parts: Sequence[Part], content: list[Any], unused: list[int]) -> NDArray[Any]:
    place, dtype, shape, descriptions = content
    if isinstance(dtype, list):
        columns = [(str(name), _checked_dtype(text)) for name, text in cast("list[Any]", dtype)]
        kind = np.dtype(columns, metadata={"descriptions": dict(descriptions)})
    else:
        kind = _checked_dtype(dtype)
    if (
        not isinstance(shape, list)
        or len(cast("list[Any]", shape)) > 4
        or any(type(n) is not int or n < 0 for n in cast("list[Any]", shape))
        # an axis of length 0 must not hide that another one is endless
        or not 0 < math.prod(max(n, 1) for n in cast("list[int]", shape)) * kind.itemsize <= MAX_PART
    ):
        raise MessageError("an array has a wrong shape")
    n_bytes = math.prod(cast("list[int]", shape)) * kind.itemsize
    data = _data(parts, place, n_bytes, unused)
    if data.nbytes != n_bytes:
        raise MessageError(f"an array of shape {tuple(shape)} has {data.nbytes} bytes; expected {n_bytes}")
    array = np.frombuffer(data, kind).reshape(shape) if n_bytes else np.empty(shape, kind)
    if not array.flags.aligned:  # kernels are compiled for aligned arrays
        array = array.copy()
    array.flags.writeable = False
    return array


def _data(parts: Sequence[Part], place: Any, n_bytes: int, unused: list[int]) -> memoryview:
    """The bytes of an array, from the place that :func:`_add_array` returned.

    Arrays that shared bytes would cost more memory than the message has, because unaligned ones are copied.
    """
    part, begin = place
    if type(part) is not int or type(begin) is not int or not 1 <= part < len(parts) or begin < 0:
        raise MessageError("an array is missing")
    if begin < unused[part]:
        raise MessageError("two of its arrays share bytes")
    unused[part] = begin + n_bytes
    return memoryview(parts[part])[begin : begin + n_bytes]


def _checked_dtype(text: Any) -> np.dtype[Any]:
    if not isinstance(text, str) or not (_NUMBERS.fullmatch(text) or _TEXT.fullmatch(text)):
        raise MessageError(f"an array has the unknown dtype {str(text)[:20]!r}")
    return np.dtype(text)


def _count_sites(content: list[Any]) -> int:
    """The number of sites according to an object's fields. 0 if it is not a grid."""
    name, values = content
    if name != SiteGrid.__name__:
        return 0
    fields = dict(zip(_FIELDS[name], values, strict=True))
    n_rows, n_cols = fields["n_rows"], fields["n_cols"]
    if type(n_rows) is not int or type(n_cols) is not int or n_rows < 1 or n_cols < 1:
        raise MessageError("a grid has a wrong size")
    return n_rows * n_cols


def _object(content: list[Any]) -> Any:
    name, values = content
    if not isinstance(name, str) or name not in TYPES or not isinstance(values, list):
        raise MessageError(f"it contains the unknown type {str(name)[:40]!r}")
    fields = _FIELDS[name]
    if len(cast("list[Any]", values)) != len(fields):
        raise MessageError(f"a {name} has {len(values)} values; expected {len(fields)}")
    return TYPES[name](**dict(zip(fields, cast("list[Any]", values), strict=True)))


_ERRORS: Final = {
    name: cls for name, cls in vars(errors).items() if isinstance(cls, type) and issubclass(cls, LabseqError)
}


def report_error(error: BaseException) -> dict[str, Any]:
    """An error as a value for a message, with its class, text and values."""
    kind = next((cls.__name__ for cls in type(error).__mro__ if _ERRORS.get(cls.__name__) is cls), "")
    if not kind:
        return {"class": "", "text": format_error(error), "values": {}}
    values: dict[str, Any] = {}
    for key, value in vars(error).items():
        plain = value is None or isinstance(value, bool | int | float | str)
        values[key] = value if plain or key in ("problems", "setting", "known", "site") else str(value)
    text = "\n".join(map(visible, str(error).splitlines())) if kind == "ConfigError" else error_text(error)
    return {"class": kind, "text": text, "values": values}


def error_of(report: Any, name: str, where: str) -> LabseqError:
    """The error that another computer reported, as an object of the same class.

    Args:
        report: The result of :func:`report_error`.
        name: Name of the device in the profile of this computer.
        where: The address of the other computer, for the message.
    """
    try:
        kind, text, values = str(report["class"]), str(report["text"]), dict(report["values"])
    except (TypeError, KeyError, ValueError):
        return DeviceError(name, f"an unreadable error came from {where}")
    cls = _ERRORS.get(kind)
    if cls is None:
        return DeviceError(name, f"{text} (at {where})")
    text = f"{text} (at {where})"
    if issubclass(cls, DeviceError | errors.TransientError) and {"device", "message"} <= values.keys():
        values["device"], values["message"] = name, f"{one_line(str(values['message']))} (at {where})"
        text = f"{name}: {values['message']}"
    # not with its constructor, whose parameters differ from class to class
    rebuilt = cls.__new__(cls)
    rebuilt.args = (text,)
    rebuilt.__dict__.update(values)
    return rebuilt
