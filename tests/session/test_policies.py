"""Runs whose shots fail, and go on as their policies say."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.errors import CheckFailedError, ConfigError
from labseq.session.check import check
from labseq.testing.fakes import RecordingObserver

from .small_runs import Interrupting, interrupted, resumed, table, write

PLUGIN = '''
"""A step that fails at some shots."""

from labseq.plugin import DeviceError, Duration, Settings, Step, hookimpl

LABSEQ_API = 1


class Failing(Settings):
    """Where."""

    at: list[int] = []
    gain: int = 1


class FailingStep(Step):
    """Fails."""

    repeatable = True

    def __init__(self, settings):
        self.at = settings.at

    def plan_timeline(self, context):
        return []

    def run(self, shot):
        shot.note("laser.power_w", 0.1 * shot.index)
        if shot.index in self.at:
            raise DeviceError("laser", "went out of lock")


@hookimpl
def labseq_register(registry):
    registry.step("failing", FailingStep, Failing)
'''


def sequence(home: Path, scan: str = "no scan", step: str = "{}", **keys: Any) -> Path:
    """A small sequence with a step that may fail; keys are added at the top."""
    path = write(home, scan)
    (home / "mine").mkdir(exist_ok=True)
    (home / "mine" / "failing.py").write_text(PLUGIN, encoding="utf-8")
    text = path.read_text(encoding="utf-8").replace("\nshot:\n", f"\nshot:\n  - failing: {step}\n")
    text += "plugin_folders: [mine]\n" + "".join(f"{k}: {json.dumps(v)}\n" for k, v in keys.items())
    path.write_text(text, encoding="utf-8")
    return path


def run(path: Path, observer: Any = None) -> labseq.Run:
    output = path.parent / "data"
    with labseq.Session.open(path, seed=5, output=output, observer=observer) as session:
        return session.run()


def test_a_shot_that_fails_again_and_again_is_skipped_and_the_run_complete(tmp_path: Path) -> None:
    policy = {"on_failure": "repeat_shot", "when_exhausted": "skip_point"}
    seen = RecordingObserver()
    done = run(sequence(tmp_path, step="{at: [2]}", attempts=2, policy=policy), seen)
    assert done.status == "complete"
    assert [shot.index for shot in done.shots] == [0, 1, 3, 4, 5]
    assert [(shot.index, shot.attempt) for shot in done.attempts] == [(2, 0), (2, 1)]
    assert done.skipped == {2: "DeviceError: laser: went out of lock"}
    (warning,) = seen.of("warning")
    assert re.match(r"shot 2 .*laser: went out of lock", warning["text"])
    assert done.summary()["skipped"] == 1
    with pytest.raises(ConfigError, match="it is complete"):
        labseq.Session.resume(done.path)


def test_the_rest_of_a_point_is_skipped_with_it(tmp_path: Path) -> None:
    step = "{at: [1]}\n    policy: {on_failure: skip_point}"
    path = sequence(tmp_path, "planner", step)
    done = run(path)
    points = done.record["scan"]["point_of_shot"]
    left_out = [shot for shot in range(6) if shot == 1 or (shot > 1 and points[shot] == points[1])]
    assert sorted(done.skipped) == left_out
    assert [shot.index for shot in done.shots] == [shot for shot in range(6) if shot not in left_out]


CHECKS = [{"value": "reading.laser.power_w", "at_least": 0.15, "shots": 2, "then": "skip_point"}]


@pytest.mark.parametrize(
    ("scan", "step", "policy", "event", "n"),
    [
        ("planner", "{at: [1]}", {"on_failure": "skip_point"}, "shot_started", 3),
        ("planner", "{}", {"checks": CHECKS}, "shot_started", 2),
        ("adaptive", "{}", {"checks": CHECKS}, "shots_skipped", 1),
    ],
)
def test_a_resumed_run_skips_what_was_skipped(
    tmp_path: Path, scan: str, step: str, policy: dict[str, Any], event: str, n: int
) -> None:
    path = sequence(tmp_path, scan, step, policy=policy)
    text = path.read_text(encoding="utf-8").replace("shot.2", "shot.3").replace("repeats: 2", "repeats: 3")
    path.write_text(text, encoding="utf-8")
    whole = run(path)
    assert whole.skipped
    run_dir = interrupted(path, event, n)
    assert labseq.open_run(run_dir).status == "stopped"
    if event == "shots_skipped":  # as if it had died before it recorded what to skip
        (run_dir / "skipped.jsonl").unlink()
    again = resumed(run_dir)
    assert (again.status, again.skipped) == ("complete", whole.skipped)
    assert table(again) == table(whole)


def test_a_check_between_shots_warns_or_stops(tmp_path: Path) -> None:
    checks = [
        {"value": "reading.laser.power_w", "at_most": 0.25, "shots": 2, "then": "stop"},
        {"value": "filling_fraction", "at_least": 2},
    ]
    seen = RecordingObserver()
    path = sequence(tmp_path, policy={"checks": checks})
    with pytest.raises(
        CheckFailedError, match=r"power_w is 0\.35 .* last 2 shots; .*at most 0\.25"
    ) as caught:
        run(path, seen)
    assert (caught.value.value, caught.value.exit_code) == ("reading.laser.power_w", 3)
    warnings = [event["text"] for event in seen.of("warning")]
    assert len(warnings) == 4  # one a shot, before the run ends
    assert "it should be at least 2" in warnings[0]
    (folder,) = [path.parent for path in (tmp_path / "data").rglob("run.json")]
    stopped = labseq.open_run(folder)
    assert (stopped.status, stopped.error) == ("failed", f"CheckFailedError: {caught.value}")
    assert len(stopped.shots) == 5


def test_a_check_of_a_mean_waits_for_all_of_its_shots_each_time(tmp_path: Path) -> None:
    """The laser's power is a tenth of the number of the shot."""
    power: dict[str, Any] = {"value": "reading.laser.power_w", "at_least": 9, "then": "warn"}
    seen = RecordingObserver()
    run(sequence(tmp_path, policy={"checks": [{**power, "shots": n} for n in (2, 4, 7)]}), seen)
    found = [
        re.match(r"shot (\d): reading.laser.power_w is ([\d.]+) on the mean of the last (\d)", event["text"])
        for event in seen.of("warning")
    ]
    expected = [("1", "0.05", "2"), ("3", "0.25", "2"), ("3", "0.15", "4"), ("5", "0.45", "2")]
    assert [one and one.groups() for one in found] == expected


