"""Plugins whose code fails, or leaves, where labseq calls it before a run: named, and with their place."""

from __future__ import annotations

from pathlib import Path

import pytest

import labseq
from labseq.errors import ConfigError, LabseqError, PluginLoadError
from labseq.session.check import check
from labseq.testing.fakes import RecordingObserver

from .small_runs import PROFILE

SEQUENCE = """labseq: 1
name: look
profile: ./p.yaml
shots: 1
target: {pattern: mine}
plugin_folders: [plugins]
shot:
  - mine: {size: 5}
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


class Look(labseq.plugin.Step):
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


EXIT, TYPO = "sys.exit(0)", "raise KeyError('typo')"


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write(PLUGIN)


def write(plugin: str, profile: str = PROFILE) -> None:
    Path("plugins").mkdir(exist_ok=True)
    Path("plugins/mine.py").write_text(plugin, encoding="utf-8")
    Path("p.yaml").write_text(profile, encoding="utf-8")
    Path("s.yaml").write_text(SEQUENCE, encoding="utf-8")


@pytest.mark.parametrize(
    ("where", "error", "says"),
    [
        ("validator", EXIT, "s.yaml:8:11: "),
        (
            "serializer",
            TYPO,
            "s.yaml:8:11: plugin 'mine' failed to load: the settings of step 'mine' raised ",
        ),
        (
            "constructor",
            EXIT,
            "s.yaml:8:11: plugin 'mine' failed to load: the constructor of step 'mine' rais",
        ),
        ("pattern", TYPO, "plugin 'mine' failed to load: pattern 'mine' raised "),
        ("timeline", EXIT, "step 0 (mine) raised "),
    ],
)
def test_code_that_fails_is_named(where: str, error: str, says: str) -> None:
    assert check(labseq.Session.open("s.yaml")).warnings == ()
    write(PLUGIN.replace(f"pass  # {where}", error))
    with pytest.raises(LabseqError) as caught:
        check(labseq.Session.open("s.yaml"))
    assert ("SystemExit: 0" if error == EXIT else "KeyError: 'typo'") in str(caught.value)
    assert says in str(caught.value)
    line = 1 + PLUGIN[: PLUGIN.index(f"pass  # {where}")].count("\n")
    assert f"mine.py:{line})" in str(caught.value)


IN_A_RUN = """
import labseq
from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq_virtual import camera, devices, simulation, tweezers
from labseq_virtual.settings import (
    CameraSettings, DeviceSettings, LinesSettings, MobileTweezersSettings, SimulationSettings,
    StaticTweezersSettings,
)

LABSEQ_API = 1


def typo(*_, **__):
    raise KeyError("typo")


class Camera(camera.VirtualCamera):
    def read(self, timeout_s):
        typo(timeout_s)


class Static(tweezers.VirtualStaticTweezers):
    def start(self):
        typo()


class Mobile(tweezers.VirtualMobileTweezers):
    def play(self):
        typo()


class Lines(devices.VirtualLines):
    def fire(self):
        typo()


class Gauge(devices.VirtualDevice):
    def command(self, name, **arguments):
        typo()


class Atoms(simulation.VirtualSimulation):
    def load(self, t_start_s, duration_s):
        typo()


class Detector(ThresholdDetector):
    def signals(self, frame):
        typo()


class Planner:
    def __init__(self, settings, context):
        pass

    def plan(self, occupancy, target):
        typo()


class Scanner:
    def __init__(self, settings, space):
        pass

    def next_point(self, visited):
        typo()


class Look:
    def __init__(self, settings, context):
        pass

    def shot(self, shot):
        typo()


class Step(labseq.plugin.Step):
    def __init__(self, settings):
        pass

    def plan_timeline(self, context):
        return []

    def run(self, shot):
        typo()


class Nothing(labseq.plugin.Settings):
    pass


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.camera("bad", Camera, CameraSettings, virtual_time=True)
    registry.static_tweezers("bad", Static, StaticTweezersSettings, virtual_time=True)
    registry.mobile_tweezers("bad", Mobile, MobileTweezersSettings, virtual_time=True)
    registry.lines("bad", Lines, LinesSettings, virtual_time=True)
    registry.device("bad", Gauge, DeviceSettings, virtual_time=True)
    registry.simulation("bad", Atoms, SimulationSettings)
    registry.detector("bad", Detector, ThresholdSettings)
    registry.planner("bad", Planner, Nothing)
    registry.scanner("bad", Scanner, Nothing)
    registry.analysis("bad", Look, Nothing)
    registry.step("bad", Step, Nothing)


