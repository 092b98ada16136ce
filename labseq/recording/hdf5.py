"""Reads and writes HDF5: attributes, arrays, tables and texts with their descriptions and units."""

from __future__ import annotations

import math
import mmap
import re
import struct
from collections.abc import Container, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from h5py import h5a, h5d, h5g, h5l, h5o, h5s, h5t  # pyright: ignore[reportAttributeAccessIssue] - h5py ships no types
from numpy.typing import NDArray

from labseq.errors import RecordingError
from labseq.files import open_ordinary
from labseq.messages import install_hint
from labseq.plain import dumps, parse_value, plain_text, to_plain
from labseq.recording.schema import ARRAYS, Dataset, Field, Table, describe_columns

_STRING: Final = h5py.string_dtype()
_STRING_TYPE: Final = h5t.py_create(_STRING, logical=True)
_SCALAR: Final = h5s.create(h5s.SCALAR)


def set_attributes(node: Any, values: Mapping[str, Any]) -> None:
    """Add new attributes to a group or dataset; characters that HDF5 cannot store are replaced."""
    for name, value in values.items():  # node.attrs[name] = value takes twice the time
        if isinstance(value, str):
            _add_text(node, name, np.array(plain_text(value), _STRING), _SCALAR)
        elif isinstance(value, np.generic):
            kind = h5t.py_create(value.dtype, logical=True)
            h5a.create(node.id, name.encode(), kind, _SCALAR).write(np.asarray(value))
        else:
            node.attrs[name] = value


def _add_text(node: Any, name: str, text: Any, space: Any) -> None:
    h5a.create(node.id, name.encode(), _STRING_TYPE, space).write(text)


def write_fields(node: Any, fields: Sequence[Field], record: Any) -> None:
    """Add attributes, one for each field of a record."""
    set_attributes(node, {field.name: _attribute(field, field.value(record)) for field in fields})


def _attribute(field: Field, value: Any) -> Any:
    if field.dtype == "integer":
        return np.int64(value) if -(2**63) <= value < 2**63 else str(value)
    if field.dtype == "texts":
        return np.array(list(map(plain_text, value)), _STRING)
    return value if field.dtype == "text" else np.dtype(field.dtype).type(value)


def read_fields(node: Any, fields: Sequence[Field]) -> dict[str, Any]:
    """Read attributes: attribute of the record -> plain value; those of a newer minor format are ignored."""
    found: dict[str, Any] = {}
    for field in (field for field in fields if field.name in node.attrs):
        value: Any = node.attrs[field.name]
        if isinstance(value, np.generic):
            value = value.item()
        elif field.dtype == "texts":
            value = tuple(value)
        value = int(value) if field.dtype == "integer" else value
        if not isinstance(value, _KINDS[field.dtype]):
            raise TypeError(f"'{field.name}' is {type(value).__name__}; expected {field.dtype}")
        found[field.attribute] = value
    return found


_KINDS: Final = {"text": str, "texts": tuple, "integer": int, "int64": int, "bool": bool, "float64": float}


def write_texts(group: Any, fields: Sequence[Field], record: Any) -> None:
    """Add a dataset of text or JSON for each field of a record."""
    for field in fields:
        value = field.value(record)
        text = dumps(value) if field.dtype == "json" else plain_text(value)
        dataset = group.create_dataset(field.name, data=text, dtype=_STRING)
        kind = "application/json" if field.dtype == "json" else "text/plain"
        set_attributes(dataset, {"content_type": kind, "units": "", "description": field.description})


def read_texts(group: Any, fields: Sequence[Field]) -> dict[str, Any]:
    """Read texts and JSON: attribute of the record -> value; those of a newer minor format are ignored."""
    texts = {field: group[field.name][()].decode() for field in fields if field.name in group}
    return {
        field.attribute: parse_value(text) if field.dtype == "json" else text for field, text in texts.items()
    }


def write_values(group: Any, values: Mapping[str, Any], units: Mapping[str, str], about: str) -> None:
    """Add a dataset for each value: numbers and lists of numbers, texts, and JSON for all others."""
    names: list[str] = []
    for key, value in to_plain(values).items():
        names.append(link_name(key, names))
        facts = {"address": key, "units": units.get(key, ""), "description": about}
        if _is_numeric(value):
            dataset = group.create_dataset(names[-1], data=value)
        else:
            text = plain_text(value) if isinstance(value, str) else dumps(value)
            dataset = group.create_dataset(names[-1], data=text, dtype=_STRING)
            facts["content_type"] = "text/plain" if isinstance(value, str) else "application/json"
        set_attributes(dataset, facts)


