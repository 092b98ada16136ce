"""Checks a shot's file before any value is read: links, sizes, types, and the shapes of its arrays.

A file that labseq did not write may be made to do harm. Only :func:`check_file` looks for that. The meaning
of the numbers is checked where they become records.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from h5py import h5a, h5d, h5g, h5l, h5o, h5t  # pyright: ignore[reportAttributeAccessIssue] - h5py ships no types

from labseq.recording.schema import ARRAYS, TABLES

MAX_OBJECTS: Final = 10_000
"""Largest number of groups and datasets in a shot's file."""

MAX_DEPTH: Final = 8
"""Deepest group in a shot's file."""

MAX_ATTRIBUTES: Final = 100
"""Largest number of attributes of an object. The time to read them grows with its square."""

_FILTERS: Final = frozenset({1, 2, 3, 32000, 32001, 32004, 32008, 32015, 32026})
"""deflate, shuffle, fletcher32, LZF, Blosc, LZ4, bitshuffle, Zstd, Blosc2.

HDF5 loads a library for any other filter, which a hostile file could name.
"""

_checked: Final[dict[tuple[object, str], None]] = {}
"""Files that passed the check, each with the part that was checked. The latest thousand are kept."""


class _Expected(NamedTuple):
    """The axes and types that the schema gives a dataset.

    Attributes:
        axes: Names of its axes.
        kinds: Column, or "" for an array -> kind of its numbers, as numpy names it.
    """

    axes: Sequence[str]
    kinds: Mapping[str, str]


def _kind(dtype: str) -> str:
    return {"text": "S", "u": "i"}.get(dtype) or np.dtype(dtype).kind.replace("u", "i")


_EXPECTED: Final = {
    path: _Expected(array.axes.split(", "), {"": _kind(array.dtype)}) for path, array in ARRAYS.items()
} | {
    table.path: _Expected([table.row], {column.name: _kind(column.dtype) for column in table.columns})
    for table in TABLES
}


def check_file(file: Any, path: Path, only: str = "") -> None:
    """Refuse a shot's file that leads elsewhere, declares too much, or has arrays of wrong types or shapes.

    A file that has not changed since it was checked is not checked again.

    Args:
        file: The opened file. Only its structure is read.
        only: The one dataset or group that will be read, such as "/entry/detection". "" for all.

    Raises:
        ValueError: The file links to other files or has data there, contains an object twice, has unknown
            filters, types or objects, declares more data than it has, or violates the schema.
    """
    status = path.stat()
    stamp = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
    if (stamp, "") in _checked or (stamp, only) in _checked:
        return
    _check_contents(file, status.st_size, only)
    _checked[stamp, only] = None
    for oldest in [*_checked][:-1000]:
        _checked.pop(oldest, None)


def _check_contents(file: Any, n_bytes: int, only: str) -> None:
    n_objects = n_declared = n_stored = 0
    lengths: dict[str, int] = {"yx": 2}
    pending: list[tuple[Any, str]] = [(file.id, "")]
    while pending:
        group, where = pending.pop()
        for name in group:
            n_objects += 1
            place = f"{where}/{name.decode('utf-8', 'backslashreplace')}"
            if n_objects > MAX_OBJECTS or place.count("/") > MAX_DEPTH:
                raise ValueError(f"it has more than {MAX_OBJECTS} objects, or groups too deep, up to {place}")
            if only and not (f"{only}/".startswith(f"{place}/") or place.startswith(f"{only}/")):
                continue
            kind = group.links.get_info(name).type
            if kind == h5l.TYPE_SOFT and group.links.get_val(name).startswith(b"/entry/camera/"):
                continue
            if kind != h5l.TYPE_HARD:
                raise ValueError(f"{place} is a link that leads elsewhere")
            node = h5o.open(group, name)
            if h5o.get_info(node).rc > 1:  # groups that contain each other would never end
                raise ValueError(f"{place} is in the file twice")
            if h5a.get_num_attrs(node) > MAX_ATTRIBUTES:
                raise ValueError(f"{place} has more than {MAX_ATTRIBUTES} attributes")
            if isinstance(node, h5g.GroupID):
                pending.append((node, place))
            elif isinstance(node, h5d.DatasetID):
                n_declared += _check_dataset(node, place, n_bytes, lengths)
                n_stored += node.get_storage_size()
            else:
                raise ValueError(f"{place} is neither a group nor a dataset")  # noqa: TRY004 - of the file
    if n_declared > n_bytes:
        raise ValueError(f"its datasets declare {n_declared} bytes, but the file has {n_bytes}")
    if not only and n_bytes > 2 * n_stored + (1 << 26):  # a checksum of a file without end takes for ever
        raise ValueError(f"it has {n_bytes} bytes, and its datasets take {n_stored}")


