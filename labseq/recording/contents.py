"""Everything that a shot's file may contain, from the schema, for the reference."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from labseq.recording.schema import (
    ARRAYS,
    ATOM_EVENTS,
    FORMAT,
    PARAMETER,
    RUN,
    RUN_TEXTS,
    SHOT,
    SHOT_TEXTS,
    TABLES,
    Dataset,
    Field,
)


def datasets_of_file() -> list[Dataset]:
    """Every dataset of a shot's file, in the order of the reference."""
    texts = [Dataset(text.name, _kind(text), "", text.description) for text in SHOT_TEXTS]
    texts += [Dataset(f"run/{text.name}", _kind(text), "", text.description) for text in RUN_TEXTS]
    tables = [Dataset(table.path, "table", table.row, table.description) for table in (*TABLES, ATOM_EVENTS)]
    return sorted((PARAMETER, *ARRAYS.values(), *tables, *texts), key=lambda dataset: dataset.path)


def _kind(field: Field) -> str:
    return {"json": "JSON text", "integer": "int64 or text"}.get(field.dtype, field.dtype)


_VIEWER: Final = ("text", "class, signal, axes or default plot for viewers (NeXus)")


def attributes() -> dict[str, dict[str, tuple[str, str]]]:
    """Every attribute of a shot's file except those of all datasets: path -> name -> type, description."""
    nexus = {
        "/entry": ("NX_class", "default"),
        "/entry/camera/<name>": ("NX_class",),
        "/entry/camera/<name>/frames": ("interpretation", "long_name"),
        "/entry/images_view": ("NX_class", "signal", "axes"),
        "/entry/detection": ("NX_class", "signal", "auxiliary_signals", "axes"),
        "/entry/detection/occupancy": ("interpretation",),
        "/entry/detection/confidence": ("interpretation",),
        "/entry/detection/signal": ("interpretation",),
    }
    root = {
        "format": ("text", FORMAT),
        "format_version": ("text", "major.minor, a newer minor version only adds values"),
        "creator": ("text", "labseq and its version"),
    }
    by_path = {"/": root | dict.fromkeys(("NX_class", "default"), _VIEWER)}
    by_path |= {path: dict.fromkeys(names, _VIEWER) for path, names in nexus.items()}
    for path, record_fields in (("/entry", SHOT), ("/entry/run", RUN)):
        by_path[path] = by_path.get(path, {}) | {
            field.name: (_kind(field), field.description) for field in record_fields
        }
    by_path[f"/entry/{PARAMETER.path}"] = {"address": ("text", "address of the setting")}
    by_path["/entry/camera/<name>"]["name"] = ("text", "name of the camera")
    return by_path


EVERYWHERE: Final[Mapping[str, str]] = {
    "units": "unit of the numbers, SI, px, adu or the detector's, empty for none, one for each column of a "
    "table",
    "dimensions": "names of the axes, for arrays only",
    "description": "what the dataset is",
    "descriptions": "what each column is, for tables only",
    "content_type": "application/json or text/plain, for texts only",
}
"""Attributes of every dataset."""
