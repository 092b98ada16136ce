"""Reads HDF5 that labseq wrote, and refuses types that it would never write."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from h5py import h5a  # pyright: ignore[reportAttributeAccessIssue] - h5py ships no types
from numpy.typing import NDArray

from labseq.errors import RecordingError
from labseq.messages import install_hint
from labseq.plain import parse_value
from labseq.recording.check_hdf5 import check_type
from labseq.recording.schema import Field


def read_attribute(node: Any, name: str, default: Any = None) -> Any:
    """Read an attribute: a number, a text or a list of texts. ``default`` if it does not exist.

    Raises:
        ValueError: The attribute has a type that labseq does not use.
    """
    if not h5a.exists(node.id, name.encode()):
        return default
    array = _read(h5a.open(node.id, name.encode()))
    if array.dtype.kind == "S":
        return [text.decode() for text in array.tolist()] if array.shape else array.item().decode()
    return array.tolist()


def read_attributes(node: Any) -> dict[str, NDArray[Any]]:
    """All attributes of a group or dataset, texts as bytes."""
    opened = (h5a.open(node.id, index=i) for i in range(h5a.get_num_attrs(node.id)))
    return {attribute.name.decode(): _read(attribute) for attribute in opened}


def check_attributes(file: Any) -> None:
    """Refuse attributes that cannot be read.

    Raises:
        ValueError: An attribute has a type that labseq does not use.
    """
    names = ["/"]
    file.visit(names.append)
    for name in names:
        read_attributes(file[name])


def _read(attribute: Any) -> NDArray[Any]:
    kind = attribute.get_type()
    place = f"the attribute '{attribute.name.decode('utf-8', 'backslashreplace')}'"
    check_type(kind, place)
    n_bytes = math.prod(attribute.shape) * kind.get_size()
    if n_bytes >= 1 << 16:
        raise ValueError(f"{place} declares {n_bytes} bytes, more than an attribute can have")
    array = np.empty(attribute.shape, attribute.dtype)
    attribute.read(array, mtype=kind)
    return array


def read_fields(node: Any, fields: Sequence[Field]) -> dict[str, Any]:
    """Read attributes: attribute of the record -> plain value. Those of a newer minor format are ignored."""
    values: dict[str, Any] = {}
    for field in fields:
        # `values` itself marks a missing attribute
        value = read_attribute(node, field.name, values)
        if value is values:
            continue
        value = int(value) if field.dtype == "integer" else value
        if not isinstance(value, _KINDS[field.dtype]):
            raise TypeError(f"'{field.name}' is {type(value).__name__}; expected {field.dtype}")
        values[field.attribute] = value
    return values


_KINDS: Final = {"text": str, "integer": int, "int64": int, "bool": bool, "float64": float}


def read_texts(group: Any, fields: Sequence[Field]) -> dict[str, Any]:
    """Read texts and JSON: attribute of the record -> value. Those of a newer minor format are ignored.

    Raises:
        TypeError: JSON is not a mapping, or for plugins and steps not a list.
    """
    values: dict[str, Any] = {}
    for field in fields:
        if field.name not in group:
            continue
        text = group[field.name][()].decode()
        value = parse_value(text) if field.dtype == "json" else text
        kind = str if field.dtype == "text" else list if field.name in ("plugins", "steps") else dict
        if not isinstance(value, kind):
            raise TypeError(f"'{field.name}' is {type(value).__name__}; expected {kind.__name__}")
        values[field.attribute] = value
    return values


def read_values(group: Any) -> dict[str, Any]:
    """Read what :func:`labseq.recording.write_hdf5.write_values` wrote."""
    values: dict[str, Any] = {}
    for dataset in group.values():
        kind, value = read_attribute(dataset, "content_type"), dataset[()]
        if kind is None:
            value = value.tolist()
        else:
            value = parse_value(value) if kind == "application/json" else value.decode()
        values[str(read_attribute(dataset, "address"))] = value
    return values


def load_filter(path: Path, dataset: Any) -> None:
    """Load the HDF5 filter for a dataset if it is compressed.

    Raises:
        RecordingError: The dataset is compressed, and the package to read it is missing.
    """
    if dataset.id.get_create_plist().get_nfilters() == 0:
        return
    try:
        import hdf5plugin  # noqa: F401  # pyright: ignore[reportUnusedImport] - importing it registers the filter
    except ImportError as error:
        problem = "holds compressed frames, which need hdf5plugin to be read"
        raise RecordingError(path, problem, install_hint("compress")) from error
