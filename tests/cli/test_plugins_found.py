"""Every command finds plugins by the same search, and says what to add for one that it did not load."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

PLUGIN = """
from pathlib import Path

import labseq
from labseq.plugin import Planner, hookimpl

LABSEQ_API = 1
Path("code_ran").touch()


class Lazy(Planner):
    def __init__(self, settings, context): ...

    def plan(self, occupancy, target):
        return labseq.Plan.from_batches([])


@hookimpl
def labseq_register(registry):
    registry.planner("lazy", Lazy)
"""
SEQUENCE = """
labseq: 1
name: small
profile: virtual
shots: 1
target: {pattern: compact, rows: 2, cols: 2}
planner: {use: psca, degree_of_parallelism: 7}
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 1, window: 60 ms, exposure: 45 ms}
"""
OVERRIDE = ("--set", "planner={use: lazy}")
COMMANDS = (
    ("check", "sequences/s.yaml", *OVERRIDE),
    ("run", "sequences/s.yaml", "--dry-run=fast", *OVERRIDE),
    ("queue", "add", "sequences/s.yaml", *OVERRIDE),
    ("plan", "random:4x4@0.7", "--target={pattern: compact, rows: 2, cols: 2}", "--planner=lazy"),
    ("waveform", "random:4x4@0.7", "--target={pattern: compact, rows: 2, cols: 2}", "--planner=lazy"),
    ("bench", "planners", "--planners=lazy", "--loadings=2", "--workers=1"),
)


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LABSEQ_DATA", str(tmp_path / "data"))
    for folder, name, text in (("plugins", "mine.py", PLUGIN), ("sequences", "s.yaml", SEQUENCE)):
        Path(folder).mkdir()
        Path(folder, name).write_text(text, "utf-8")


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: " ".join(command[:2]))
def test_a_plugin_in_the_folder_is_advised_and_the_option_loads_it(
    call: Any, command: tuple[str, ...]
) -> None:
    code, _, err = call(*command)
    assert code == 2
    add = "add 'plugin_folders: [../plugins]' to s.yaml, or " if "sequences/s.yaml" in command else ""
    mine = Path("plugins", "mine.py")
    assert "unknown planner 'lazy'; expected one of" in err
    assert f"; {mine} offers it but is not loaded ({add}use --plugins plugins" in err
    assert not Path("code_ran").exists()
    _, _, err = call(*command, "--plugins", "plugins")
    assert Path("code_ran").exists()
    assert "unknown planner" not in err
    assert "LABSEQ_PLUGIN_PATH" not in os.environ


def test_the_list_of_plugins_runs_no_code_of_a_folder_that_nothing_names(call: Any) -> None:
    out = call("plugins", "--json")[1]
    found = {one["name"]: one for one in json.loads(out)["plugins"]}
    assert found["mine"]["state"] == "not loaded"
    assert found["mine"]["reason"].startswith("use --plugins plugins, or write ")
    assert "labseq_spcm_sim" not in found
    assert not Path("code_ran").exists()
    out = call("plugins", "--plugins", "plugins", "--json")[1]
    found = {one["name"]: one for one in json.loads(out)["plugins"]}
    assert (found["mine"]["state"], found["mine"]["offers"]) == ("loaded", ["planner:lazy"])


def test_settings_that_another_plugin_left_are_dropped_as_advised(call: Any) -> None:
    command = ("check", "sequences/s.yaml", "--plugins", "plugins", "--set")
    code, _, err = call(*command, "planner.use=lazy")
    assert code == 2
    assert "7:22: planner 'lazy' takes no settings, but 'degree_of_parallelism' is given; " in err
    assert 'use --set "planner={use: lazy}"' in err
    assert call(*command, "planner={use: lazy}")[0] == 0


def test_a_folder_that_does_not_exist_is_refused(call: Any) -> None:
    code, _, err = call("check", "sequences/s.yaml", "--plugins", "plugin")
    assert code == 2
    assert "'plugin' does not exist" in err
