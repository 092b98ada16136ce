"""What a stranger at a port, or a client with wrong messages, can cost: its message or its connection."""

from __future__ import annotations

import socket
import subprocess
import sys
import tracemalloc
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq
from labseq_remote.connection import served_context
from labseq_remote.drivers import RemoteDevice
from labseq_remote.settings import RemoteSettings

from labseq import wire
from labseq.guard import StopFlag
from labseq.plugin import Context, SiteGrid
from labseq.remote import gate
from labseq.sequencer.clock import RealClock
from labseq.testing.fakes import FakeClock
from labseq.wire import messages
from tests.remote.conftest import PROFILE, Served, free_port
from tests.remote.fuzz import _begin

KINDS: dict[str, Any] = {
    "array": np.zeros(3),
    "empty array": np.zeros(0),
    "mapping": {"a": np.zeros(2)},
    "list": [np.zeros(2), "x"],
    "text": "x",
    "number": 7,
    "tuple": (np.zeros(2),),
    "grid": SiteGrid(2, 3),
}
HELLO = {"op": "hello", "labseq": "x", "who": "x", "device": "instrument", "kind": "device"}
REQUESTS: dict[str, dict[str, Any]] = {
    "hello": {**HELLO, "protocol": wire.PROTOCOL},
    "beat": {"op": "beat"},
    "abort": {"op": "abort", "number": 0},
}


@contextmanager
def connected(port: int) -> Generator[Any]:
    with zmq.Context() as context, context.socket(zmq.DEALER) as peer:
        peer.linger = 0
        peer.connect(f"tcp://127.0.0.1:{port}")
        yield peer


def ask(peer: Any, message: Any) -> Any:
    """The reply to a message."""
    peer.send_multipart(wire.pack(message))
    assert peer.poll(10_000), f"no reply to {message}"
    return wire.unpack(peer.recv_multipart())


def wrong_values(fields: dict[str, Any]) -> Generator[tuple[str, Any]]:
    """Each field with each value of another type than its own."""
    for field, right in fields.items():
        yield from ((field, value) for value in KINDS.values() if type(value) is not type(right))


@pytest.mark.parametrize("request_", REQUESTS)
def test_a_field_of_a_wrong_type_costs_its_message_only(server: Served, request_: str) -> None:
    with connected(server.port) as control:
        token = _begin(control, "instrument", "device")
        message = {"n": 5, **REQUESTS[request_]} | ({} if request_ == "hello" else {"session": token})
        for field, value in wrong_values(message):
            reply = ask(control, {**message, field: value})
            assert "cannot read a message" in reply["error"]["text"], (field, value)
        for value in KINDS.values():
            assert "cannot read a message" in ask(control, value)["error"]["text"]
        assert ask(control, {"session": token, "n": 6, "op": "beat"})["value"]["running"] is False


def test_a_context_of_a_wrong_type_is_refused(server: Served) -> None:
    context = served_context("laser", Context("laser", SiteGrid(6, 7), clock=FakeClock()))
    wrong: list[Any] = [{**context, field: value} for field, value in wrong_values(context)]
    wrong += [{**context, "lines": [np.zeros(2)]}, {**context, "calibrations": {"a": np.zeros(2)}}]
    with connected(server.port) as control, connected(server.port + 5) as device:
        for arguments in [*([context] for context in wrong), *([value] for value in KINDS.values())]:
            token = _begin(control, "instrument", "device")
            message = {"session": token, "n": 1, "call": "attach", "args": arguments, "named": {}}
            assert "context" in ask(device, message)["error"]["text"]


def test_a_session_is_called_from_one_connection(server: Served) -> None:
    context = served_context("laser", Context("laser", SiteGrid(6, 7), clock=FakeClock()))
    with connected(server.port) as control, connected(server.port + 5) as device:
        message = {"session": _begin(control, "instrument", "device"), "call": "attach", "named": {}}
        assert "value" in ask(device, {**message, "n": 1, "args": [context]})
        with connected(server.port + 5) as another:
            for number in (1, 2):  # a reply that would be repeated, and a call
                reply = ask(another, {**message, "n": number, "args": [context]})
                assert "from another connection" in reply["error"]["text"]
        assert "already has a driver" in ask(device, {**message, "n": 2, "args": [context]})["error"]["text"]


def array(place: list[int], dtype: str, shape: list[int]) -> msgpack.ExtType:
    return msgpack.ExtType(1, _packed([place, dtype, shape, {}]))


def _packed(value: Any) -> bytes:
    packed: Any = msgpack.packb(value)
    return packed


def announced_lists() -> list[bytes]:
    """Lists in lists that announce 30,000 items each, which do not come."""
    lists = b"\xdd\x00\x00\x75\x30" * 500
    message = lists
    for _ in range(15):
        message = lists + _packed(msgpack.ExtType(3, message))
    return [message]


GREEDY: dict[str, list[bytes]] = {
    "one part in many arrays": [_packed([array([1, 1], "<f8", [1 << 17])] * 60), bytes((1 << 20) + 9)],
    "parts that overlap": [_packed([array([1, i + 1], "<f8", [1 << 17]) for i in range(60)]), bytes(1 << 21)],
    "items without bytes": [_packed(array([1, 0], "|S0", [1 << 28])), b"x"],
    "text without bytes": [_packed(array([1, 0], "<U0", [1 << 28])), b"x"],
    "an endless empty array": [_packed(array([1, 0], "<f8", [1 << 30, 0])), b"x"],
    "announced lists": announced_lists(),
    "large grids": [
        _packed([msgpack.ExtType(2, _packed(["SiteGrid", [1000, 1000, 1, "square", 1, [], []]]))] * 9)
    ],
    "an endless grid": [
        _packed(msgpack.ExtType(2, _packed(["SiteGrid", [1 << 40, 1, 1, "square", 1, [], []]])))
    ],
}


