"""What is known of a run before anything is opened."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import labseq
from labseq.errors import ConfigError, Problem, StopRequested
from labseq.session import check as checking
from labseq.session.check import CheckReport, check

ROOT = Path(__file__).parents[2]
COMPACT = ROOT / "sequences" / "compact_225.yaml"


def checked(*overrides: str, **options: Any) -> CheckReport:
    return check(labseq.Session.open(COMPACT, overrides=overrides, **options))


def test_a_good_sequence_has_no_warnings():
    report = checked()
    assert report.warnings == ()
    assert report.rehearsal is not None
    assert (report.rehearsal.n_loadings, report.rehearsal.n_filled) == (checking.N_LOADINGS,) * 2
    assert 0.02 < report.rehearsal.duration_s.mean() < 0.06
    assert report.n_images == 12
    assert report.shot_bytes == pytest.approx(12 * 2 * 512 * 512, rel=0.02)


def test_a_check_that_is_stopped_says_so_and_blames_no_device(monkeypatch: pytest.MonkeyPatch):
    session, ask_tweezers = labseq.Session.open(COMPACT), checking._PointCheck.ask_tweezers

    def stopping(one: Any, plans: Any) -> None:
        session.stop_flag.request(15)
        ask_tweezers(one, plans)

    monkeypatch.setattr(checking._PointCheck, "ask_tweezers", stopping)
    with pytest.raises(StopRequested):
        check(session)


def test_durations_span_from_no_cycle_to_all():
    report = checked("profile.camera.readout=0 s", shots=7)
    assert report.run_s == pytest.approx((7 * report.shortest_shot_s, 7 * report.longest_shot_s))
    assert report.shortest_shot_s == pytest.approx(0.5 + 2 * 0.045)
    assert report.longest_shot_s == pytest.approx(0.5 + 2 * 0.045 + 10 * (0.06 + 0.045))
    always = checked("profile.camera.readout=0 s", "shot.2.rearrange.stop_when=never")
    assert always.shortest_shot_s == pytest.approx(0.5 + 2 * 0.045 + 10 * 0.045)


def test_a_run_takes_as_long_as_the_check_predicts(tmp_path: Path):
    report = checked()
    with labseq.Session.open(COMPACT, shots=3, seed=3, output=tmp_path) as session:
        run = session.run()
    for shot in run.shots:
        end_s = max(t.t_start_s + t.duration_s for t in shot.timing)
        assert report.shortest_shot_s - 1e-9 <= end_s <= report.longest_shot_s + 1e-9
        assert report.shot_bytes is not None
        assert shot.file.stat().st_size <= report.shot_bytes * 1.02


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("shot.2.rearrange.window=30 ms", "too short for most plans"),
        (
            "shot.2.rearrange={cycles: 2, window: [60 ms, 10 ms]}",
            "a window of 10 ms ends before the first",
        ),
        ("profile.simulation.loading=0.5", "loadings have enough atoms for the target"),
        (
            "shot=[{load: {}}, {image: {}}, {rearrange: {cycles: 3}}]",
            "no image follows the last rearrangement",
        ),
        ("planner.degree_of_parallelism=700", "the profile allows 20 mobile tweezers at once"),
    ],
)
def test_what_runs_but_makes_little_sense_is_a_warning(override: str, message: str):
    (warning,) = checked(override).warnings
    assert message in str(warning)
    assert warning.source.startswith("--set") or not override.startswith("shot.2")


IMAGING = "imaging: {channel: 4, on: [image]}"
LINES = f"profile.lines={{use: virtual, channels: {{{IMAGING}, mot: {{channel: 3, on: [load]%s}}}}}}"
REAL = "profile.camera={use: genicam, camera: 10.0.0.7, region: {y: 0, x: 0, height: 512, width: 512}}"


@pytest.mark.parametrize(
    ("overrides", "messages"),
    [
        (
            [LINES % "", "profile.camera.em_gain=50"],
            ["'mot' is on during `load`, and the camera has an EM gain of 50"],
        ),
        ([LINES % ", blinding: false", "profile.camera.em_gain=50"], []),
        ([LINES % ""], []),
        ([REAL], ["nothing in this profile switches the imaging light"]),
        ([REAL, LINES % ""], []),
        ([REAL, "shot=[{load: {}}]"], []),
    ],
)
def test_light_that_nothing_switches_or_declares_is_a_warning(overrides: list[str], messages: list[str]):
    warnings = [str(warning) for warning in checked(*overrides).warnings]
    assert len(warnings) == len(messages)
    assert all(message in warning for message, warning in zip(messages, warnings, strict=True))


def test_a_run_gives_the_warnings_of_the_check_once(tmp_path: Path):
    class Seen:
        def event(self, name: str, values: Mapping[str, Any]) -> None:
            events.append(values["text"] if name == "warning" else name)

    events: list[str] = []
    wrong = "planner.degree_of_parallelism=100"
    with labseq.Session.open(
        COMPACT, shots=1, overrides=[wrong], output=tmp_path, observer=Seen()
    ) as session:
        session.run()
    (warning,) = map(str, checked(wrong).warnings)
    assert events.count(warning) == 1
    assert events.index(warning) < events.index("shot_started")


@pytest.mark.parametrize(
    ("scan", "message", "line_of"),
    [
        (
            "shot.2.rearrange.window: [60 ms, 10 ms, 12 ms, 70 ms, 1 ms]",
            "; at point 1 of the scan, and 2 others",
            "scan:",
        ),
        (
            "shot.1.image.exposure: [5 ms, 45 ms, 50 ms, 60 ms]",
            "its timeout of 40 ms; expected more than 50 ms",
            "timeout:",
        ),
        ("planner.degree_of_parallelism: [7, 40]", "at most 20 are used; at point 1 of the scan", "scan:"),
        ("profile.mobile_tweezers.speed: [130 um/ms, 1 um/ms]", "(0 of 20 fit)", "- rearrange:"),
    ],
)
def test_a_warning_is_given_once_for_a_scan(tmp_path: Path, scan: str, message: str, line_of: str):
    text = COMPACT.read_text("utf-8").replace("shots: 20\n", "")
    image = "- image: {exposure: 45 ms}\n"
    assert image in text
    text = text.replace(image, "- image: {exposure: 5 ms}\n    policy: {timeout: 40 ms}\n", 1)
    text += f"scan: {{{scan}}}\n"
    (tmp_path / "s.yaml").write_text(text, "utf-8")
    (warning,) = check(labseq.Session.open(tmp_path / "s.yaml")).warnings
    assert message in str(warning)
    assert line_of in text.splitlines()[warning.line - 1]


def test_a_rearrangement_is_rehearsed_where_the_one_before_it_ends():
    def repair(window: str) -> tuple[Problem, ...]:
        sort, image = "{rearrange: {cycles: 2}}", "{image: {}}"
        steps = f"{{load: {{}}}}, {image}, {sort}, {sort}, {{rearrange: {{window: {window}}}}}, {image}"
        return checked(f"shot=[{steps}]").warnings

    assert repair("25 ms") == ()  # on a random loading the median is 36 ms
    (warning,) = repair("10 ms")
    assert "too short for most plans" in warning.what


def test_moves_that_do_not_fit_into_a_window_are_left_to_the_next_rearrangement():
    windows = ", ".join(f"{{rearrange: {{cycles: 1, window: {window}}}}}" for window in ("1 ms", "25 ms"))
    found = checked(f"shot=[{{load: {{}}}}, {{image: {{}}}}, {windows}, {{image: {{}}}}]").warnings
    assert ["too short for most plans" in warning.what for warning in found] == [True, True]


def test_sequences_without_a_warning(tmp_path: Path):
    assert not checked("shot=[{load: {}}, {image: {}}, {rearrange: {cycles: 3, stop_when: never}}]").warnings
    assert checked("shot=[{image: {}}]").rehearsal is None


def test_the_disk_space_follows_the_frames_that_are_kept():
    sizes = [checked(f"record_frames={frames}").shot_bytes or 0 for frames in ("none", "last", "all")]
    assert np.diff(sizes).tolist() == [2 * 512**2, 11 * 2 * 512**2]
    assert 0 < sizes[0] < 150_000


@pytest.mark.parametrize(
    ("plan", "why"),
    [
        ("raise KeyError('typo')", "raised KeyError: 'typo'"),
        ("return Plan.from_batches([([(0, 0)], [(0, 99)])])", "batch 0"),
    ],
)
def test_a_planner_that_fails_is_an_error_that_can_be_seen(tmp_path: Path, plan: str, why: str):
    folder = tmp_path / "plugins"
    folder.mkdir()
    (folder / "broken.py").write_text(
        "import labseq\nfrom labseq.plugin import Plan\nLABSEQ_API = 1\n"
        "class Broken:\n"
        "    def __init__(self, settings, context): pass\n"
        f"    def plan(self, occupancy, target): {plan}\n"
        "@labseq.plugin.hookimpl\n"
        "def labseq_register(registry): registry.planner('broken', Broken)\n",
        encoding="utf-8",
    )
    text = COMPACT.read_text(encoding="utf-8")
    text = text.replace("{use: psca, degree_of_parallelism: 7}", "{use: broken}")
    path = tmp_path / "broken.yaml"
    path.write_text(text + "plugin_folders: [plugins]\n", encoding="utf-8")
    with pytest.raises(ConfigError) as refused:
        check(labseq.Session.open(path))
    (problem,) = refused.value.problems
    assert why in problem.what
    assert problem.line == next(i for i, line in enumerate(text.splitlines(), 1) if "broken" in line)
    assert "labseq plan random:20x20@0.75 --seed 0 --target" in problem.hint


STEPS = """
LABSEQ_API = 1
from labseq.plugin import Device, Step, TimelineEntry, hookimpl


