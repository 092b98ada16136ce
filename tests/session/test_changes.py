"""What has changed since a run was begun."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.errors import ConfigError
from labseq.session.changes import changes_between, first_difference, record_today
from labseq.testing.fakes import RecordingObserver

from .small_runs import SEQUENCE, changed, resumed, stopped, stopped_home

__all__ = ["stopped", "stopped_home"]


CHANGES: dict[str, tuple[Any, str]] = {
    "version": (lambda r: r["provenance"].update(labseq="0.0.1"), r"labseq was 0\.0\.1 and is now \d"),
    "commit": (
        lambda r: r["provenance"].update(git={"code": {"commit": "a" * 40, "dirty": False}}),
        r"labseq's commit was a+ and is now (null|[0-9a-f]{40})",
    ),
    "plugin": (lambda r: r["plugins"][0].update(version="7"), r"plugin .*: version was 7 and is now "),
    "setting": (
        lambda r: r["resolved"]["planner"].update(degree_of_parallelism=3),
        r"planner\.degree_of_parallelism was 3 and is now 7",
    ),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_is_refused(stopped: Path, name: str) -> None:
    change, message = CHANGES[name]
    changed(stopped, change)
    with pytest.raises(ConfigError, match=message) as caught:
        labseq.Session.resume(stopped)
    assert "--accept-changes" in str(caught.value)
    assert labseq.open_run(stopped).status == "stopped"


def test_changes_that_are_accepted_are_recorded(stopped: Path) -> None:
    for change, _ in CHANGES.values():
        changed(stopped, change)
    run = resumed(stopped, accept_changes=True)
    (once,) = run.record["resumed"]
    assert len(once["changes"]) >= len(CHANGES)
    assert once["changes"][0].keys() == {"what", "was", "now"}
    assert len(run.shots) == 6


def test_uncommitted_code_is_compared(stopped: Path) -> None:

    with labseq.Session.resume(stopped) as session:
        assert session.earlier is not None
        then = session.earlier.run
        today = record_today(then, session.assembly, session.options.changes())

    def changes(was: Any, now: Any) -> list[str]:
        then.record["provenance"]["git"]["code"] = was
        provenance = {**today.provenance, "git": {"code": now}}

        return [str(c) for c in changes_between(then, dataclasses.replace(today, provenance=provenance))]

    clean = {"commit": "a", "dirty": False, "code_sha256": ""}
    docs = {"commit": "a", "dirty": True, "code_sha256": ""}
    patched = {"commit": "a", "dirty": True, "code_sha256": "b" * 64}
    assert (
        changes(None, None)
        == changes(clean, clean)
        == changes(clean, docs)
        == changes(patched, patched)
        == []
    )
    for then_code, now_code, words in (
        (None, clean, r"commit was null and is now a"),
        (clean, {**clean, "commit": "b"}, r"commit was a and is now b"),
        (clean, patched, r"uncommitted code .*bbbbbbbbbbbb"),
    ):
        (change,) = changes(then_code, now_code)
        assert re.search(words, change)


@pytest.mark.parametrize(
    ("was", "now", "change"),
    [
        (b"if x:\n    y = 1\n", b"if x:\ny = 1\n", "line 2 was '    y = 1\\n' and is now 'y = 1\\n'"),
        (b"a\nb\n", b"a\r\nb\r\n", "line 1 was 'a\\n' and is now 'a\\r\\n'"),
        (b"-" * 70 + b"1", b"-" * 70 + b"2", f"was '{'-' * 30}1' and is now '{'-' * 30}2'"),
        (b"# \xb5", b"# \xe4", r"line 1 was '# \udcb5' and is now '# \udce4'"),
    ],
)
def test_the_first_line_that_differs_shows_the_difference(was: bytes, now: bytes, change: str) -> None:
    assert str(first_difference("core.py", was, now)).endswith(change)


def test_the_runs_own_texts_count(stopped: Path, tmp_path: Path) -> None:
    sequence, profile = tmp_path / "no_scan.yaml", tmp_path / "p.yaml"
    sequence.write_text(SEQUENCE.replace("SCAN", "shots: 3").replace("psca", "lsap"), encoding="utf-8")
    profile.unlink()
    seen = RecordingObserver()
    assert len(resumed(stopped, seen).shots) == 6
    (warning,) = [values["text"] for values in seen.of("warning")]
    assert str(sequence) in warning
