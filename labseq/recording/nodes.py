"""Attributes, texts and JSON in HDF5 groups, written and read back."""

from __future__ import annotations

import json
from collections.abc import Container, Mapping, Sequence
from typing import Any, Final

import h5py
import numpy as np
from h5py import h5a, h5s, h5t  # pyright: ignore[reportAttributeAccessIssue] - no stub knows h5a

from labseq.recording.described import DATASETS, DatasetDescription
from labseq.recording.plain import dumps, plain_text, to_plain

_MAX_ATTRIBUTE: Final = 256
_JSON: Final = "application/json"
_TEXT: Final = "text/plain"


_STRING: Final = h5py.string_dtype()
_STRING_TYPE: Final = h5t.py_create(_STRING, logical=True)
_SCALAR: Final = h5s.create(h5s.SCALAR)


def set_attributes(node: Any, /, **values: Any) -> None:
    """Add attributes to a group or dataset that has none of these names; text is made fit for HDF5."""
    for name, value in values.items():
        if isinstance(value, str):
            _add_text(node, name, np.array(plain_text(value), _STRING), _SCALAR)
        else:
            node.attrs[name] = value


def describe(dataset: Any, what: DatasetDescription) -> None:
    """Say in its attributes what a dataset is, and in what unit."""
    set_attributes(dataset, units=what.units, description=what.meaning)


def describe_columns(dataset: Any, units: Sequence[str], descriptions: Sequence[str]) -> None:
    """Say in the attributes of a table what each column is, and in what unit."""
    space = h5s.create_simple((len(units),))
    for name, texts in (("units", units), ("descriptions", descriptions)):
        _add_text(dataset, name, np.array(list(map(plain_text, texts)), _STRING), space)


def _add_text(node: Any, name: str, text: Any, space: Any) -> None:
    h5a.create(node.id, name.encode(), _STRING_TYPE, space).write(text)  # attrs[...] takes twice the time


def write_json(group: h5py.Group, name: str, value: object, what: DatasetDescription) -> None:
    """Add a dataset that holds a value as JSON."""
    _write_text(group, name, dumps(value), _JSON, what)


def _write_text(group: h5py.Group, name: str, text: str, content_type: str, what: DatasetDescription) -> None:
    dataset = group.create_dataset(name, data=text, dtype=_STRING)
    set_attributes(dataset, content_type=content_type)
    describe(dataset, what)


def read_json(group: Any, name: str) -> Any:
    """Read what :func:`write_json` wrote."""
    return json.loads(group[name][()])


def write_values(group: h5py.Group, values: Mapping[str, Any], kind: str) -> None:
    """Add values of any kind: short ones as attributes, the rest as datasets of text or JSON.

    Args:
        group: Where to.
        values: Name -> value.
        kind: What the group is called in :data:`labseq.recording.described.DATASETS`.
    """
    taken: set[str] = set()
    for key, value in values.items():
        plain = to_plain(value)
        name = link_name(key, taken)
        taken.add(name)
        if _fits_attribute(plain):
            set_attributes(group, **{name: plain})
            continue
        what = DATASETS.get(f"{kind}/{key}") or DATASETS[f"{kind}/<name>"]
        if isinstance(plain, str):
            _write_text(group, name, plain_text(plain), _TEXT, what)
        else:
            write_json(group, name, plain, what)


def read_values(group: Any) -> dict[str, Any]:
    """Read what :func:`write_values` wrote."""
    values = {name: plain_attribute(value) for name, value in group.attrs.items()}
    for name, dataset in group.items():
        text = dataset[()].decode()
        values[name] = json.loads(text) if dataset.attrs["content_type"] == _JSON else text
    return values


def plain_attribute(value: Any) -> Any:
    """An attribute as a plain Python value."""
    return value.item() if isinstance(value, np.generic) else value


def _fits_attribute(value: object) -> bool:
    if isinstance(value, str):
        return len(value) < _MAX_ATTRIBUTE and "\n" not in value
    return isinstance(value, (bool, float)) or (isinstance(value, int) and -(2**63) <= value < 2**63)


def link_name(name: str, taken: Container[str]) -> str:
    """A name that HDF5 takes, unlike those that are taken.

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
