"""Which calibration of each kind is in use, since when, and which were before."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, cast

from labseq.calibrations.entry_file import damaged, read_object

ACTIVE_FILE: Final = "active.json"
FORMAT: Final = "labseq-active-calibrations"
FORMAT_VERSION: Final = "1.0"


@dataclass(frozen=True, slots=True)
class Activation:
    """From when on a calibration was in use.

    Attributes:
        kind: Its kind.
        id: Its id; "" for none: from then on, no calibration of this kind was in use.
        file: Name of its file in the store; "" for none.
        since_utc: ISO 8601, UTC.
    """

    kind: str
    id: str
    file: str
    since_utc: str


def read_history(folder: Path) -> list[Activation]:
    """Every activation, in order; of each kind the last one counts. None in a folder without a store.

    Raises:
        ConfigError: The file is damaged, or of a newer labseq.
    """
    path = folder / ACTIVE_FILE
    if not path.exists():
        return []
    content = read_object(path, FORMAT, FORMAT_VERSION)
    try:
        rows = cast("list[Mapping[str, Any]]", content["history"])
        history = [Activation(*(str(row[key]) for key in Activation.__slots__)) for row in rows]
    except (KeyError, TypeError) as error:
        raise damaged(path, f"its history cannot be read ({error!r})") from error
    if any(Path(one.file).name != one.file for one in history):
        raise damaged(path, "it names files outside of its folder")
    return history


def encode_history(history: list[Activation]) -> bytes:
    """The content of the file, with a line for each activation."""
    head = json.dumps({"format": FORMAT, "format_version": FORMAT_VERSION})
    rows = ",\n".join(f"  {json.dumps(asdict(one))}" for one in history)
    return f'{head[:-1]},\n "history": [\n{rows}\n ]\n}}\n'.encode()


def in_use(history: list[Activation]) -> dict[str, Activation]:
    """Kind -> its last activation, where that is not of none."""
    last = {one.kind: one for one in history}
    return {kind: one for kind, one in last.items() if one.id}
