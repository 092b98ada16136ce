"""Tables in a terminal of 80 columns."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import labseq

SEQUENCE = """
labseq: 1
name: screens
profile: virtual
seed: 1
record_frames: none
target: {pattern: compact, rows: 15, cols: 15}
scan: {planner.degree_of_parallelism: [3, 7], shot.2.rearrange.window: [60 ms, 100 ms]}
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 2, exposure: 45 ms}
  - image: {exposure: 45 ms}
"""


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that scans two addresses; its sequence is two folders above."""
    folder = tmp_path_factory.mktemp("screens")
    (folder / "s.yaml").write_text(SEQUENCE, "utf-8")
    with labseq.Session.open(folder / "s.yaml", output=folder / "data") as session:
        return session.run().path


@pytest.mark.parametrize(
    "command",
    [
        "show",
        "show --shots",
        "show --timing",
        "show --scan",
        "show --devices",
        "runs",
        "check",
        "plugins",
    ],
)
def test_no_word_and_no_number_is_broken(
    taken: Path, command: str, call: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(taken.parents[2])
    monkeypatch.setenv("LABSEQ_DATA", str(taken.parents[1]))
    arguments = command.split()
    arguments += {"check": ["s.yaml"], "show": ["screens"]}.get(arguments[0], [])
    _, wide, _ = call(*arguments)
    monkeypatch.setattr("shutil.get_terminal_size", lambda *_, **__: os.terminal_size((80, 24)))
    monkeypatch.setattr(type(sys.stdout), "isatty", lambda _: True)
    _, narrow, _ = call(*arguments)
    assert [line for line in narrow.splitlines() if len(line) > 80 and str(taken) not in line] == []
    if command == "check":  # it measures how long planning takes
        wide, narrow = (re.sub(r"\d+", "0", text) for text in (wide, narrow))
    words = [{*re.findall(r"[\w.,()\[\]-]+", text)} for text in (wide, narrow)]
    assert words[0] <= words[1]