def _is_numeric(value: Any) -> bool:
    """Whether an array holds a value as it is: a number, or a list of numbers of one type."""
    several: list[Any] = value if isinstance(value, list) else [value]
    is_one_type = {*map(type, several)} in ({bool}, {int}, {float})
    return is_one_type and all(type(one) is not int or -(2**63) <= one < 2**63 for one in several)


def read_values(group: Any) -> dict[str, Any]:
    """Read what :func:`write_values` wrote."""
    found: dict[str, Any] = {}
    for dataset in group.values():
        kind, value = dataset.attrs.get("content_type"), dataset[()]
        if kind is None:
            value = value.tolist()
        else:
            value = parse_value(value) if kind == "application/json" else value.decode()
        found[str(dataset.attrs["address"])] = value
    return found


def write_array(group: Any, path: str, values: Any, units: str | None = None) -> Any:
    """Add an array of :data:`ARRAYS` under the last part of its path; ``units`` replace the schema's."""
    what = ARRAYS[path]
    dataset = group.create_dataset(path.rpartition("/")[2], data=np.asarray(values, what.dtype))
    describe(dataset, what, units)
    return dataset


def describe(dataset: Any, what: Dataset, units: str | None = None) -> None:
    """Add the attributes for the description, the unit and the axes of a dataset."""
    set_attributes(
        dataset, {"units": what.units if units is None else units, "description": what.description}
    )
    labels, space = _texts(what.axes)
    _add_text(dataset, "DIMENSION_LABELS", labels, space)


@cache
def _texts(axes: str) -> tuple[Any, Any]:
    names = np.array(axes.split(", "), _STRING)
    return names, h5s.create_simple(names.shape)


def write_table(group: Any, table: Table, rows: NDArray[Any], name: str = "") -> None:
    """Add a table of the schema under ``name``, else the last part of its path."""
    dataset = group.create_dataset(name or table.path.rpartition("/")[2], data=rows)
    of_columns = _of_known_columns(table) if table.columns else _of_columns(rows.dtype, table)
    units, descriptions, space = of_columns
    _add_text(dataset, "units", units, space)
    _add_text(dataset, "descriptions", descriptions, space)
    set_attributes(dataset, {"description": table.description})


@cache  # the same for all shots
def _of_known_columns(table: Table) -> tuple[Any, Any, Any]:
    return _of_columns(np.dtype([(column.name, "?") for column in table.columns]), table)


def _of_columns(dtype: np.dtype[Any], table: Table) -> tuple[Any, Any, Any]:
    """Units and descriptions of the columns as arrays of text, and their shape."""
    units, descriptions = (
        np.array(list(map(plain_text, texts)), _STRING) for texts in describe_columns(dtype, table)
    )
    return units, descriptions, h5s.create_simple(units.shape)


MAX_OBJECTS: Final = 10_000
"""Largest number of groups and datasets in a shot's file."""
MAX_DEPTH: Final = 8
"""Deepest group in a shot's file."""
_FILTERS: Final = frozenset({1, 2, 3, 32000, 32001, 32004, 32008, 32015, 32026})
"""deflate, shuffle, fletcher32, LZF, Blosc, LZ4, bitshuffle, Zstd, Blosc2; others would load libraries."""
_MAX_RATIO: Final = 64
"""By how much frames can be compressed."""
_SMALL: Final = 1 << 24


_HEAP: Final = re.compile(rb"GCOL\x01\x00\x00\x00")