def test_a_policy_of_a_step_replaces_that_of_the_run(tmp_path: Path) -> None:
    step = "{}\n    policy: {timeout: 2 s, retries: 1, over_budget: stop}"
    path = sequence(tmp_path, step=step, policy={"over_budget": "warn", "on_failure": "repeat_shot"})
    assembly = labseq.Session.open(path).assembly
    own, other, *_ = assembly.policy.steps
    assert (own.timeout_s, own.retries, own.over_budget, own.on_failure) == (2.0, 1, "stop", "repeat_shot")
    assert (other.retries, other.over_budget) == (0, "warn")
    assert assembly.resolved["shot"][0]["policy"] == {"timeout": 2.0, "retries": 1, "over_budget": "stop"}
    assert "policy" not in assembly.resolved["shot"][1]
    assert assembly.resolved["policy"]["over_budget"] == "warn"


def test_a_timeout_shorter_than_the_step_is_a_warning(tmp_path: Path) -> None:
    path = write(tmp_path)
    text = path.read_text(encoding="utf-8").replace(
        "- load: {duration: 500 ms}", "- load: {duration: 500 ms}\n    policy: {timeout: 400 ms}"
    )
    path.write_text(text, encoding="utf-8")
    with labseq.Session.open(path) as session:
        reported = [str(problem) for problem in check(session).warnings]
    (warning,) = [text for text in reported if text.startswith(f"{path}:10:23: ")]
    assert "timeout of 400 ms" in warning
    assert "more than 500 ms" in warning