class Shutter(Device):
    def open(self): ...
    def close(self): ...
    def safe_state(self): ...
    def describe(self): return {}
    def command(self, name, **arguments): ...
    def read(self, name): ...
    def check_command(self, name, *, power=1): ...


class Choosy(Step):
    def __init__(self, settings): ...
    def plan_timeline(self, context): return []
    def run(self, shot): ...
    def check_devices(self, devices, context): return None


@hookimpl
def labseq_register(registry):
    registry.device("clumsy", lambda settings, context: Shutter())
    registry.step("choosy", lambda settings: Choosy(settings))
"""


def test_a_driver_or_step_that_fails_to_check_a_step_has_the_place_of_the_step(tmp_path: Path):
    (tmp_path / "mine.py").write_text(STEPS, "utf-8")
    text = COMPACT.read_text("utf-8").partition("shot:")[0]
    text += f"plugin_folders: [{tmp_path.as_posix()}]\nshot:\n  - image: {{}}\n  - choosy: {{}}\n"
    text += "  - device: {name: shutter, do: open, arguments: {volts: 3}}\n"
    (tmp_path / "s.yaml").write_text(text, "utf-8")
    session = labseq.Session.open(tmp_path / "s.yaml", overrides=["profile.devices={shutter: {use: clumsy}}"])
    with pytest.raises(labseq.ConfigError) as caught:
        check(session)
    first, second = (str(problem) for problem in caught.value.problems)
    line = text[: text.index("- choosy")].count("\n") + 1
    assert f"s.yaml:{line}:13: check_devices() of step 'choosy' did not return a mapping" in first
    assert f"s.yaml:{line + 1}:33: shutter: check_command() raised TypeError" in second
    assert "'volts'" in second
