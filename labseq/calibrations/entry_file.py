"""A calibration as a JSON file, and back."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, cast

import labseq
from labseq.errors import ConfigError, Problem
from labseq.model import CalibrationEntry

FORMAT: Final = "labseq-calibration"
FORMAT_VERSION: Final = "1.0"
"""major.minor; a newer minor version only adds things, a newer major version cannot be read."""

SUFFIX: Final = ".json"
PICTURE_SUFFIX: Final = ".png"


def stem_of(entry: CalibrationEntry) -> str:
    """The name of its files without suffix: kind, UTC date and time, id.

    Example:
        >>> from labseq.model import SiteGrid, grid_facts
        >>> stem_of(CalibrationEntry("overlay", {"offset_m": [3e-8, 0.0]}, {}, grid_facts(SiteGrid()), {},
        ...                          "2026-11-20T09:05:00+01:00"))
        'overlay-20261120T080500Z-f102b3cd999c'
    """
    taken = datetime.fromisoformat(entry.taken_utc).astimezone(UTC)
    return f"{entry.kind}-{taken:%Y%m%dT%H%M%SZ}-{entry.id}"


def encode_entry(entry: CalibrationEntry) -> bytes:
    """The content of an entry's file; floats come back bit by bit."""
    quality = {name: value if math.isfinite(value) else None for name, value in entry.quality.items()}
    content = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "creator": f"labseq {labseq.__version__}",
        "kind": entry.kind,
        "id": entry.id,
        "taken_utc": entry.taken_utc,
        "grid": entry.grid,
        "origin": entry.origin,
        "quality": quality,
    }
    text = json.dumps(content, indent=1, default=str)
    values = ",\n".join(f"  {json.dumps(k)}: {json.dumps(v.tolist())}" for k, v in entry.values.items())
    return f'{text[:-2]},\n "values": {{\n{values}\n }}\n}}\n'.encode()


def read_entry(path: Path) -> CalibrationEntry:
    """Read an entry's file.

    Raises:
        ConfigError: It is missing, damaged, changed by hand, or of a newer labseq.
    """
    content = read_object(path, FORMAT, FORMAT_VERSION)
    try:
        quality = cast("Mapping[str, Any]", content["quality"])
        entry = CalibrationEntry(
            kind=content["kind"],
            values=content["values"],
            quality={name: math.nan if value is None else value for name, value in quality.items()},
            grid=content["grid"],
            origin=content["origin"],
            taken_utc=content["taken_utc"],
        )
    except KeyError as error:
        raise damaged(path, f"it has no {error}") from error
    except (ValueError, TypeError, AttributeError, OverflowError) as error:
        raise damaged(path, str(error)) from error
    if entry.id != content.get("id"):
        what = f"it says that its id is {content.get('id')}, but its content has the id {entry.id}"
        raise damaged(path, f"{what}: somebody changed it")
    return entry


def read_object(path: Path, file_format: str, version: str) -> dict[str, Any]:
    """Read a JSON object of a format of labseq's.

    Args:
        path: The file.
        file_format: Its key ``format``.
        version: The newest version that can be read.

    Raises:
        ConfigError: It is missing, no such object, or of a newer labseq.
    """
    try:
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise ConfigError(Problem(f"it cannot be read: {error.strerror}", str(path))) from error
    except (ValueError, RecursionError) as error:
        raise damaged(path, f"it is no JSON ({error})") from error
    if not isinstance(content, dict) or content.get("format") != file_format:
        raise damaged(path, f"it is not of the format '{file_format}'")
    came = str(content.get("format_version"))
    major = came.partition(".")[0]
    if not major.isdecimal():
        raise damaged(path, f"its format version is '{came}'")
    if int(major) > int(version.partition(".")[0]):
        what = f"its format version is {came}"
        raise ConfigError(Problem(what, str(path), expected=f"{version} or older", hint="update labseq"))
    return cast("dict[str, Any]", content)


def damaged(path: Path, why: str) -> ConfigError:
    """The error for a file that is not as it was written."""
    hint = "take it from a backup, or move it out of the way"
    return ConfigError(Problem(f"this file is damaged: {why}", str(path), hint=hint))