def _check_dataset(dataset: Any, place: str, n_bytes: int, lengths: dict[str, int]) -> int:
    """Check a dataset.

    Args:
        place: Its path in the file.
        n_bytes: Size of the file.
        lengths: Axis -> its length in earlier datasets. New axes are added.

    Returns:
        Bytes that it declares. 0 if it is compressed, because its size is checked here.

    Raises:
        ValueError: Its data are not in the file, are more than the file can hold, or violate the schema.
    """
    kind, shape = dataset.get_type(), dataset.get_space().get_simple_extent_dims()
    plist = dataset.get_create_plist()
    if plist.get_external_count() or plist.get_layout() == h5d.VIRTUAL:
        raise ValueError(f"{place} keeps its data in another file")
    check_type(kind, place)
    size = math.prod(shape) * kind.get_size()
    if plist.get_layout() == h5d.CHUNKED:  # HDF5 reads a chunk as a whole, however small the dataset
        size = max(size, math.prod(plist.get_chunk()) * kind.get_size())
    filters = {plist.get_filter(i)[0] for i in range(plist.get_nfilters())}
    if not filters <= _FILTERS:
        raise ValueError(f"{place} has the filter {min(filters - _FILTERS)}, which labseq does not use")
    # frames compress by less than a factor of 64, and a dataset of up to 16 MiB may be as empty as it likes
    limit = max(1 << 24, 64 * n_bytes) if filters else n_bytes
    if size > limit:
        raise ValueError(f"{place} declares {size} bytes, but the file has {n_bytes}")
    camera = re.match(r"/entry/camera/[^/]+/", place)
    schema_path = place.replace(camera[0], "camera/<name>/") if camera else place.removeprefix("/entry/")
    if (expected := _EXPECTED.get(schema_path)) is not None:
        check_type(kind, place, expected.kinds)
        _check_shape(shape, expected.axes, place, lengths, camera[0] if camera else "")
    return 0 if filters else size


def _check_shape(
    shape: tuple[int, ...], axes: Sequence[str], place: str, lengths: dict[str, int], camera: str
) -> None:
    """Compare a shape with the axes of the schema, and with the shapes of datasets that share an axis."""
    if len(shape) != len(axes):
        raise ValueError(f"{place} has the shape {shape}; expected ({', '.join(axes)})")
    for axis, length in zip(axes, shape, strict=True):
        known = lengths.setdefault(camera + axis, length)  # each camera has its own number of frames
        if known != length:
            raise ValueError(f"{place} has the length {length} along '{axis}'; expected {known}")


_KIND_OF: Final = {h5t.TypeIntegerID: "i", h5t.TypeFloatID: "f", h5t.TypeStringID: "S", h5t.TypeEnumID: "b"}


def check_type(kind: Any, place: str, expected: Mapping[str, str] | None = None, name: str = "") -> None:
    """Refuse types that labseq does not use.

    References and sequences lead elsewhere in the file, or to the same place many times. If the part of the
    file that holds texts of variable length is damaged, HDF5 reads them without end.

    Args:
        place: Its place in the file, for the message.
        expected: Column, or "" for an array -> kind of its numbers. Other columns may have any kind.
        name: The column.

    Raises:
        ValueError: The type is not allowed.
    """
    if isinstance(kind, h5t.TypeCompoundID):
        for i in range(kind.get_nmembers()):
            column = kind.get_member_name(i).decode("utf-8", "backslashreplace")
            check_type(kind.get_member_type(i), place, expected, column)
        return
    if isinstance(kind, h5t.TypeArrayID):
        check_type(kind.get_super(), place, expected, name)
        return
    letter = _KIND_OF.get(type(kind))
    if letter is None:
        raise ValueError(f"{place} has a type that labseq does not use")
    if letter == "S" and kind.is_variable_str():
        raise ValueError(f"{place} is a text of variable length, which labseq does not use")
    if letter != (expected or {}).get(name, letter):
        what = f"'{name}' of {place}" if name else place
        raise ValueError(f"{what} is of another type; expected {_NAMES[(expected or {})[name]]}")


_NAMES: Final = {"i": "integers", "f": "floating-point numbers", "S": "texts", "b": "true or false"}
