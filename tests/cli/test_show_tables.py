"""The tables of a run."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from labseq.cli.show import Tables, show_run
from labseq.errors import ConfigError
from labseq.model import StageTiming
from labseq.recording import RunWriter

SCAN: dict[str, Any] = {
    "addresses": ["shot.2.rearrange.window"],
    "points": [[0.06], [0.1]],
    "written": [["60 ms"], ["100 ms"]],
    "point_of_shot": [0, 1, 1],
}


@pytest.fixture
def folder(tmp_path: Path, fake: Any) -> Path:
    devices = {"camera": {"model": "EMCCD", "em_gain": 300.0, "text": "a\x1bb"}, "laser": {}}
    run = dataclasses.replace(fake.run(n_shots=3), devices=devices, scan=SCAN)
    writer = RunWriter.create(tmp_path, run)
    for shot in (
        fake.shot(0),
        fake.shot(1, status="failed", error="TransientError: no light"),
        fake.shot(1, success=False, seen=0, filling=223 / 225, attempt=1),
    ):
        shot.timing.insert(0, StageTiming("play", 0, 1, 0.0, 0.02, 0.001, 0.01))
        writer.write_shot(shot)
    writer.finish("stopped")
    return writer.run_dir


def shown(folder: Path, capsys: pytest.CaptureFixture[str], **tables: bool) -> list[str]:
    show_run(folder, as_json=False, tables=Tables(**tables))
    return capsys.readouterr().out.splitlines()


def as_json(folder: Path, capsys: pytest.CaptureFixture[str], **tables: bool) -> dict[str, Any]:
    show_run(folder, as_json=True, tables=Tables(**tables))
    return json.loads(capsys.readouterr().out)


def test_every_shot_and_every_attempt_has_a_row(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = shown(folder, capsys, shots=True)
    assert lines[0].split()[:2] == ["shot", "shot.2.rearrange.window"]
    assert [" ".join(line.split()) for line in lines[1:]] == [
        "1 60 ms defect-free in cycle 2 100.0 % 0 0 0 1.9 s",
        "2 100 ms attempt 1 failed: TransientError: no light 100.0 % 0 0 0 1.9 s",
        "2 100 ms 2 defects 99.1 % 0 0 0 1.9 s",
    ]


def test_each_stage_has_a_row(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = [" ".join(line.split()) for line in shown(folder, capsys, timing=True)]
    assert lines[0] == "stage a shot budget modelled p50 p99 host p50 p99 share over budget"
    assert lines[1] == "play 1 10 ms 20 ms 20 ms 1 ms 1 ms 1.1 % 2 of 2"
    assert lines[-1] == "shot: 1.9 s (p50), 1.9 s (p99), of 2 of 2 shots"


def test_each_point_has_a_row(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = shown(folder, capsys, scan=True)
    assert [line.split()[:3] for line in lines[1:]] == [["60", "ms", "1"], ["100", "ms", "1"]]


def test_devices_tell_of_themselves(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert shown(folder, capsys, devices=True) == [
        "camera: EMCCD",
        "  em_gain 300.0, text a\\x1bb",
        "laser: no model told",
    ]


def test_several_tables_have_a_line_between_them(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = shown(folder, capsys, scan=True, devices=True)
    assert lines[3] == ""
    assert lines[4] == "camera: EMCCD"


def test_json_holds_the_same(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    answer = as_json(folder, capsys, shots=True, timing=True, scan=True, devices=True)
    assert (answer["run_dir"], answer["status"]) == (str(folder), "stopped")
    assert [(shot["index"], shot["status"]) for shot in answer["shot_list"]] == [
        (0, "complete"),
        (1, "failed"),
        (1, "complete"),
    ]
    (play, *_) = answer["timing"]["stages"]
    assert (play["stage"], play["n_over"], play["session_s"]) == ("play", 2, {"p50": 0.02, "p99": 0.02})
    assert [point["parameters"] for point in answer["points"]] == [
        {"shot.2.rearrange.window": 0.06},
        {"shot.2.rearrange.window": 0.1},
    ]
    assert answer["devices"]["camera"]["em_gain"] == 300.0


@pytest.mark.parametrize(
    ("table", "told"), [("scan", "the run has no scan"), ("timing", "no shots yet whose files can be read")]
)
@pytest.mark.parametrize("json_wanted", [False, True])
def test_what_a_run_has_not_is_told(
    tmp_path: Path, fake: Any, capsys: pytest.CaptureFixture[str], table: str, told: str, json_wanted: bool
) -> None:
    run_dir = RunWriter.create(tmp_path, fake.run()).run_dir
    with pytest.raises(ConfigError, match=told):
        show_run(run_dir, as_json=json_wanted, tables=Tables(**{table: True}))
    out = capsys.readouterr().out
    assert not json_wanted or told in json.loads(out)["error"]


def test_devices_that_were_not_opened_are_told(
    tmp_path: Path, fake: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert shown(RunWriter.create(tmp_path, fake.run()).run_dir, capsys, devices=True) == [
        "the devices were not opened"
    ]
