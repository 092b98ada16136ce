"""Writes HDF5: attributes, arrays, tables and texts with their descriptions and units."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from functools import cache
from typing import Any, Final

import h5py
import numpy as np
from h5py import h5a, h5s, h5t  # pyright: ignore[reportAttributeAccessIssue] - h5py ships no types
from numpy.typing import NDArray

from labseq.plain import dumps, plain_text, to_plain
from labseq.recording.schema import ARRAYS, Dataset, Field, Table, describe_columns

_SCALAR: Final = h5s.create(h5s.SCALAR)
"""Created once because it takes 8 us, and a shot's file has more than a hundred attributes."""


def text_array(texts: str | Sequence[str], max_bytes: int = 1 << 31) -> NDArray[Any]:
    """Texts as an array of UTF-8 bytes of one length. Texts longer than ``max_bytes`` are cut.

    Texts of variable length would be in a part of the file that HDF5 reads without end if it is damaged.
    """
    several = [texts] if isinstance(texts, str) else texts
    # decoded again after the cut, which may be within a character
    data = [plain_text(text).encode()[:max_bytes].decode(errors="ignore").encode() for text in several]
    kind = h5py.string_dtype("utf-8", max(map(len, data), default=1) or 1)
    return np.array(data[0] if isinstance(texts, str) else data, kind)


def set_attributes(node: Any, values: Mapping[str, Any]) -> None:
    """Add new attributes to a group or dataset: numbers, texts and lists of texts."""
    for name, value in values.items():  # node.attrs[name] = value takes twice the time
        is_text = isinstance(value, str | list | tuple)
        array = _text_attribute(value) if is_text else np.asarray(value)
        add_attribute(node, name, array)


def add_attribute(node: Any, name: str, array: NDArray[Any]) -> None:
    """Add an attribute from an array."""
    kind = h5t.py_create(array.dtype, logical=True)
    space = h5s.create_simple(array.shape) if array.shape else _SCALAR
    h5a.create(node.id, name.encode(), kind, space).write(array, mtype=kind)


def _text_attribute(texts: Any) -> NDArray[Any]:
    # HDF5 takes at most 64 KiB for an attribute
    return text_array(texts, 60_000 // (1 if isinstance(texts, str) else max(1, len(texts))))


def write_fields(node: Any, fields: Sequence[Field], record: Any) -> None:
    """Add attributes, one for each field of a record."""
    set_attributes(node, {field.name: _attribute(field, field.value(record)) for field in fields})


def _attribute(field: Field, value: Any) -> Any:
    if field.dtype == "integer":
        return np.int64(value) if -(2**63) <= value < 2**63 else str(value)
    return value if field.dtype == "text" else np.dtype(field.dtype).type(value)


def write_texts(group: Any, fields: Sequence[Field], record: Any) -> None:
    """Add a dataset of text or JSON for each field of a record."""
    for field in fields:
        value = field.value(record)
        text = dumps(value) if field.dtype == "json" else value
        dataset = group.create_dataset(field.name, data=text_array(text))
        kind = "application/json" if field.dtype == "json" else "text/plain"
        set_attributes(dataset, {"content_type": kind, "units": "", "description": field.description})


def write_values(group: Any, values: Mapping[str, Any], units: Mapping[str, str], description: str) -> None:
    """Add a dataset for each value: numbers and lists of numbers, texts, and JSON for all others."""
    names: list[str] = []
    for key, value in to_plain(values).items():
        names.append(link_name(key, names))
        attributes = {"address": key, "units": units.get(key, ""), "description": description}
        if _is_numeric(value):
            dataset = group.create_dataset(names[-1], data=value)
        else:
            text = value if isinstance(value, str) else dumps(value)
            dataset = group.create_dataset(names[-1], data=text_array(text))
            attributes["content_type"] = "text/plain" if isinstance(value, str) else "application/json"
        set_attributes(dataset, attributes)


def _is_numeric(value: Any) -> bool:
    """Whether an array holds a value as it is: a number, or a list of numbers of one type."""
    several: list[Any] = value if isinstance(value, list) else [value]
    is_one_type = {*map(type, several)} in ({bool}, {int}, {float})
    return is_one_type and all(type(item) is not int or -(2**63) <= item < 2**63 for item in several)


def write_array(group: Any, path: str, values: Any, units: str | None = None) -> Any:
    """Add an array of :data:`ARRAYS` under the last part of its path. ``units`` overrides the schema."""
    array = ARRAYS[path]
    dataset = group.create_dataset(path.rpartition("/")[2], data=np.asarray(values, array.dtype))
    describe(dataset, array, units)
    return dataset


def describe(dataset: Any, array: Dataset, units: str | None = None) -> None:
    """Add the attributes for the description, the unit and the axes of a dataset."""
    units = array.units if units is None else units
    set_attributes(dataset, {"units": units, "description": array.description, "dimensions": array.axes})


def write_table(group: Any, table: Table, rows: NDArray[Any], name: str = "") -> None:
    """Add a table of the schema under ``name``, or else under the last part of its path."""
    dataset = group.create_dataset(name or table.path.rpartition("/")[2], data=rows)
    units, descriptions = _of_known_columns(table) if table.columns else _of_columns(rows.dtype, table)
    add_attribute(dataset, "units", units)
    add_attribute(dataset, "descriptions", descriptions)
    set_attributes(dataset, {"description": table.description})


@cache  # the same for all shots
def _of_known_columns(table: Table) -> tuple[NDArray[Any], NDArray[Any]]:
    return _of_columns(np.dtype([(column.name, "?") for column in table.columns]), table)


def _of_columns(dtype: np.dtype[Any], table: Table) -> tuple[NDArray[Any], NDArray[Any]]:
    """Units and descriptions of the columns."""
    units, descriptions = map(_text_attribute, describe_columns(dtype, table))
    return units, descriptions


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
