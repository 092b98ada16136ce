"""What stands in a shot's file, as Markdown tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from labseq.recording.schema import ATTRIBUTES, COLUMNS, DATASETS, EVERYWHERE, TABLES, units_of
from labseq_reference.known import UnknownNameError
from labseq_reference.tables import table


def datasets() -> list[str]:
    """A row per dataset."""
    rows = [
        (f"`/entry/{path}`", what.dtype, what.shape, what.units, what.meaning, what.since_version)
        for path, what in DATASETS.items()
    ]
    return table(
        ("path", "type", "axes", "unit", "meaning", "since_version"), rows, ("shot-file", "datasets")
    )


def columns() -> list[str]:
    """A table for each table of the file, with a row per column."""
    lines: list[str] = []
    for path, meanings in COLUMNS.items():
        units = dict(zip(meanings, units_of(TABLES[path]), strict=True))
        rows = [
            (f"`{name}`", _named(TABLES[path][name]), units[name], meaning)
            for name, meaning in meanings.items()
        ]
        lines += [f"`/entry/{path}`: {DATASETS[path].meaning}.", ""]
        lines += [*table(("column", "type", "unit", "meaning"), rows, ("shot-file", "columns")), ""]
    return lines


def attributes() -> list[str]:
    """A row per attribute: those of every dataset first."""
    rows = [("every dataset", f"`{name}`", "text", meaning) for name, meaning in EVERYWHERE.items()]
    for path, found in ATTRIBUTES.items():
        rows += [(f"`{path}`", f"`{name}`", kind, meaning) for name, (kind, meaning) in found.items()]
    return table(("of", "attribute", "type", "meaning"), rows, ("shot-file", "attributes"))


def _named(dtype: np.dtype[np.generic]) -> str:
    names: Mapping[str, str] = {"S": f"ascii, {dtype.itemsize} bytes", "O": "text"}
    return names.get(dtype.kind, dtype.name)


_PARTS: Final = {"datasets": datasets, "columns": columns, "attributes": attributes}


def part(name: str) -> list[str]:
    """One of the tables.

    Raises:
        UnknownNameError: There is no such part.
    """
    if name not in _PARTS:
        raise UnknownNameError(f"'{name}' is not one of {', '.join(_PARTS)}")
    return _PARTS[name]()