def check_heaps(path: Path) -> None:
    """Refuse a file whose texts libhdf5 (1.14) would read for ever.

    Texts of variable length are in "global heap collections" (HDF5 file format specification 3.0, III.E):
    "GCOL", version 1, three zeros, size, and the objects, each with index, reference count, size and data.
    Index 0 is free space, and if its size is damaged to 0, libhdf5 never comes to the next object.

    Raises:
        ValueError: A collection is damaged.
        OSError: The file cannot be read, or is not an ordinary one.
    """
    with open_ordinary(path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for start in (match.start() for match in _HEAP.finditer(data)):  # faster than find() of an mmap
            end = start + int.from_bytes(data[start + 8 : start + 16], "little")
            at = start + 16
            while at + 16 <= end <= len(data):
                index, n_bytes = struct.unpack_from("<H6xQ", data, at)
                at += 16 + -(-n_bytes // 8) * 8 if index else n_bytes
                if not index and n_bytes < 16:
                    break
            if not end - 16 < at <= end <= len(data):
                raise ValueError(f"its texts are damaged at byte {at}")


def check_contents(file: Any, n_bytes: int, only: str = "") -> None:
    """Refuse what leads out of a file, and what declares more data than the file can hold.

    Args:
        file: The file, opened; nothing but its structure is read.
        n_bytes: Its size.
        only: The one dataset or group that is read, such as "/entry/detection"; "" for all.

    Raises:
        ValueError: It has links to other files, an object twice, data in other files, unknown filters,
            types or objects, or declares more data than it has.
    """
    n_objects = n_declared = 0
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
            if h5o.get_info(node).rc > 1:
                raise ValueError(f"{place} is in the file twice")
            if isinstance(node, h5g.GroupID):
                pending.append((node, place))
            elif isinstance(node, h5d.DatasetID):
                n_declared += _declared_bytes(node, place, n_bytes)
            else:
                raise ValueError(f"{place} is neither a group nor a dataset")  # noqa: TRY004 - of the file
    if n_declared > n_bytes:
        raise ValueError(f"its datasets declare {n_declared} bytes, and the file has {n_bytes}")


def _declared_bytes(dataset: Any, place: str, n_bytes: int) -> int:
    """Bytes that a dataset declares; 0 for one that is compressed, whose size is checked here.

    Raises:
        ValueError: Its data are not in the file, or are more than it can hold.
    """
    kind, plist = dataset.get_type(), dataset.get_create_plist()
    if plist.get_external_count() or plist.get_layout() == h5d.VIRTUAL:
        raise ValueError(f"{place} keeps its data in another file")
    _check_type(kind, place)
    size = math.prod(dataset.get_space().get_simple_extent_dims()) * kind.get_size()
    if plist.get_layout() == h5d.CHUNKED:
        size = max(size, math.prod(plist.get_chunk()) * kind.get_size())
    filters = {plist.get_filter(i)[0] for i in range(plist.get_nfilters())}
    if not filters <= _FILTERS:
        raise ValueError(f"{place} has the filter {min(filters - _FILTERS)}, which labseq does not use")
    limit = max(_SMALL, _MAX_RATIO * n_bytes) if filters else n_bytes
    if size > limit:
        raise ValueError(f"{place} declares {size} bytes, and the file has {n_bytes}")
    return 0 if filters else size


def _check_type(kind: Any, place: str) -> None:
    """Refuse types that refer to other places or can repeat them: references, and sequences of any length."""
    if isinstance(kind, h5t.TypeCompoundID):
        for i in range(kind.get_nmembers()):
            _check_type(kind.get_member_type(i), place)
    elif isinstance(kind, h5t.TypeArrayID):
        _check_type(kind.get_super(), place)
    elif not isinstance(kind, h5t.TypeIntegerID | h5t.TypeFloatID | h5t.TypeStringID | h5t.TypeEnumID):
        raise ValueError(f"{place} has a type that labseq does not use")  # noqa: TRY004 - of the file


def link_name(name: str, taken: Container[str]) -> str:
    """Convert a text to a name that HDF5 accepts and that is still free.

    Example:
        >>> link_name("laser/780", ()), link_name(".", {"_"})
        ('laser_780', '__2')
    """
    clean = plain_text(name).replace("/", "_")
    if not clean.strip("."):
        clean = "_"
    free, n = clean, 1
    while free in taken:
        n += 1
        free = f"{clean}_{n}"
    return free


def load_filter(path: Path, dataset: Any) -> None:
    """Load the HDF5 filter for a dataset if it is compressed.

    Raises:
        RecordingError: It is compressed, and the package for it is missing.
    """
    if dataset.id.get_create_plist().get_nfilters() == 0:
        return
    try:
        import hdf5plugin  # noqa: F401  # pyright: ignore[reportUnusedImport] - importing it registers the filter
    except ImportError as error:
        text = f"holds compressed frames, and to read them hdf5plugin is needed; {install_hint('compress')}"
        raise RecordingError(path, text) from error
