"""What visitors may do with `--control`."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
import yaml

from labseq.assembly.options import Options
from labseq.assembly.plugin_choice import load_plugins
from labseq.queue.queue import Entry, Queue
from labseq.queue.running import QueueRun
from labseq.scaffold.schemas import file_schema
from labseq.web.actions import form_fields
from tests.recording.damages import rewrite_state

from .clients import Client, client_of, path_of, write_run

ROOT = Path(__file__).parents[2]


@pytest.fixture
def acting(run_dir: Path) -> Client:
    return client_of(run_dir.parent.parent, may_act=True)


def test_comment_and_tags_are_kept(acting: Client, run_dir: Path) -> None:
    text = "größer <b>µ</b>\nsecond line"
    assert (
        acting.post(
            f"{path_of(run_dir)}/notes", {"comment": text, "tags": [" a  b ", "", "c", "c"]}
        ).status_code
        == 200
    )
    values = acting.get(path_of(run_dir)).json()["run"]
    assert (values["comment"], values["tags"]) == (text, ["a b", "c"])
    for wrong in (
        {"comment": 5},
        {"comment": "x" * 10_001},
        {"tags": "a"},
        {"tags": [5]},
        [],
        b"{",
        b"x" * 99_999,
    ):
        assert acting.post(f"{path_of(run_dir)}/notes", wrong).status_code == 409
    assert acting.get(path_of(run_dir)).json()["run"]["comment"] == text


def test_only_a_run_in_progress_is_stopped(acting: Client, run_dir: Path) -> None:
    assert acting.post(f"{path_of(run_dir)}/stop", {}).status_code == 409
    assert acting.post("/api/v1/runs/2026-01-01/0001_none/stop", {}).status_code == 404
    writer = write_run(run_dir.parent.parent, 1)
    assert acting.post(f"{path_of(writer.run_dir)}/stop", {}).status_code == 200
    assert (writer.run_dir / "STOP").exists()
    assert acting.get(f"{path_of(writer.run_dir)}/state").json()["run"]["is_stopping"]
    rewrite_state(writer.run_dir, state="complete")
    assert not acting.get(f"{path_of(writer.run_dir)}/state").json()["run"]["is_stopping"]


def entry(number: int) -> Entry:
    sequence = Path("/lab/sequence.yaml").absolute()
    return Entry(number, Fraction(number), "2026-11-20T08:00:00+00:00", sequence, "shots: 1", Options())


def test_entries_are_moved_and_the_queue_paused(acting: Client, run_dir: Path) -> None:
    queue = Queue(run_dir.parent.parent)
    queue.folder.mkdir()
    for number in (1, 2, 3):
        queue.write(entry(number))

    def order() -> list[int]:
        return [one["id"] for one in acting.get("/api/v1/queue").json()["entries"]]

    assert order() == [1, 2, 3]
    assert acting.post("/api/v1/queue/move", {"entry": 3, "before": 1}).status_code == 200
    assert order() == [3, 1, 2]
    for wrong in ({"entry": 9, "before": 1}, {"entry": "1", "before": 2}, {}):
        assert acting.post("/api/v1/queue/move", wrong).status_code == 409
    assert acting.post("/api/v1/queue/resume", {"entry": 3}).status_code == 409  # it waits
    queue.write(replace(queue.entries()[0], status="failed", error="the camera is gone"))
    assert acting.post("/api/v1/queue/resume", {"entry": 3}).status_code == 200
    assert queue.entries()[0].status == "waiting"
    assert acting.post("/api/v1/queue/remove", {"entry": 3}).status_code == 200
    queue.complete(queue.entries()[0])
    assert [(one["id"], one["state"]) for one in acting.get("/api/v1/queue").json()["entries"]] == [
        (1, "complete"),
        (2, "waiting"),
    ]
    assert acting.post("/api/v1/queue/pause", {"paused": True}).status_code == 200
    assert acting.get("/api/v1/queue").json()["is_paused"]
    assert acting.post("/api/v1/queue/pause", {"paused": False}).status_code == 200
    assert not acting.get("/api/v1/queue").json()["is_paused"]
    (queue.folder / "0002.json").write_text("{")
    assert "0002.json" in acting.get("/api/v1/queue").json()["error"]


def test_a_paused_queue_waits_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    queue = Queue(tmp_path)
    queue.folder.mkdir()
    queue.write(replace(entry(1), text="no sequence"))
    queue.pause(True)
    waited = list[bool]()

    def wait(_: float) -> None:
        waited.append(queue.entries()[0].status == "waiting")
        queue.pause(False)

    monkeypatch.setattr("labseq.queue.running.time.sleep", wait)
    begun = list[int]()
    QueueRun(
        queue, lambda opening: None, lambda one: begun.append(one.id), lambda _: None, lambda *_: None
    ).run()
    assert (waited, begun) == ([True], [1])


def test_the_form_has_every_value_with_what_the_schema_says() -> None:
    host = load_plugins()
    host.import_all()
    schema = file_schema("sequence", host.registry)
    data: Any = yaml.safe_load((ROOT / "sequences" / "compact_225.yaml").read_text("utf-8"))
    fields = {one["address"]: one for one in form_fields(data, json.loads(json.dumps(schema)))}
    assert fields["planner.degree_of_parallelism"]["value"] == "7"
    assert "mobile tweezers" in fields["planner.degree_of_parallelism"]["about"]
    window = fields["shot.2.rearrange.window"]
    assert (window["value"], window["default"]) == ("60 ms", "60 ms")
    assert fields["shot.2.rearrange.stop_when"]["choices"] == ["defect_free", "never"]
    assert (fields["shots"]["min"], fields["shots"]["max"]) == (1, 1_000_000)
    assert fields["target.rows"]["value"] == "15"
    assert not [one for one in fields if "plugin" in one or one in ("profile", "name", "planner.use")]


def test_targets_are_drawn_and_never_named_by_a_path() -> None:
    """The answer of a check would tell which files the computer has."""
    host = load_plugins()
    host.import_all()
    schema = json.loads(json.dumps(file_schema("sequence", host.registry)))
    data = {"target": {"pattern": "bitmap", "file": "mine.txt"}, "shot": [{"load": {}}]}
    fields = {one["address"] for one in form_fields(data, schema)}
    assert "target.sites" in fields
    assert "target.file" not in fields


@pytest.mark.parametrize("kind", ["path", "file-path", "directory-path"])
def test_no_path_of_a_plugin_is_a_value_of_the_form(kind: str) -> None:
    """``pathlib.Path``, and what pydantic calls FilePath and DirectoryPath."""
    schema = {"properties": {"source": {"type": "string", "format": kind}, "shots": {"type": "integer"}}}
    fields = form_fields({"source": "mine", "shots": 1}, schema)
    assert [field["address"] for field in fields] == ["shots"]


@pytest.mark.parametrize("place", ["../../0001", "/etc/passwd", "0001.json", None, True, -1, 10**30])
def test_an_entry_is_a_number_and_never_a_file(acting: Client, run_dir: Path, place: object) -> None:
    queue = Queue(run_dir.parent.parent)
    queue.folder.mkdir()
    queue.write(entry(1))
    for action in ("move", "remove", "resume"):
        for values in ({"entry": place, "before": 1}, {"entry": 1, "before": place}):
            if values["entry"] != 1 or action == "move":
                assert acting.post(f"/api/v1/queue/{action}", values).status_code == 409
    assert [each.id for each in queue.entries()] == [1]


@pytest.mark.parametrize("run", ["%2fetc/passwd", "..%2f../etc", "2026-01-01/..%2f..%2fetc", "a%00/b"])
def test_a_run_is_named_and_never_a_folder_elsewhere(acting: Client, run: str) -> None:
    for action in ("stop", "notes"):
        assert acting.post(f"/api/v1/runs/{run}/{action}", {"comment": "x"}).status_code == 404


def test_a_known_sequence_is_queued_with_values_of_its_form(
    acting: Client, monkeypatch: pytest.MonkeyPatch, run_dir: Path
) -> None:
    """The commands run in processes of their own: here what they are called with."""
    called = list[list[str]]()

    def labseq(command: list[str], *, env: dict[str, str], **_: Any) -> subprocess.CompletedProcess[bytes]:
        assert command[:3] == [sys.executable, "-m", "labseq"]
        called.append([*command[3:], env.get("LABSEQ_DATA", "")])
        return subprocess.CompletedProcess(command, 0, b"{}" if "schema" in command else b"1: queued\n", b"")

    monkeypatch.setattr("labseq.web.actions.subprocess.run", labseq)
    monkeypatch.chdir(ROOT)
    assert "compact_225" in acting.get("/api/v1/sequences").json()["sequences"]
    values = {"sequence": "compact_225", "profile": "virtual", "changes": {"shots": "5; rm -rf"}}
    assert acting.post("/api/v1/queue/add", values).json() == {"done": "1: queued"}
    path = str(ROOT / "sequences" / "compact_225.yaml")
    root = str(run_dir.parent.parent)
    assert called[-1] == ["queue", "add", path, "--set=shots=5; rm -rf", "--profile=virtual", root]
    n = len(called)
    for wrong in (
        {"sequence": "../compact_225"},
        {"sequence": "none"},
        {"sequence": str(ROOT / "sequences" / "compact_225")},
        values | {"profile": "/tmp/mine.yaml"},
        values | {"profile": "..\\mine"},
        values | {"profile": "C:mine"},
        values | {"changes": {"plugin_folders": "[/tmp]"}},
        values | {"changes": {"profile.camera.use": "virtual"}},
        values | {"changes": [1]},
        values | {"changes": {"target.file": "/etc/passwd"}},
        values | {"changes": {"target": "/etc/passwd"}},
        values | {"changes": {"target.pattern": "bitmap"}},
        values | {"changes": {"plugin_folders.0": "/tmp"}},
        values | {"changes": {"shots": "{pattern: bitmap, file: /etc/passwd}"}},
        values | {"changes": {"shots": "&a {pattern: bitmap, file: /etc/passwd}"}},
        values | {"changes": {"shots": {"file": "/etc/passwd"}}},
    ):
        assert acting.post("/api/v1/queue/add", wrong).status_code == 409
    assert len(called) == n
