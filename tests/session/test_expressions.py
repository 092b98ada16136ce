"""Expressions in runs: overridden, scanned, climbed on, recorded, resumed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.errors import ConfigError

from .scripted_scanner import PROFILE
from .small_runs import Interrupting

SEQUENCE = """labseq: 1
name: follows
profile: ./p.yaml
seed: 5
record_frames: none
variables: {hold: 20 ms, dop: 2}
target: {pattern: compact, rows: 3, cols: 3}
planner: {use: psca, degree_of_parallelism: = variables.dop}
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - name: sort
    rearrange: {cycles: 1, window: = variables.hold + 5 ms, exposure: = 2 * shot.1.image.exposure}
  - image: {exposure: = shot.sort.exposure / 3}
"""
N_LINES = SEQUENCE.count("\n")
MORE = """variables: {ramp: 50 us}
"""


def opened(folder: Path, rest: str = "shots: 2\n", *overrides: str, **options: Any) -> labseq.Session:
    profile = PROFILE.replace(
        "mobile_tweezers: {use: virtual}",
        "mobile_tweezers: {use: virtual, pick_up: = variables.ramp, drop_off: = 2 * variables.ramp}",
    )
    (folder / "p.yaml").write_text(profile + MORE, "utf-8")
    (folder / "s.yaml").write_text(SEQUENCE + rest, "utf-8")
    return labseq.Session.open(
        folder / "s.yaml", output=folder / "data", overrides=list(overrides), **options
    )


def run(folder: Path, *args: str) -> labseq.Run:
    with opened(folder, *args) as session:
        return session.run()


def settings(session: labseq.Session) -> tuple[Any, ...]:
    resolved = session.assembly.resolved
    sort, image = resolved["shot"][2]["rearrange"], resolved["shot"][3]["image"]
    motion = resolved["profile"]["mobile_tweezers"]
    window = sort["window"]
    return (
        window if isinstance(window, float) else window[0],
        sort["exposure"],
        image["exposure"],
        motion["drop_off"],
    )


def test_values_follow_from_others_and_from_what_options_say(tmp_path: Path) -> None:
    assert settings(opened(tmp_path)) == pytest.approx((0.025, 0.09, 0.03, 1e-4))
    changed = ["variables.hold=40 ms", "shot.1.image.exposure=30 ms", "profile.variables.ramp=20 us"]
    assert settings(opened(tmp_path, "shots: 2\n", *changed)) == pytest.approx((0.045, 0.06, 0.02, 4e-5))
    own = settings(opened(tmp_path, "shots: 2\n", "shot.sort.window== 3 * variables.hold"))
    assert own[0] == pytest.approx(0.06)


def test_the_record_has_the_values_and_the_texts(tmp_path: Path) -> None:
    record = run(tmp_path, "shots: 1\n", "shot.1.image.exposure== 2 * variables.hold").record
    assert record["resolved"]["expressions"] == {
        "planner.degree_of_parallelism": "= variables.dop",
        "shot.1.image.exposure": "= 2 * variables.hold",
        "shot.2.rearrange.window": "= variables.hold + 5 ms",
        "shot.2.rearrange.exposure": "= 2 * shot.1.image.exposure",
        "shot.3.image.exposure": "= shot.sort.exposure / 3",
        "profile.mobile_tweezers.pick_up": "= variables.ramp",
        "profile.mobile_tweezers.drop_off": "= 2 * variables.ramp",
    }
    exposure = {"value": 0.04, "unit": "s", "written": "= 2 * variables.hold"}
    assert record["overrides"] == {"shot.1.image.exposure": exposure}
    assert record["resolved"]["shot"][1]["image"]["exposure"] == 0.04
    assert record["resolved"]["variables"] == {"hold": 0.02, "dop": 2}


def test_a_scanned_variable_changes_what_follows_from_it_and_nothing_else(tmp_path: Path) -> None:
    scan = """scan:
  variables.hold: [20 ms, 35 ms]
  profile.variables.ramp: [30 us, 60 us]
"""
    done = run(tmp_path, scan)
    assert len(done.shots) == 4
    for shot in done.shots:
        parameters = shot.parameters
        assert shot.cycles[0].window_s == pytest.approx(parameters["variables.hold"] + 0.005)
        assert parameters["shot.2.rearrange.window"] == pytest.approx(parameters["variables.hold"] + 0.005)
        assert parameters["profile.mobile_tweezers.drop_off"] == pytest.approx(
            2 * parameters["profile.variables.ramp"]
        )
        assert "shot.3.image.exposure" not in parameters
    assert {shot.parameters["variables.hold"] for shot in done.shots} == {0.02, 0.035}
    assert done.scan["addresses"] == ["variables.hold", "profile.variables.ramp"]
    assert done.scan["points"][0] == [0.02, 3e-05]
    assert done.scan["written"][0] == ["20 ms", "30 us"]


def test_a_run_with_expressions_is_resumed(tmp_path: Path) -> None:
    scan = "scan: {variables.hold: [20 ms, 35 ms]}\nrepeats: 2\n"
    whole = run(tmp_path, scan)
    observer = Interrupting("shot_started", 3)
    with opened(tmp_path, scan, observer=observer) as session:
        observer.session = session
        with pytest.raises(labseq.StopRequested):
            session.run()
        assert session.run_dir is not None
    with labseq.Session.resume(session.run_dir) as session:
        done = session.run()
    assert [(s.parameters, s.filling_fraction) for s in done.shots] == [
        (s.parameters, s.filling_fraction) for s in whole.shots
    ]


@pytest.mark.parametrize(
    ("scan", "message"),
    [
        ("{variables.hodl: [1 ms]}", "1:8: there is no variable 'variables.hodl'; expected"),
        ("{variables.hold.x: [1 ms]}", "'variables.hold' is '20 ms' and has no 'x' in it"),
        ("{variables.hold: [1 ms, 1 um]}", "a length and a time cannot be added"),
        ("{variables.hold: [10 ms, -6 ms]}", "window is"),
        ("{planner.degree_of_parallelism: [= 2 + 1]}", "1:40: an expression is not allowed in a scan"),
    ],
)
def test_a_wrong_scan_of_a_variable_is_refused(tmp_path: Path, scan: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        opened(tmp_path, f"scan: {scan}\n")
    text = str(caught.value).replace(f"s.yaml:{N_LINES + 1}:", "s.yaml:1:")
    assert message in text


def test_what_a_run_has_one_of_cannot_follow_from_a_scan(tmp_path: Path) -> None:
    rest = "scan: {variables.dop: [1, 2]}\nattempts: = variables.dop\n"
    with pytest.raises(
        ConfigError, match=r"a scan cannot change 'attempts', which depends on 'variables.dop'"
    ):
        opened(tmp_path, rest)
    (tmp_path / "s.yaml").write_text(
        SEQUENCE.replace("= variables.dop", "2") + "scan: {variables.dop: [1, 2]}\n"
    )
    with pytest.raises(ConfigError, match=r"no setting uses 'variables.dop'"):
        labseq.Session.open(tmp_path / "s.yaml")
