"""JSON schemas beside the files that an editor shall help with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

from labseq.config.file_schema import FileKind, file_schema
from labseq.files import whole_file
from labseq.registry import Registry

SCHEMA_FOLDER: Final = ".labseq"
"""Folder of the schemas, beside the sequences and profiles that name them."""

KINDS: Final[tuple[FileKind, ...]] = ("sequence", "profile")


def schema_text(kind: FileKind, registry: Registry) -> str:
    """The JSON schema of a kind of file, as text."""
    return json.dumps(file_schema(kind, registry), indent=1, ensure_ascii=False) + "\n"


def schema_path(kind: FileKind, folder: Path) -> Path:
    """Where the files of a folder look for their schema."""
    return folder / SCHEMA_FOLDER / f"{kind}.schema.json"


def write_schema(kind: FileKind, folder: Path, registry: Registry) -> Path:
    """Write the schema that files of this kind in a folder name in their first line.

    Raises:
        OSError: It cannot be written.
    """
    path = schema_path(kind, folder)
    path.parent.mkdir(exist_ok=True)
    with whole_file(path) as file:
        file.write(schema_text(kind, registry).encode())
    return path


def refresh_schemas(folder: Path, registry: Registry) -> list[Path]:
    """Write those schemas anew that a folder has, because there are other plugins now.

    Raises:
        OSError: One cannot be written.
    """
    return [write_schema(kind, folder, registry) for kind in KINDS if schema_path(kind, folder).is_file()]
