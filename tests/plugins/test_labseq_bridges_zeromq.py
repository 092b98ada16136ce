"""The ZeroMQ server beside a run: what it answers, and what it refuses."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import zmq

from tests.remote.conftest import free_port

from .labseq_follow_rig import MAX_WAIT_S, token_file
from .test_labseq_follow_session import run_led

TOKEN = "0123456789abcdef" * 2
MAY_SET = "leader={may_set: [planner.degree_of_parallelism]}"
SERVER = [sys.executable, "-m", "labseq_bridges.zeromq_server", "-p", "0", "--labseq-port"]


class Requests:
    """A REQ socket of another program."""

    def __init__(self, context: zmq.Context[Any], address: str) -> None:
        self.address = address
        self._socket = context.socket(zmq.REQ)
        self._socket.plain_username, self._socket.plain_password = b"labseq", TOKEN.encode()
        self._socket.rcvtimeo = int(1000 * MAX_WAIT_S)
        self._socket.linger = 0
        self._socket.connect(address)

    def send(self, data: bytes) -> Any:
        self._socket.send(data)
        return json.loads(self._socket.recv())

    def ask(self, request: Any, **values: Any) -> Any:
        return self.send(json.dumps({"request": request, **values}).encode())

    def close(self) -> None:
        self._socket.close()


@contextmanager
def served(port: int) -> Generator[Requests]:
    """The server in a process of its own, as a user starts it."""
    with (
        subprocess.Popen([*SERVER, str(port)], stdout=subprocess.PIPE, text=True) as server,
        zmq.Context[Any]() as context,
    ):
        assert server.stdout is not None
        peer = Requests(context, server.stdout.readline().split()[-1])
        try:
            yield peer
        finally:
            peer.close()
            server.send_signal(signal.SIGINT)
    assert server.returncode == 0


@pytest.fixture(autouse=True)
def token() -> None:
    token_file().parent.mkdir(parents=True, exist_ok=True)
    token_file().write_text(TOKEN)
    token_file().chmod(0o600)


def test_it_leads_one_run_after_the_other(tmp_path: Path) -> None:
    port = free_port()
    came: list[Any] = []
    with served(port) as peer:

        def lead(_address: str) -> None:
            go = peer.ask("go", text="run 17", values={"planner.degree_of_parallelism": 3})
            came.append([go, peer.ask("wait", timeout_s=0), peer.ask("wait")])

        def lead_and_abort(_address: str) -> None:
            refused = [peer.ask("go", values={"shot.9.hold": "5 ms"}), peer.ask("wait")]
            came.append([*refused, peer.ask("go"), peer.ask("abort")])
            lead(_address)

        options = ("shot.2.rearrange.cycles=1", f"profile.devices.leader.port={port}", "attempts=1", MAY_SET)
        runs = [run_led(each, tmp_path, *options, shots=1) for each in (lead, lead_and_abort)]
        refused = peer.ask("go")
    first, (_, wrong, go, aborted), second = came
    for (busy, waiting, answer), run in zip((first, second), runs, strict=True):
        (shot,) = run.shots
        assert busy == waiting == go == {"answer": "busy"}
        assert (answer["answer"], answer["is_ready"], Path(answer["file"])) == ("ready", True, shot.file)
        assert answer["before"] == shot.occupancies[0].astype(int).tolist()
        assert answer["after"] == shot.occupancies[-1].astype(int).tolist()
        assert shot.readings["leader.go"][-1] == "run 17"
        assert shot.parameters["planner.degree_of_parallelism"] == 3
    assert (wrong["answer"], wrong["is_refused"]) == ("failed", True)
    assert "shot.9.hold" in wrong["reason"]
    assert (aborted["answer"], "aborted" in aborted["reason"]) == ("failed", True)
    assert (refused["answer"], "refused" in refused["reason"]) == ("error", True), "no run is in progress"


def test_what_it_refuses() -> None:
    def reason(answer: Any) -> str:
        assert answer.keys() == {"answer", "reason"}
        assert answer["answer"] == "error"
        return answer["reason"]

    with served(free_port()) as peer:
        for text in (b"", b"\xff\x00", b"[" * 60_000, b"go"):
            assert reason(peer.send(text)) == "the request is not JSON"
        for text in (b"[]", b"null", b'"go"'):
            assert reason(peer.send(text)) == "the request is not a JSON object"
        assert reason(peer.ask("run")) == "request is 'run'; expected go, wait, abort, state"
        assert reason(peer.ask("go", text="1", cycles=3)).startswith("unknown key 'cycles'; 'go' takes")
        assert reason(peer.ask("go", values=[1])) == "values must be an object of address -> value"
        assert reason(peer.ask("wait", timeout_s=-1)) == "timeout_s is -1; expected 0 to 3600 s"
        assert reason(peer.ask("wait", timeout_s=1)) == "call go() first"
        assert "refused" in reason(peer.ask("state"))


def test_a_peer_that_sends_too_much_gets_no_answer() -> None:
    with served(free_port()) as peer:
        peer._socket.rcvtimeo = 300
        with pytest.raises(zmq.Again):
            peer.send(b" " * 70_000)


def greeting(mechanism: bytes) -> bytes:
    """The first bytes of ZMTP 3.0."""
    return b"\xff" + bytes(8) + b"\x7f\x03\x00" + mechanism.ljust(20, b"\0") + bytes(32)


PART = b"\x03" + (60_000).to_bytes(8, "big") + bytes(60_000)
PART_2 = b"\xff" + (60_001).to_bytes(8, "big") + b"\x01" + bytes(60_000)
NO_TOKEN = {
    "nothing": (b"", b""),
    "the mechanism NULL": (greeting(b"NULL") + b"\x04\x19\x05READY\x0bSocket-Type\0\0\0\x03REQ", PART),
    "a wrong token": (greeting(b"PLAIN") + b"\x04\x0f\x05HELLO\x06labseq\x01x", PART),
    "a user of another name": (greeting(b"PLAIN") + b"\x04\x29\x05HELLO\x01x\x20" + TOKEN.encode(), PART),
    "the protocol of ZeroMQ 2": (b"\x01\x00", PART_2),
}


def test_a_peer_without_the_token_cannot_send_parts_without_end() -> None:
    with served(free_port()) as peer:
        host, _, port = peer.address.rpartition("/")[2].rpartition(":")
        for first, part in NO_TOKEN.values():
            with (
                suppress(ConnectionError),
                socket.create_connection((host, int(port)), MAX_WAIT_S) as stranger,
            ):
                stranger.sendall(first)
                for _ in range(500):
                    stranger.sendall(part)
                while stranger.recv(100):  # until the server closes the connection
                    pass
        assert peer.ask("wait") == {"answer": "error", "reason": "call go() first"}


def test_a_missing_token_is_a_mistake_on_one_line() -> None:
    token_file().unlink()
    ended = subprocess.run([*SERVER, "1"], capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert "leader.token'; check --labseq-token, --bind and --port" in ended.stderr
