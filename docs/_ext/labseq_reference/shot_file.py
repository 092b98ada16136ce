"""What a shot's file holds, as Markdown tables built from the schema."""

from __future__ import annotations

from typing import Final

from labseq.recording import schema
from labseq_reference.known import UnknownNameError
from labseq_reference.tables import table


def datasets() -> list[str]:
    """A row per dataset."""
    rows = [
        (f"`/entry/{one.path}`", one.dtype, one.axes, one.units, one.description) for one in schema.datasets()
    ]
    return table(("path", "type", "axes", "unit", "description"), rows, ("shot-file", "datasets"))


def columns() -> list[str]:
    """A table for each table of the file, with a row per column."""
    lines: list[str] = []
    for one in schema.TABLES:
        rows = [
            (f"`{of.name}`", _TYPES.get(of.dtype, of.dtype), of.units, of.description) for of in one.columns
        ]
        lines += [f"`/entry/{one.path}`: {one.description}.", ""]
        lines += [*table(("column", "type", "unit", "description"), rows, ("shot-file", "columns")), ""]
    return lines


def attributes() -> list[str]:
    """A row per attribute: those of every dataset first."""
    rows = [("every dataset", f"`{name}`", "text", about) for name, about in schema.EVERYWHERE.items()]
    for path, found in schema.attributes().items():
        rows += [(f"`{path}`", f"`{name}`", kind, about) for name, (kind, about) in found.items()]
    return table(("of", "attribute", "type", "description"), rows, ("shot-file", "attributes"))


def index() -> list[str]:
    """A row per value that a shot's line in the index has of the shot's record."""
    rows = [(f"`{field.name}`", field.dtype, field.description) for field in schema.SHOT if field.in_index]
    return table(("key", "type", "description"), rows, ("shot-file", "index"))


_TYPES: Final = {"i2": "int16", "i4": "int32", "f8": "float64", "?": "bool"}
_PARTS: Final = {"datasets": datasets, "columns": columns, "attributes": attributes, "index": index}


def part(name: str) -> list[str]:
    """One of the tables.

    Raises:
        UnknownNameError: There is no such part.
    """
    if name not in _PARTS:
        raise UnknownNameError(f"'{name}' is not one of {', '.join(_PARTS)}")
    return _PARTS[name]()
