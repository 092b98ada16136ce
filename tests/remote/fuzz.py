"""Damaged messages at every socket of a server: ``python -m tests.remote.fuzz [NUMBER]``."""

from __future__ import annotations

import math
import random
import sys
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest import mock

import zmq

from labseq.plugin import MotionSpec, SiteGrid, wire
from labseq.remote.drivers import METHODS
from labseq.remote.server import Server

LAST = 1 << 40
"""Number of the message that is sent last; its reply shows that all before were read."""


@mock.patch("labseq.remote.sessions.FAULTY_S", math.inf)  # else most messages would not be read
def fuzz(server: Server, port: int, n_messages: int, seed: int) -> int:
    """Send damaged and wrong messages, with and without a session, and return the number of replies.

    Args:
        server: A server without keys.
        port: Its first port.
        n_messages: Number of messages, to all ports in turn.
        seed: Of the damage.
    """
    random_ = random.Random(seed)
    n_replies = 0
    with zmq.Context() as context:
        sockets = [context.socket(zmq.DEALER) for _ in range(1 + len(server.devices))]
        for number, socket in enumerate(sockets):
            socket.linger = 0
            socket.connect(f"tcp://127.0.0.1:{port + number}")
        tokens = [b""] * len(sockets)
        for number in range(n_messages):
            which = number % len(sockets)
            kind, n = "control", number
            if which:
                device = [*server.devices.values()][which - 1]
                session = device.sessions.get(tokens[which])
                if session is None or session.ended:
                    tokens[which] = _begin(sockets[0], device.name, device.kind)
                kind, n = device.kind, 1 if session is None else session.number + 1
            token = tokens[which] if which else random_.choice(tokens)
            parts = [bytearray(part) for part in wire.pack(_message(random_, kind, token, n))]
            _damage(random_, parts)
            sockets[which].send_multipart(parts)
            n_replies += _received(sockets[which])
        for which, socket in enumerate(sockets):
            last: dict[str, Any] = {"n": LAST, "op": "nonsense", "session": bytes(16)} | _call("read", [])
            socket.send_multipart(wire.pack({**last, "n": LAST}))
            deadline_s = time.monotonic() + 10.0
            while not _is_last(socket):
                n_replies += 1
                assert time.monotonic() < deadline_s, f"the socket {which} does not answer"
        for socket in sockets:
            socket.close()
    return n_replies


def _begin(control: Any, name: str, kind: str) -> bytes:
    """Begin a session; returns its token."""
    hello = {
        "n": LAST,
        "op": "hello",
        "protocol": wire.PROTOCOL,
        "labseq": "x",
        "who": "fuzz",
    }
    control.send_multipart(wire.pack({**hello, "device": name, "kind": kind}))
    while True:
        assert control.poll(5000), "the control does not answer"
        reply = wire.unpack(control.recv_multipart())
        if reply["n"] == LAST:
            return reply["value"]["session"]


def _call(name: str, args: list[Any]) -> dict[str, Any]:
    return {"call": name, "args": args, "named": {}}


def _message(random_: random.Random, kind: str, token: bytes, number: int) -> dict[str, Any]:
    if kind == "control":
        what = random_.choice(["hello", "beat", "abort", "nonsense"])
        about = {"protocol": 1, "labseq": "x", "device": "camera", "kind": "camera"}
        return {"n": number, "op": what, "session": token, "number": 1, **about}
    attach = {"name": kind, "grid": SiteGrid(6, 7), "motion": MotionSpec(), "lines": [], "calibrations": {}}
    name = random_.choice(["attach", "open", "close", *sorted(METHODS[kind])])
    values = [0, -1.5, "x", b"y", None, [1], {"a": 1}, "camera", "mobile_tweezers", SiteGrid(6, 7)]
    args = [attach] if name == "attach" else random_.choices(values, k=random_.randrange(4))
    session = token if random_.random() < 0.8 else bytes(16)
    return {"session": session, "n": number if random_.random() < 0.95 else 3, **_call(name, args)}


def _damage(random_: random.Random, parts: list[bytearray]) -> None:
    if random_.random() < 0.5:
        return  # what is wrong is in the values
    for _ in range(random_.randrange(1, 6)):
        part = random_.choice(parts)
        if part:
            part[random_.randrange(len(part))] = random_.randrange(256)
    if random_.random() < 0.2:
        parts.insert(random_.randrange(2), bytearray(random_.randbytes(random_.randrange(200))))


def _received(socket: Any) -> int:
    n, wait_ms = 0, 2
    while socket.poll(wait_ms):
        socket.recv_multipart()
        n, wait_ms = n + 1, 0
    return n


def _is_last(socket: Any) -> bool:
    if not socket.poll(100):
        return False
    reply = wire.unpack(socket.recv_multipart())
    return isinstance(reply, dict) and reply.get("n") == LAST


if __name__ == "__main__":
    from tests.remote.conftest import served

    n = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    with served(Path(tempfile.mkdtemp())) as one:
        for seed in range(n // 1000):
            n_replies = fuzz(one.server, one.port, 1000, seed)
            print(f"{1000 * (seed + 1)} messages, {n_replies} replies", flush=True)
        print(*one.told, sep="\n")
