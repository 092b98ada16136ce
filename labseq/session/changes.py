"""Differences in code, calibrations and settings between a run when it was begun and today."""

from __future__ import annotations

import json
import os
from collections.abc import Container, Iterator, Mapping
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from labseq.assembly.assemble import Assembly
from labseq.data.reader import Run
from labseq.model import RunRecord
from labseq.plain import dumps
from labseq.recording.run_file import encode_run
from labseq.session.provenance import code_of, run_record
from labseq.session.sources import archived_sources, read_sources

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
        return f"{self.what} was {self.was} and is now {self.now}"


def record_today(run: Run, assembly: Assembly, changes: Mapping[str, str]) -> RunRecord:
    """The record of a run if it were begun today.

    Args:
        run: The run as it was begun.
        assembly: The same run, assembled today.
        changes: Its changes by options, address -> value.
    """
    code = code_of(assembly, Path.cwd(), [plugin["name"] for plugin in run.record["plugins"]])
    return run_record(assembly, run.seed, changes, Path.cwd(), code)


def changes_between(run: Run, today: RunRecord) -> list[Change]:
    """The changes in code, plugins, calibrations and settings of a run.

    Args:
        run: The run as it was begun.
        today: The result of :func:`record_today`.
    """
    then, now = run.record, plain_record(today)
    plugins = {plugin["name"] for plugin in then["plugins"]}  # earlier versions of labseq recorded fewer
    return [
        *_differences(_made_with(then, plugins), _made_with(now, plugins), then["provenance"].get("folder")),
        *code_changes(run, today),
        *differences(then, today, "resolved"),
    ]


def code_changes(run: Run, today: RunRecord) -> list[Change]:
    """The changes in the sources of the plugins of a run, a line for each file."""
    changes, then = list[Change](), {plugin["name"]: plugin.get("sha256") for plugin in run.record["plugins"]}
    for plugin in today.plugins:
        name, was, now = plugin["name"], then.get(plugin["name"]), plugin["sha256"]
        if was in (None, now):  # earlier versions of labseq kept no digest
            continue
        if before := archived_sources(run.path, name):
            after = read_sources(Path(plugin["path"]))
            for file in sorted(file for file in {*before, *after} if before.get(file) != after.get(file)):
                changes.append(first_difference(f"plugin {name}: {file}", before.get(file), after.get(file)))
        else:  # labseq's own sources are not kept
            changes.append(Change(f"the code of {name}", f"SHA-256 {was[:12]}", now[:12]))
    return changes


def first_difference(file: str, before: bytes | None, after: bytes | None) -> Change:
    """The first line of a file that has changed."""
    if before is None or after is None:
        return Change(file, "missing" if before is None else "there", "missing" if after is None else "there")
    lines = [data.decode("utf-8", "surrogateescape").splitlines(keepends=True) for data in (before, after)]
    pairs = enumerate(zip_longest(*lines, fillvalue=""), 1)
    number, pair = next((number, pair) for number, pair in pairs if pair[0] != pair[1])
    stripped = tuple(line.strip() for line in pair)
    # lines may differ only in their indentation or their ends
    was, now = _around_difference(*(stripped if stripped[0] != stripped[1] else pair))
    return Change(f"{file}, line {number}", repr(was), repr(now))


def _around_difference(was: str, now: str) -> tuple[str, str]:
    """Two lines, with long lines cut to the part in which they begin to differ."""
    different = (i for i, (before, after) in enumerate(zip(was, now, strict=False)) if before != after)
    n_same = next(different, min(len(was), len(now)))
    start = max(0, n_same - _MAX_TEXT // 2) if max(len(was), len(now)) > _MAX_TEXT else 0
    return _cut(was[start:]), _cut(now[start:])


def differences(then: Mapping[str, Any], today: RunRecord, name: str) -> list[Change]:
    """The changes in one value of run.json, address by address."""
    before, after = (
        {address or name: value for address, value in _leaves(record.get(name, {}), "")}
        for record in (then, plain_record(today))
    )
    return _differences(before, after, then["provenance"].get("folder"))


def plain_record(record: RunRecord) -> dict[str, Any]:
    """A run's record as it is in run.json."""
    return json.loads(encode_run(record, ""))


def _made_with(record: Mapping[str, Any], plugins: Container[str]) -> dict[str, Any]:
    """Versions, code state, some plugins and the calibrations of a run, as name -> value."""
    provenance = record["provenance"]
    code = (provenance.get("git") or {}).get("code") or {}
    found = {"labseq": provenance.get("labseq"), "labseq's commit": code.get("commit")}
    if code.get("code_sha256"):
        found["labseq's uncommitted code"] = f"changes with the SHA-256 {code['code_sha256'][:12]}"
    for plugin in record["plugins"]:
        if plugin["name"] in plugins:
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
    return _cut(text)


def _cut(text: str) -> str:
    return text if len(text) <= _MAX_TEXT else f"{text[: _MAX_TEXT - 3]}..."


def _same(was: Any, now: Any, folder: Any) -> bool:
    """Whether two values are the same. Each path is relative to the working folder of its record."""
    if was == now:
        return True
    if not (isinstance(was, str) and isinstance(now, str) and isinstance(folder, str)):
        return False
    return os.path.normpath(Path(folder) / was) == os.path.normpath(Path.cwd() / now)
