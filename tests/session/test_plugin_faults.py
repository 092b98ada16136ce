"""Plugins whose code fails, or leaves, where labseq calls it before a run: named, and with their place."""

from __future__ import annotations

from pathlib import Path

import pytest

import labseq
from labseq.errors import ConfigError, LabseqError, PluginLoadError
from labseq.session.check import check
from labseq.testing.fakes import RecordingObserver

SEQUENCE = """labseq: 1
name: look
profile: ./p.yaml
shots: 1
target: {pattern: mine}
plugin_folders: [plugins]
shot:
  - mine: {size: 5}
"""

PROFILE = """labseq: 1
name: bench
grid: {rows: 2, cols: 2, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
detector: {use: threshold}
simulation: {use: virtual, image: {frame: [64, 64], centre_px: [31.5, 31.5]}}
"""

PLUGIN = """
import sys

import numpy as np
import pydantic

import labseq

LABSEQ_API = 1


class Settings(labseq.plugin.Settings):
    size: int

    @pydantic.field_validator("size")
    @classmethod
    def checked(cls, size):
        pass  # validator
        return size

    @pydantic.field_serializer("size")
    def written(self, size):
        pass  # serializer
        return size


class Look:
    needs_image = takes_image = False

    def __init__(self, settings):
        pass  # constructor

    def plan_timeline(self, context):
        pass  # timeline
        return []

    def run(self, shot):
        pass


def square(settings, grid):
    pass  # pattern
    fill = np.ones(grid.shape, bool)
    return labseq.TargetPattern(fill, ~fill)


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.step("mine", Look, Settings)
    registry.pattern("mine", square)
"""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write(PLUGIN)


def write(plugin: str, profile: str = PROFILE) -> None:
    Path("plugins").mkdir(exist_ok=True)
    Path("plugins/mine.py").write_text(plugin, encoding="utf-8")
    Path("p.yaml").write_text(profile, encoding="utf-8")
    Path("s.yaml").write_text(SEQUENCE, encoding="utf-8")


def test_the_plugin_is_right_as_it_is() -> None:
    assert check(labseq.Session.open("s.yaml")).warnings == ()


@pytest.mark.parametrize("error", ["sys.exit(0)", "raise KeyError('typo')"])
@pytest.mark.parametrize(
    ("where", "says"),
    [
        ("validator", "s.yaml:8:11: "),
        ("serializer", "s.yaml:8:11: plugin 'mine' failed to load: the settings of step 'mine' raised "),
        ("constructor", "s.yaml:8:11: plugin 'mine' failed to load: the constructor of step 'mine' raised "),
        ("pattern", "plugin 'mine' failed to load: pattern 'mine' raised "),
        ("timeline", "step 0 (mine) raised "),
    ],
)
def test_code_that_fails_is_named(where: str, says: str, error: str) -> None:
    write(PLUGIN.replace(f"pass  # {where}", error))
    with pytest.raises(LabseqError) as caught:
        check(labseq.Session.open("s.yaml"))
    raised = "SystemExit: 0" if "exit" in error else "KeyError: 'typo'"
    assert raised in str(caught.value)
    assert says in str(caught.value)
    line = 1 + PLUGIN[: PLUGIN.index(f"pass  # {where}")].count("\n")
    assert f"mine.py:{line})" in str(caught.value) or where in ("timeline", "validator")


def test_a_step_without_an_attribute_of_its_role_is_named() -> None:
    write(PLUGIN.replace("needs_image = takes_image = False", "needs_image = False"))
    with pytest.raises(
        ConfigError, match=r"s\.yaml:8:11: .*step 'mine' has no takes_image; see labseq\.plugin\.Step"
    ):
        labseq.Session.open("s.yaml")


def test_check_constructs_what_a_run_opens() -> None:
    write(PLUGIN, PROFILE.replace("simulation:", "# simulation:"))
    with pytest.raises(ConfigError, match=r"p\.yaml:\d:\d+: virtual hardware needs a simulation"):
        check(labseq.Session.open("s.yaml"))


def warnings_of_a_dry_run(camera: str) -> str:
    write(PLUGIN, PROFILE.replace("camera: {use: virtual}", f"camera: {{use: {camera}}}"))
    seen = RecordingObserver()
    session = labseq.Session.open("s.yaml", dry_run="full", observer=seen)
    return "\n".join(str(warning) for warning in check(session).warnings)