@pytest.mark.parametrize(
    ("step", "keys", "message"),
    [
        ("{}\n    policy: {retry: 1}", {}, "10:14: 'retry' is not a setting of the policy of 'failing'"),
        ("{}\n    policy: {timeout: 0 s}", {}, "10:23: timeout is '0 s'; expected more than 0"),
        ("{}", {"policy": {"checks": [{"value": "x"}]}}, "the check has no limit; expected 'at_least'"),
        (
            "{}",
            {"policy": {"checks": [{"value": "x", "at_least": 2, "at_most": 1}]}},
            "at_least is 2, but at_most is 1",
        ),
        (
            "{}",
            {"policy": {"checks": [{"value": "filing_fraction", "at_least": 0.5}]}},
            "there is no quantity 'filing_fraction' to check; expected ",
        ),
        (
            "{}",
            {"policy": {"checks": [{"value": "x", "at_least": 2, "then": "skip_point"}]}},
            "without a scan there are no points to skip; expected 'warn' or 'stop'",
        ),
    ],
)
def test_a_wrong_policy_is_refused_with_its_place(
    tmp_path: Path, step: str, keys: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        labseq.Session.open(sequence(tmp_path, step=step, **keys))
    assert message in str(caught.value)


def test_only_what_leaves_the_atoms_alone_is_tried_again(tmp_path: Path) -> None:
    path = write(tmp_path)
    text = path.read_text(encoding="utf-8").replace(
        "- load: {duration: 500 ms}", "- load: {duration: 500 ms}\n    policy: {retries: 1}"
    )
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"10:14: 'load' cannot be repeated in the same shot") as caught:
        labseq.Session.open(path)
    assert "on_failure: repeat_shot" in str(caught.value)


def test_a_scan_cannot_change_a_policy(tmp_path: Path) -> None:
    path = write(tmp_path)
    text = path.read_text(encoding="utf-8").replace("shots: 6", "scan: {shot.0.policy.retries: [0, 1]}")
    path.write_text(text.replace("500 ms}", "500 ms}\n    policy: {retries: 0}"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"a scan cannot change 'shot\.0\.policy\.retries'"):
        labseq.Session.open(path)


def test_an_adaptive_scan_reports_a_point_whose_last_shots_are_skipped(tmp_path: Path) -> None:
    path = sequence(tmp_path, "adaptive", "{at: [1, 2]}", policy={"on_failure": "skip_point"})
    path.write_text(path.read_text(encoding="utf-8").replace("shot.2", "shot.3"), encoding="utf-8")
    seen = RecordingObserver()
    run(path, seen)
    points = seen.of("scan_point")
    assert [(event["point"], event["value"] is None) for event in points] == [
        (0, False),
        (1, True),
        (2, False),
    ]


def test_a_value_that_no_shot_has_is_one_warning(tmp_path: Path) -> None:
    checks = [
        {"value": "reading.laser.pwer_w", "at_least": 0.1},
        {"value": "stage.plan", "at_most": 0.1},
        {"value": "stage.plan_s", "at_most": 100},
    ]
    seen = RecordingObserver()
    path = sequence(tmp_path, policy={"checks": checks})
    observer = Interrupting("shot_started", 3)
    with labseq.Session.open(path, seed=5, output=tmp_path / "data", observer=observer) as session:
        observer.session = session
        with pytest.raises(labseq.StopRequested):
            session.run()
    first, second = (event["text"] for event in observer.of("warning"))
    assert re.match(r"shot 0 .*'reading.laser.pwer_w'.*'reading.laser.power_w'", first)
    assert re.match(r"shot 0 .*'stage.plan'.*'stage.plan_s'", second)
    assert session.run_dir is not None
    resumed(session.run_dir, seen)
    assert seen.of("warning") == []
