"""A folder with a plugin whose scanner does what a test says, and a small sequence that uses it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import labseq

from .small_runs import PROFILE

PLUGIN = '''
"""Gives the points that its settings list, or something worse."""
import threading

from pydantic import Field
import labseq

LABSEQ_API = 1
SHOWN = []
BAD = {
    "nan": {"planner.degree_of_parallelism": float("nan")},
    "half": {"planner.degree_of_parallelism": 2.5},
    "other": {"planner.use": 3},
    "list": [3],
}


class Settings(labseq.plugin.Settings):
    dops: list[int] = Field(default=[], description="what it gives")
    then: str = Field(default="end", description="what it does after that")


class Scripted:
    def __init__(self, settings, space):
        if settings.then == "refuse":
            raise labseq.ConfigError("it does not want to")
        self.settings, self.space = settings, space

    def next_point(self, visited):
        SHOWN.append(visited)
        if len(visited) < len(self.settings.dops):
            return {"planner.degree_of_parallelism": self.settings.dops[len(visited)]}
        match self.settings.then:
            case "end":
                return None
            case "hang":
                threading.Event().wait()
            case "exit":
                raise SystemExit(3)
            case "raise":
                raise RuntimeError("no idea")
        return BAD[self.settings.then]


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.scanner("scripted", Scripted, Settings)
'''
SEQUENCE = """labseq: 1
name: scripted
profile: ./p.yaml
seed: 5
record_frames: none
plugin_folders: [plugins]
target: {pattern: compact, rows: 3, cols: 3}
planner: {use: psca, degree_of_parallelism: 2}
shot:
  - load: {duration: 500 ms}
  - image: {}
  - {name: sort, rearrange: {cycles: 1, window: 60 ms}}
  - image: {}
"""
N_LINES = SEQUENCE.count("\n")
OVER = "over: {planner.degree_of_parallelism: {from: 1, to: 9}}, maximise: filling_fraction"


def opened(folder: Path, scan: str, rest: str = "", **options: Any) -> labseq.Session:
    """A session with ``scan: {...}`` in its sequence."""
    (folder / "plugins").mkdir(exist_ok=True)
    (folder / "plugins" / "scripted.py").write_text(PLUGIN, "utf-8")
    (folder / "p.yaml").write_text(PROFILE, "utf-8")
    (folder / "s.yaml").write_text(f"{SEQUENCE}scan: {{{scan}}}\n{rest}", "utf-8")
    return labseq.Session.open(folder / "s.yaml", output=folder / "data", **options)


def run(folder: Path, scan: str, rest: str = "", **options: Any) -> labseq.Run:
    with opened(folder, scan, rest, **options) as session:
        return session.run()
