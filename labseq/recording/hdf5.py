"""Reads and writes HDF5: attributes, arrays, tables and texts with their descriptions and units."""

from __future__ import annotations

import json
from collections.abc import Container, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from h5py import h5a, h5s, h5t  # pyright: ignore[reportAttributeAccessIssue] - h5py ships no types
from numpy.typing import NDArray

from labseq.errors import RecordingError
from labseq.messages import install_hint
from labseq.plain import dumps, plain_text, to_plain
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
        found[field.attribute] = int(value) if field.dtype == "integer" else value
    return found


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
        field.attribute: json.loads(text) if field.dtype == "json" else text for field, text in texts.items()
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
            value = json.loads(value) if kind == "application/json" else value.decode()
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