@pytest.mark.parametrize("parts", GREEDY.values(), ids=GREEDY)
def test_no_message_takes_more_memory_than_a_few_times_its_size(parts: list[bytes]) -> None:
    grid_bytes = 16 * messages.MAX_SITES if b"SiteGrid" in parts[0] else 1 << 20
    tracemalloc.start()
    try:
        with pytest.raises(wire.MessageError):
            wire.unpack(parts)
        assert tracemalloc.get_traced_memory()[1] < 4 * (sum(map(len, parts)) + grid_bytes)
    finally:
        tracemalloc.stop()


def test_a_message_of_too_many_bytes_in_all_is_refused() -> None:
    part = bytes(messages.MAX_PART)
    with pytest.raises(wire.MessageError, match="expected at most"):
        wire.unpack([_packed(0), *[part] * 5])
    with pytest.raises(wire.MessageError, match="256 MiB in all"):
        wire.pack([np.frombuffer(part, np.uint8)] * 5)


GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(48)
READY = b"\x04\x1c\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER"
MORE = b"\x03" + (1 << 20).to_bytes(8, "big") + bytes(1 << 20)
"""A part of a message that others follow; see the protocol ZMTP 3.0."""


def test_a_message_whose_parts_do_not_end_is_cut_off(server: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gate, "MAX_UNANSWERED", 4 << 20)
    n_sent = 0
    with connected(server.port) as other, socket.create_connection(("127.0.0.1", server.port)) as endless:
        endless.settimeout(60.0)
        with suppress(ConnectionError):
            endless.sendall(GREETING + READY)
            while n_sent < 64:
                endless.sendall(MORE)
                n_sent += 1
        assert 3 < n_sent < 32
        assert "error" in ask(other, {"n": 1, "op": "nonsense"})


def test_a_client_that_sends_garbage_is_not_read_while_others_are_answered(server: Served) -> None:
    garbage = _packed([[]] * (1 << 19))
    for port in (server.port, server.port + 5):
        with connected(port) as faulty, connected(port) as other:
            n_answers = 0
            faulty.send(garbage)
            while n_answers < 50 and faulty.poll(1000):
                faulty.recv_multipart()
                faulty.send(garbage)
                n_answers += 1
            assert 0 < n_answers < 50
            assert "error" in ask(other, {"n": 1, "op": "nonsense"})


@pytest.mark.skipif(sys.platform == "win32", reason="the socket of ZeroMQ is one of the family UNIX")
def test_a_client_that_does_not_read_its_replies_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gate, "UNREAD_S", 0.3)
    told, port = list[str](), free_port()
    ports = gate.Gate("127.0.0.1", port, 1, has_keys=False, report=told.append)
    try:
        with socket.socket(socket.AF_UNIX) as listening:
            listening.bind(ports.addresses[0].removeprefix("ipc://"))
            listening.listen()
            ports.start(ports.addresses)
            with socket.create_connection(("127.0.0.1", port)), listening.accept()[0] as zeromq:
                zeromq.settimeout(60.0)
                with pytest.raises(ConnectionError):
                    zeromq.sendall(bytes(64 << 20))
    finally:
        ports.end()
    assert told == ["a connection from 127.0.0.1 was closed: it has not read for 0.3 s"]


SERVE = """
import resource, sys
resource.setrlimit(resource.RLIMIT_NOFILE, (512, 512))
from labseq.__main__ import main
sys.argv[0] = "labseq"
main()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="connections are not files there")
def test_strangers_without_a_key_leave_clients_and_files_alone(tmp_path: Path, keys: Path) -> None:
    path, port = tmp_path / "served.yaml", free_port(8)
    path.write_text(PROFILE, encoding="utf-8")
    command = [sys.executable, "-c", SERVE, "serve-devices", str(path), "--bind", f"tcp://127.0.0.1:{port}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        assert any("control at" in line for line in process.stdout)
        settings = RemoteSettings(device="instrument", address=f"tcp://127.0.0.1:{port}", server_key="here")
        device = RemoteDevice(settings, Context("laser", clock=RealClock(StopFlag())))
        device.open()
        strangers = [socket.socket() for _ in range(800)]
        most = 0
        try:
            for number, stranger in enumerate(strangers):  # all at the control, which clients need
                stranger.settimeout(0.1)
                with suppress(OSError):
                    stranger.connect(("127.0.0.1", port))
                if sys.platform == "linux" and number % 50 == 0:
                    most = max(most, len([*Path(f"/proc/{process.pid}/fd").iterdir()]))
            for stranger in strangers:
                stranger.settimeout(60.0)
                with suppress(OSError):
                    while stranger.recv(1 << 10):  # until the server ends it
                        pass
            for _ in range(20):
                device.command("open")
            assert most < 400
        finally:
            for stranger in strangers:
                stranger.close()
            with suppress(Exception):
                device.close()
            process.terminate()
        assert process.communicate(timeout=30)[0].count("error:") == 0
        assert process.returncode == 0


def test_a_client_that_reads_its_replies_gets_all_of_them() -> None:
    with zmq.Context() as context, wire.server_socket(context, "tcp://127.0.0.1:*", None) as server:
        server.rcvtimeo = server.sndtimeo = 5000
        with connected(int(server.get_string(zmq.LAST_ENDPOINT).rpartition(":")[2])) as peer:
            for number in range(100):
                peer.send(b"%d" % number)
            for _ in range(100):  # it never waits for a message, which is when ZeroMQ looks what was sent
                server.send_multipart(server.recv_multipart())
            peer.rcvtimeo = 2000
            assert [int(peer.recv()) for _ in range(100)] == [*range(100)]