@labseq.plugin.hookimpl
def labseq_shot_finished(shot):
    typo()
"""
"""One plugin of each kind, which fails in its own code in a shot."""
WHOLE = """labseq: 1
name: whole
profile: ./p.yaml
target: {pattern: compact, rows: 3, cols: 3}
plugin_folders: [plugins]
planner: {use: psca}
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 1, window: 60 ms, exposure: 45 ms}
"""


@pytest.mark.parametrize(
    "change",
    [
        "profile.camera.use=bad",
        "profile.static_tweezers.use=bad",
        "profile.mobile_tweezers.use=bad",
        "profile.lines={use: bad, channels: {light: {channel: 3, on: [image]}}}",
        "shot.0={device: {name: gauge, do: go}}",
        "profile.simulation.use=bad",
        "profile.detector.use=bad",
        "planner={use: bad}",
        "scan={use: bad, points: 2, maximise: filling, over: {shot.0.load.duration: {from: 1 ms, to: 5 ms}}}",
        "analysis=[{use: bad, finish_within: 60 s}]",
        "shot.0={bad: {}}",
        "name=watched",  # the hook of an observer alone
    ],
)
def test_code_of_each_kind_that_fails_in_a_run_is_named_with_its_line(change: str) -> None:
    write(IN_A_RUN, PROFILE + "devices: {gauge: {use: bad}}\n")
    Path("s.yaml").write_text(WHOLE, encoding="utf-8")
    seen, message, one_shot = RecordingObserver(), "", [] if "scan" in change else ["shots=1"]
    with labseq.Session.open(
        # the target of some seeds is full before anything moves
        "s.yaml",
        seed=1,
        overrides=[change, *one_shot],
        observer=seen,
        output=Path("data"),
    ) as session:
        try:
            session.run()
        except LabseqError as error:
            message = str(error)
    messages = [message, *(values["text"] for name, values in seen.events if name == "warning")]
    line = 1 + IN_A_RUN[: IN_A_RUN.index("raise KeyError")].count("\n")
    if change != "name=watched":
        messages = [text for text in messages if "observer hook" not in text]
    assert any(f"KeyError: 'typo' ({Path('plugins/mine.py').absolute()}:{line})" in text for text in messages)


def test_a_step_without_the_base_class_of_its_role_is_named() -> None:
    write(PLUGIN.replace("class Look(labseq.plugin.Step):", "class Look:"))
    with pytest.raises(
        ConfigError, match=r"s\.yaml:8:11: .*a Look, which is not derived from Step; see labseq\.plugin\.Step"
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


def test_a_dry_run_reports_why_a_plugin_failed_to_load() -> None:
    Path("plugins/cannon.py").write_text("LABSEQ_API = 1\nimport no_such_sdk\n", encoding="utf-8")
    text = warnings_of_a_dry_run("cannon")
    assert (
        "camera: plugin 'cannon' failed to load: ModuleNotFoundError: No module named 'no_such_sdk'" in text
    )
    assert "its virtual twin is used instead, and its settings were not checked" in text
    text = warnings_of_a_dry_run("ixon")
    assert "plugin 'ixon' is not installed (plugin 'cannon' did not load (ModuleNotFoundError" in text


def test_a_dry_run_does_not_choose_between_two_plugins_of_one_name() -> None:
    register = "import labseq\nLABSEQ_API = 1\n@labseq.plugin.hookimpl\ndef labseq_register(registry):\n"
    for name in ("one", "two"):
        Path(f"plugins/{name}.py").write_text(f"{register}    registry.camera('ixon', print)\n", "utf-8")
    with pytest.raises((ConfigError, PluginLoadError), match="is already offered by 'one'"):
        warnings_of_a_dry_run("ixon")


def test_a_run_warns_of_what_its_own_plugins_print() -> None:
    Path("plugins/unused.py").write_text(
        PLUGIN.replace('"mine"', '"unused"') + "\nprint('unused')\n", "utf-8"
    )
    write(PLUGIN + "\nprint('used')\n")
    seen = RecordingObserver()
    labseq.Session.open("s.yaml", observer=seen, output=Path("data")).run()
    (text,) = [values["text"] for name, values in seen.events if name == "warning"]
    assert "while it was loaded it printed 'used' to stderr" in text
    (log,) = Path("data").glob("*/*/events.jsonl")
    assert "it printed 'used'" in log.read_text("utf-8")
    assert "unused" not in log.read_text("utf-8")
