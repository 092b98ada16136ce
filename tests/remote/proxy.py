"""A proxy between clients and a server, with the faults of a network."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable
from typing import Any

import zmq

from tests.remote.conftest import Served

Fault = Callable[[list[bytes]], list[list[bytes]]]
PROXY = "127.0.0.2"
"""Another address of this computer, so that the proxy has the same ports as the server."""


class Late:
    """Delays messages, and delivers each a second time after the next one."""

    def __init__(self) -> None:
        self._random = random.Random(1)
        self._last: list[list[bytes]] = []

    def __call__(self, message: list[bytes]) -> list[list[bytes]]:
        time.sleep(self._random.uniform(0.0, 1e-3))
        sent, self._last = [message, *self._last], [message]
        return sent


class Proxy:
    """Passes messages on, with faults.

    Attributes:
        fault: That of calls.
        reply_fault: That of all messages of the server.
        is_cut: Whether nothing is passed on.

    Args:
        server: The server.
        is_rough: Whether everything is late and comes twice, in both directions.
    """

    def __init__(self, server: Served, *, is_rough: bool = False) -> None:
        self.fault: Fault = lambda message: [message]
        self.reply_fault: Fault = lambda message: [message]
        self.is_cut = False
        self._is_rough = is_rough
        self._ended = threading.Event()
        self._context = zmq.Context()
        ports = range(server.port, server.port + 9)
        self._threads = [threading.Thread(target=self._pass, args=[port], daemon=True) for port in ports]
        for thread in self._threads:
            thread.start()

    def end(self) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join()  # it closes its sockets; the context would wait for ever for one that is open
        self._context.term()

    def _pass(self, port: int) -> None:
        front = self._context.socket(zmq.ROUTER)
        front.bind(f"tcp://{PROXY}:{port}")
        backs: dict[bytes, Any] = {}
        late: dict[tuple[bytes, bool], Late] = {}
        poller = zmq.Poller()
        poller.register(front, zmq.POLLIN)
        try:
            while not self._ended.is_set():
                for socket, _ in poller.poll(20):
                    parts = socket.recv_multipart()
                    if self.is_cut or self._ended.is_set():
                        continue
                    if socket is front:
                        client, *message = parts
                        if client not in backs:
                            backs[client] = self._context.socket(zmq.DEALER)
                            backs[client].connect(f"tcp://127.0.0.1:{port}")
                            poller.register(backs[client], zmq.POLLIN)
                        fault = self.fault if b"call" in message[0] else lambda message: [message]
                        if self._is_rough:
                            fault = late.setdefault((client, True), Late())
                        for one in fault(message):
                            backs[client].send_multipart(one)
                    else:
                        client = next(name for name, back in backs.items() if back is socket)
                        fault = (
                            late.setdefault((client, False), Late()) if self._is_rough else self.reply_fault
                        )
                        for one in fault(parts):
                            front.send_multipart([client, *one])
        finally:
            for socket in (front, *backs.values()):
                socket.close(linger=0)