def test_a_dry_run_tells_why_a_plugin_failed_to_load() -> None:
    Path("plugins/cannon.py").write_text("LABSEQ_API = 1\nimport no_such_sdk\n", encoding="utf-8")
    text = warnings_of_a_dry_run("cannon")
    assert (
        "camera: plugin 'cannon' failed to load: ModuleNotFoundError: No module named 'no_such_sdk'" in text
    )
    assert "its virtual twin takes its place and its settings were not checked" in text
    text = warnings_of_a_dry_run("ixon")
    assert "plugin 'ixon' is not installed (plugin 'cannon' did not load (ModuleNotFoundError" in text


def test_a_dry_run_tells_of_a_plugin_that_is_not_there() -> None:
    assert "plugin 'ixon' is not installed; its virtual twin" in warnings_of_a_dry_run("ixon")


def test_a_dry_run_does_not_choose_between_two_plugins_of_one_name() -> None:
    register = "import labseq\nLABSEQ_API = 1\n@labseq.plugin.hookimpl\ndef labseq_register(registry):\n"
    for name in ("one", "two"):
        Path(f"plugins/{name}.py").write_text(f"{register}    registry.camera('ixon', print)\n", "utf-8")
    with pytest.raises((ConfigError, PluginLoadError), match="is offered by 'one' already"):
        warnings_of_a_dry_run("ixon")


def test_what_a_constructor_prints_is_a_warning() -> None:
    write(PLUGIN.replace("pass  # constructor", "print('hello')"))
    session = labseq.Session.open("s.yaml")
    (warning,) = check(session).warnings
    assert str(warning) == (
        f"plugin 'mine' ({Path('plugins/mine.py')}): in the constructor of step 'mine' it printed "
        "('hello'); this went to stderr: use 'logging.getLogger(__name__)'"
    )


def test_a_run_tells_of_the_plugins_that_it_uses() -> None:
    Path("plugins/unused.py").write_text(
        PLUGIN.replace('"mine"', '"unused"') + "\nprint('unused')\n", "utf-8"
    )
    write(PLUGIN + "\nprint('used')\n")
    seen = RecordingObserver()
    labseq.Session.open("s.yaml", observer=seen, output=Path("data")).run()
    (text,) = [values["text"] for name, values in seen.events if name == "warning"]
    assert "while it was loaded it printed ('used'); this went to stderr" in text
    (log,) = Path("data").glob("*/*/events.jsonl")
    assert "it printed ('used')" in log.read_text("utf-8")
    assert "unused" not in log.read_text("utf-8")


def test_patience_is_the_profiles() -> None:
    write(PLUGIN, PROFILE + "timeouts: {load: 12 s}\n")
    host = labseq.Session.open("s.yaml").assembly.bench.host
    assert host.get("step", "mine").owner.max_wait_s == 12.0


WRITES = """
class Writes:
    degree_of_parallelism = 1

    def __init__(self, settings, context):
        pass

    def plan(self, occupancy, target):
        print("planning")
        target.fill[0, 0] = True
        return labseq.Plan.from_batches([])


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.planner("writes", Writes)
"""


def test_a_planner_that_writes_to_its_target() -> None:
    Path("plugins/writes.py").write_text(f"import labseq\nLABSEQ_API = 1\n{WRITES}", "utf-8")
    Path("p.yaml").write_text(
        PROFILE.split("simulation", maxsplit=1)[0] + "simulation: {use: virtual}\n", "utf-8"
    )
    steps = "  - load: {}\n  - image: {}\n  - rearrange: {cycles: 1, window: 60 ms, stop_when: never}\n"
    sequence = SEQUENCE.replace("  - mine: {size: 5}\n", steps) + "planner: {use: writes}\n"
    Path("s.yaml").write_text(
        sequence.replace("pattern: mine", "pattern: compact, rows: 1, cols: 1"), "utf-8"
    )
    warnings = "\n".join(str(one) for one in check(labseq.Session.open("s.yaml")).warnings)
    assert "plan() raised ValueError: assignment destination is read-only" in warnings
    with pytest.raises(
        labseq.PlanError, match=r"planner 'writes': plan\(\) raised ValueError: assignment dest"
    ):
        labseq.Session.open("s.yaml", output=Path("data"), overrides=["seed=1"]).run()
