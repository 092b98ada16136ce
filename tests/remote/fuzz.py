"""Damaged messages at every socket of a server: ``python -m tests.remote.fuzz [NUMBER]``."""

from __future__ import annotations

import random
import sys
import tempfile
import time
from pathlib import Path

import zmq

from labseq import wire


def fuzz(port: int, n_ports: int, n_messages: int, seed: int) -> int:
    """Send damaged messages, and return the number of replies.

    Args:
        port: The first port of a server without keys.
        n_ports: Number of its ports.
        n_messages: Number of messages, to all ports in turn.
        seed: Of the damage.
    """
    random_ = random.Random(seed)
    call = {
        "session": bytes(16),
        "n": 1,
        "call": "read",
        "args": ["x"],
        "named": {},
        "now": 0.0,
        "shot": (0, 0),
    }
    hello = {"n": 1, "op": "hello", "protocol": 1, "labseq": "x", "run": bytes(16), "device": "camera"}
    valid = [[bytes(part) for part in wire.pack(one)] for one in (call, hello, {"n": 2, "op": "status"})]
    context = zmq.Context()
    sockets = [context.socket(zmq.DEALER) for _ in range(n_ports)]
    n_replies = 0
    for number, socket in enumerate(sockets):
        socket.connect(f"tcp://127.0.0.1:{port + number}")
    for number in range(n_messages):
        socket = sockets[number % n_ports]
        parts = [bytearray(part) for part in random_.choice(valid)]
        for _ in range(random_.randrange(1, 6)):
            part = random_.choice(parts)
            if part:
                part[random_.randrange(len(part))] = random_.randrange(256)
        if random_.random() < 0.2:
            parts.insert(random_.randrange(2), bytearray(random_.randbytes(random_.randrange(200))))
        socket.send_multipart(parts)
        while socket.poll(0):
            socket.recv_multipart()
            n_replies += 1
    deadline_s = time.monotonic() + 1.0
    while time.monotonic() < deadline_s:
        for socket in sockets:
            while socket.poll(5):
                socket.recv_multipart()
                n_replies += 1
    context.destroy(linger=0)
    return n_replies


if __name__ == "__main__":
    from tests.remote.conftest import served

    n = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    with served(Path(tempfile.mkdtemp())) as one:
        n_ports = 1 + len(one.server.devices)
        for seed in range(n // 1000):
            print(f"{1000 * (seed + 1)} messages, {fuzz(one.port, n_ports, 1000, seed)} replies")
        print(*one.told, sep="\n")
