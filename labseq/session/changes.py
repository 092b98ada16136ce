"""Compares a run with its state at the start: code, plugins, calibrations and settings."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from labseq.model import RunRecord
from labseq.plain import dumps
from labseq.recording.run_file import encode_run

_MAX_TEXT: Final = 60


class Change(NamedTuple):
    """A difference between the run at its start and today.

    Attributes:
        what: The changed item, for example an address.
        was: Its value when the run was begun.
        now: Its value today.
    """

    what: str
    was: str
    now: str

    def __str__(self) -> str:
        return f"{self.what} was {self.was}, is {self.now}"


def changes_between(then: Mapping[str, Any], today: RunRecord) -> list[Change]:
    """The changes in code, plugins, calibrations and settings between two records of a run.

    Args:
        then: The run's run.json.
        today: The same run, assembled today.
    """
    folder, now = then["provenance"].get("folder"), _plain(today)
    return [
        *_differences(_made_with(then), _made_with(now), folder),
        *differences(then, today, "resolved"),
    ]


def differences(then: Mapping[str, Any], today: RunRecord, name: str) -> list[Change]:
    """The changes in one value of run.json, address by address."""
    before, after = (
        {address or name: value for address, value in _leaves(record.get(name, {}), "")}
        for record in (then, _plain(today))
    )
    return _differences(before, after, then["provenance"].get("folder"))


def _plain(record: RunRecord) -> dict[str, Any]:
    return json.loads(encode_run(record, ""))


def _made_with(record: Mapping[str, Any]) -> dict[str, Any]:
    """Versions, code state, plugins and calibrations of a run: name -> value."""
    provenance = record["provenance"]
    code = (provenance.get("git") or {}).get("code") or {}
    found = {"labseq": provenance.get("labseq"), "labseq's commit": code.get("commit")}
    if code.get("code_sha256"):
        found["labseq's uncommitted code"] = f"changes with the SHA-256 {code['code_sha256'][:12]}"
    for plugin in record["plugins"]:
        found |= {f"plugin {plugin['name']}: {key}": plugin[key] for key in ("origin", "version")}
    calibrations = record.get("calibrations") or {}
    return found | {f"the calibration in use of {kind}": entry for kind, entry in calibrations.items()}


def _differences(before: Mapping[str, Any], after: Mapping[str, Any], folder: Any) -> list[Change]:
    return [
        Change(name, _shown(before, name), _shown(after, name))
        for name in dict.fromkeys([*before, *after])
        if (name in before) != (name in after) or not _same(before[name], after[name], folder)
    ]


def _leaves(value: Any, address: str) -> Iterator[tuple[str, Any]]:
    """Each value of a tree of mappings and lists of mappings, with its address."""
    items: list[tuple[Any, Any]] = []
    if isinstance(value, dict):
        items = list(cast("dict[str, Any]", value).items())
    elif isinstance(value, list) and any(isinstance(one, dict) for one in cast("list[Any]", value)):
        items = list(enumerate(cast("list[Any]", value)))
    if not items:
        yield address, value
    for key, one in items:
        yield from _leaves(one, f"{address}.{key}" if address else str(key))


def _shown(values: Mapping[str, Any], name: str) -> str:
    if name not in values:
        return "nothing"
    text = values[name] if isinstance(values[name], str) else dumps(values[name])
    return text if len(text) <= _MAX_TEXT else f"{text[: _MAX_TEXT - 3]}..."


def _same(was: Any, now: Any, folder: Any) -> bool:
    """Whether two values are the same; each path is relative to the working folder of its record."""
    if was == now:
        return True
    if not (isinstance(was, str) and isinstance(now, str) and isinstance(folder, str)):
        return False
    return os.path.normpath(Path(folder) / was) == os.path.normpath(Path.cwd() / now)
