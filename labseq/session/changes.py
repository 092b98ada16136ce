"""What differs between a run as it was begun and the same run put together today."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from labseq.model import RunRecord
from labseq.recording.plain import dumps
from labseq.recording.run_file import encode_run

_NOTHING: Final = "nothing"
_UNKNOWN: Final = "unknown"


class Change(NamedTuple):
    """One thing that differs.

    Attributes:
        what: What it is, for example an address.
        was: When the run was begun.
        now: Today.
    """

    what: str
    was: str
    now: str

    def __str__(self) -> str:
        return f"{self.what} was {self.was}, is {self.now}"


def changes_between(then: Mapping[str, Any], today: RunRecord) -> list[Change]:
    """What of the code, the plugins and the settings differs.

    Args:
        then: The run's run.json.
        today: The same run, put together today.
    """
    now = _plain(today)
    before, after = then["provenance"], now["provenance"]
    changes = _versions("labseq", before.get("labseq"), after.get("labseq"))
    changes += _code((before.get("git") or {}).get("code"), (after.get("git") or {}).get("code"))
    changes += _plugins(then["plugins"], now["plugins"], before.get("folder"))
    changes += _values("the calibrations in use", then.get("calibrations", {}), now["calibrations"])
    return changes + differences(then, today, "resolved")


def differences(then: Mapping[str, Any], today: RunRecord, name: str) -> list[Change]:
    """What differs in one field of run.json, address by address."""
    before, after = dict(_leaves(then.get(name, {}), "")), dict(_leaves(_plain(today)[name], ""))
    folder = then["provenance"].get("folder")
    return [
        Change(address or name, _shown(before, address), _shown(after, address))
        for address in dict.fromkeys([*before, *after])
        if not _same(before.get(address, _NOTHING), after.get(address, _NOTHING), folder)
    ]


def _plain(record: RunRecord) -> dict[str, Any]:
    return json.loads(encode_run(record, ""))


def _versions(what: str, was: Any, now: Any) -> list[Change]:
    return [] if was == now else [Change(what, str(was), str(now))]


def _code(was: Mapping[str, Any] | None, now: Mapping[str, Any] | None) -> list[Change]:
    """What git knows of labseq's own code: the commit, and what of it was not committed."""
    if was is None or now is None:
        return _values("labseq's commit", was and was.get("commit"), now and now.get("commit"))
    if was.get("commit") != now.get("commit"):
        return [Change("labseq's commit", str(was.get("commit"))[:12], str(now.get("commit"))[:12])]
    before, after = _uncommitted(was), _uncommitted(now)
    if before == after != _UNKNOWN:
        return []
    what = "labseq's code without a commit"
    return [Change(what, _code_text(before), _code_text(after))]


def _uncommitted(state: Mapping[str, Any]) -> str:
    """What stands for changes of the code that are not committed; "" for none."""
    if not state.get("dirty"):
        return ""
    return str(state.get("code_sha256", _UNKNOWN))


def _code_text(uncommitted: str) -> str:
    if uncommitted == _UNKNOWN:
        return "something that nobody can compare"
    return f"changed in a way known as {uncommitted[:12]}" if uncommitted else "as committed"


def _plugins(was: Any, now: Any, folder: Any) -> list[Change]:
    before, after = ({one["name"]: one for one in plugins} for plugins in (was, now))
    changes: list[Change] = []
    for name in dict.fromkeys([*before, *after]):
        old, new = before.get(name, {}), after.get(name, {})
        for key in ("origin", "version"):
            if not _same(old.get(key, _NOTHING), new.get(key, _NOTHING), folder):
                told = [str(one.get(key, _NOTHING)) or _NOTHING for one in (old, new)]
                changes.append(Change(f"plugin {name}: {key}", *told))
    return changes


def _values(what: str, was: Any, now: Any) -> list[Change]:
    return [] if was == now else [Change(what, dumps(was), dumps(now))]


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


def _shown(values: Mapping[str, Any], address: str) -> str:
    if address not in values:
        return _NOTHING
    text = dumps(values[address])
    return text if len(text) <= 60 else f"{text[:57]}..."


def _same(was: Any, now: Any, folder: Any) -> bool:
    """Whether two values are the same; paths count from the working folder of then."""
    if was == now:
        return True
    if not (isinstance(was, str) and isinstance(now, str) and isinstance(folder, str)):
        return False
    return os.path.normpath(Path(folder) / was) == os.path.normpath(Path.cwd() / now)
