"""Reads HDF5 that labseq wrote, and refuses what it would never write."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from h5py import h5a, h5d, h5g, h5l, h5o, h5t  # pyright: ignore[reportAttributeAccessIssue] - h5py ships no types
from numpy.typing import NDArray

from labseq.errors import RecordingError
from labseq.messages import install_hint
from labseq.plain import parse_value
from labseq.recording.schema import Field


def read_attribute(node: Any, name: str, default: Any = None) -> Any:
    """Read an attribute: a number, a text or a list of texts; ``default`` where there is none.

    Raises:
        ValueError: It has a type that labseq does not use.
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
        ValueError: One has a type that labseq does not use.
    """
    names = ["/"]
    file.visit(names.append)
    for name in names:
        read_attributes(file[name])


def _read(attribute: Any) -> NDArray[Any]:
    kind = attribute.get_type()
    place = f"the attribute '{attribute.name.decode('utf-8', 'backslashreplace')}'"
    _check_type(kind, place)
    n_bytes = math.prod(attribute.shape) * kind.get_size()
    if n_bytes >= 1 << 16:
        raise ValueError(f"{place} declares {n_bytes} bytes, more than an attribute can have")
    array = np.empty(attribute.shape, attribute.dtype)
    attribute.read(array, mtype=kind)
    return array


def read_fields(node: Any, fields: Sequence[Field]) -> dict[str, Any]:
    """Read attributes: attribute of the record -> plain value; those of a newer minor format are ignored."""
    values: dict[str, Any] = {}
    for field in fields:
        # `values` itself stands for an attribute that is missing
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
    """Read texts and JSON: attribute of the record -> value; those of a newer minor format are ignored."""
    texts = {field: group[field.name][()].decode() for field in fields if field.name in group}
    return {
        field.attribute: parse_value(text) if field.dtype == "json" else text for field, text in texts.items()
    }


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


MAX_OBJECTS: Final = 10_000
"""Largest number of groups and datasets in a shot's file."""

MAX_DEPTH: Final = 8
"""Deepest group in a shot's file."""

_FILTERS: Final = frozenset({1, 2, 3, 32000, 32001, 32004, 32008, 32015, 32026})
"""deflate, shuffle, fletcher32, LZF, Blosc, LZ4, bitshuffle, Zstd, Blosc2.

HDF5 loads a library for any other, which a hostile file could name.
"""


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
            if h5o.get_info(node).rc > 1:  # groups that contain each other would have no end
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
    if plist.get_layout() == h5d.CHUNKED:  # HDF5 reads a chunk as a whole, however small the dataset
        size = max(size, math.prod(plist.get_chunk()) * kind.get_size())
    filters = {plist.get_filter(i)[0] for i in range(plist.get_nfilters())}
    if not filters <= _FILTERS:
        raise ValueError(f"{place} has the filter {min(filters - _FILTERS)}, which labseq does not use")
    # frames shrink by less than 64; a dataset of up to 16 MiB may be as empty as it likes
    limit = max(1 << 24, 64 * n_bytes) if filters else n_bytes
    if size > limit:
        raise ValueError(f"{place} declares {size} bytes, and the file has {n_bytes}")
    return 0 if filters else size


def _check_type(kind: Any, place: str) -> None:
    """Refuse types that labseq does not use.

    References and sequences lead elsewhere in the file, or to the same place many times. Texts of variable
    length are read by HDF5 without an end if the part of the file that holds them is damaged.
    """
    if isinstance(kind, h5t.TypeCompoundID):
        for i in range(kind.get_nmembers()):
            _check_type(kind.get_member_type(i), place)
    elif isinstance(kind, h5t.TypeArrayID):
        _check_type(kind.get_super(), place)
    elif not isinstance(kind, h5t.TypeIntegerID | h5t.TypeFloatID | h5t.TypeStringID | h5t.TypeEnumID):
        raise ValueError(f"{place} has a type that labseq does not use")  # noqa: TRY004 - of the file
    elif isinstance(kind, h5t.TypeStringID) and kind.is_variable_str():
        raise ValueError(f"{place} is a text of variable length, which labseq does not use")


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
        problem = "holds compressed frames, and to read them hdf5plugin is needed"
        raise RecordingError(path, problem, install_hint("compress")) from error
