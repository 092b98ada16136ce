"""Notices are sent of what somebody wants to know, and never disturb a run."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Generator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

from labseq.errors import ConfigError
from labseq.session import notices
from labseq.session.notices import Notices, NoticeSettings
from labseq.session.send_notice import MAX_S, send


class Receiver(BaseHTTPRequestHandler):
    received: list[dict[str, str]]
    status = 200

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.received.append(json.loads(body))
        self.send_response(self.status)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the base class calls it so
        pass


@pytest.fixture
def receiver() -> Generator[tuple[str, list[dict[str, str]]]]:
    Receiver.received, Receiver.status = [], 200
    with HTTPServer(("127.0.0.1", 0), Receiver) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/", Receiver.received
        server.shutdown()
        thread.join()


def test_every_way_is_tried_and_each_failure_is_named(
    receiver: tuple[str, list[dict[str, str]]], tmp_path: Path
) -> None:
    address, received = receiver
    told = tmp_path / "told"
    script = "import pathlib, sys; pathlib.Path(sys.argv[1]).write_text(sys.argv[2])"
    command = [sys.executable, "-c", script, str(told)]
    notice = {"kind": "failed", "run": "0001_look", "text": "labseq: 0001_look: the camera is gone"}
    assert send({"command": command, "webhook": address, "notice": notice}) == []
    assert (told.read_text(), received) == (notice["text"], [notice])
    Receiver.status = 500
    failures = send({"command": ["no-such-program"], "webhook": address, "notice": notice})
    named = [failure.split(": ")[:2] for failure in failures]
    assert named == [["no-such-program", "FileNotFoundError"], ["127.0.0.1", "HTTPError"]]
    misspelt = send({"command": [], "webhook": "http://localhost:80x/", "notice": notice})
    assert misspelt == ["localhost: InvalidURL: nonnumeric port: '80x'"]


class Sent(list[dict[str, str]]):
    def __call__(self, root: Path, task: dict[str, Any]) -> None:
        self.append(task["notice"])


def test_what_is_wanted_is_sent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent = Sent()
    monkeypatch.setattr(notices, "deliver", sent)
    settings = NoticeSettings(labseq=1, command=("tell",), on=("failed", "alarm", "disk"), free_gb=1e-6)
    told = Notices(settings, tmp_path)
    told.event("run_starting", {"run_dir": str(tmp_path)})
    told.event("warning", {"text": "a dull one"})
    told.event("warning", {"text": "shot 3: no atoms", "alarm": "atoms"})
    told.event("shot_finished", {})
    told.event("run_finished", {"status": "complete", "error": ""})
    told.send("queue", "the end")  # not wanted
    assert [(one["kind"], one["text"]) for one in sent] == [
        ("alarm", f"labseq: {tmp_path.name}: shot 3: no atoms")
    ]
    told.event("run_finished", {"status": "failed", "error": "the camera is gone"})
    full = Notices(settings.model_copy(update={"free_gb": 1e9}), tmp_path)
    full.event("run_starting", {"run_dir": str(tmp_path)})
    for _ in range(3):
        full.event("shot_finished", {})
    assert [one["kind"] for one in sent] == ["alarm", "failed", "disk"]


def test_the_file_is_checked_and_may_be_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LABSEQ_DATA", str(tmp_path))
    sent = Sent()
    monkeypatch.setattr(notices, "deliver", sent)
    Notices.read().send("queue", "nobody wants it")
    (tmp_path / "notify.yaml").write_text("labseq: 1\nwebhook: example\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"notify.yaml:2:10: "):
        Notices.read()
    (tmp_path / "notify.yaml").write_text("labseq: 1\ncommand: [tell]\n", encoding="utf-8")
    Notices.read().send("queue", "the end")
    assert [one["text"] for one in sent] == ["labseq: the end"]


def test_a_program_that_hangs_is_not_waited_for(tmp_path: Path) -> None:
    notice = {"kind": "queue", "run": "", "text": "labseq: the end"}
    begun_s = time.monotonic()
    command = [sys.executable, "-c", "import time; time.sleep(3600)"]
    notices.deliver(tmp_path, {"command": command, "webhook": "", "notice": notice})
    assert time.monotonic() - begun_s < MAX_S / 2
