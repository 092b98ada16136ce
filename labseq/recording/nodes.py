"""Attributes, texts and JSON in HDF5 groups, written and read back."""

from __future__ import annotations

import json
from collections.abc import Container, Mapping
from typing import Any, Final

import h5py
import numpy as np

from labseq.recording.plain import dumps, plain_text, to_plain

_MAX_ATTRIBUTE: Final = 256
_JSON: Final = "application/json"
_TEXT: Final = "text/plain"


def set_attributes(node: Any, /, **values: Any) -> None:
    """Set attributes of a group or dataset; text is made fit for HDF5."""
    for name, value in values.items():
        node.attrs[name] = plain_text(value) if isinstance(value, str) else value


def write_json(group: h5py.Group, name: str, value: object) -> None:
    """Add a dataset that holds a value as JSON."""
    _write_text(group, name, dumps(value), _JSON)


def _write_text(group: h5py.Group, name: str, text: str, content_type: str) -> None:
    dataset = group.create_dataset(name, data=text, dtype=h5py.string_dtype())
    set_attributes(dataset, content_type=content_type)


def read_json(group: Any, name: str) -> Any:
    """Read what :func:`write_json` wrote."""
    return json.loads(group[name][()])


def write_values(group: h5py.Group, values: Mapping[str, Any]) -> None:
    """Add values of any kind: short ones as attributes, the rest as datasets of text or JSON."""
    taken: set[str] = set()
    for key, value in values.items():
        plain = to_plain(value)
        name = link_name(key, taken)
        taken.add(name)
        if _fits_attribute(plain):
            set_attributes(group, **{name: plain})
        elif isinstance(plain, str):
            _write_text(group, name, plain_text(plain), _TEXT)
        else:
            write_json(group, name, plain)


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
