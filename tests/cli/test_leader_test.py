"""``labseq leader-test``: what it finds out about a run, and about a program that is none."""

from __future__ import annotations

import json
import socketserver
import threading
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

from labseq.cli import leader_test, main
from tests.plugins.labseq_follow_rig import token_file
from tests.plugins.test_labseq_follow_session import run_led


def call(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["leader-test", *arguments])
    return int(str(ended.value.code))


def test_a_run_answers_as_it_must_and_goes_on(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    codes: list[int] = []

    def lead(address: str) -> None:
        port = address.rpartition(":")[2]
        codes.extend([call("--port", port), call("--port", port, "--shots", "4")])

    done = run_led(lead, tmp_path, "shot.2.rearrange.cycles=1", shots=4)
    out, err = capfd.readouterr()
    assert (codes, done.status, len(done.shots)) == ([0, 0], "complete", 4), (out, err)
    assert "FAILED" not in out
    first, second = out.split("no shot was taken; ")
    assert "state?: 200 answers, median" in first
    assert "a leader that leaves during a shot" not in first, "it took no shot"
    assert second.count("ok") >= 12
    assert "go to busy: 2 answers, median" in second
    assert [shot.readings["leader.answer"] for shot in done.shots] == [
        ["ready"],
        ["gone"],
        ["ready"],
        ["ready"],
    ]


class Obliging(socketserver.StreamRequestHandler):
    """Accepts every token and every line: all that labseq must not do."""

    def handle(self) -> None:
        for line in self.rfile:
            hello: Any = {"answer": "hello", "deadline_s": 0.1, "shape": [2, 2]}
            state = {"answer": "state", "state": "waiting"}
            self.wfile.write(json.dumps(hello if line.startswith(b"hello") else state).encode() + b"\n")


@pytest.fixture
def obliging_port() -> Generator[str]:
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Obliging) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield str(server.server_address[1])
        server.shutdown()
        thread.join()


def test_a_program_that_refuses_nothing_fails_the_test(
    obliging_port: str, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leader_test, "MAX_WAIT_S", 0.1)
    token_file().parent.mkdir(parents=True, exist_ok=True)
    token_file().write_text("0" * 32)
    assert call("--port", obliging_port, "--json") == 3
    out, err = capfd.readouterr()
    report = json.loads(out)
    assert report.get("ok") is False, err
    assert {check["name"] for check in report["checks"] if not check["ok"]} > {"a wrong token", "two leaders"}


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--shots", "2"], 2, "2 is too few; expected 3 or more"),
        (
            ["--token", "none"],
            2,
            "the leader's token cannot be read: [Errno 2] No such file or directory: 'none'",
        ),
        (["--port", "1"], 3, "127.0.0.1:1: Connection refused; run a sequence with a step 'wait: {for: go}'"),
    ],
)
def test_mistakes(arguments: list[str], code: int, message: str, capfd: pytest.CaptureFixture[str]) -> None:
    token_file().parent.mkdir(parents=True, exist_ok=True)
    token_file().write_text("0" * 32)
    assert call(*arguments) == code
    assert message in capfd.readouterr().err
