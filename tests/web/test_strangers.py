"""What a stranger can cost the server before the guard of the application sees a request."""

from __future__ import annotations

import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import urlopen

import psutil
import pytest

from labseq.web.live import MAX_VIEWERS_OF_ADDRESS

SERVE = """
import sys
from labseq.web import connections
connections.REQUEST_S = float(sys.argv.pop(1))
from labseq.cli import main
sys.argv[0] = "labseq"
main()
"""
PEM = Path(__file__).with_name("localhost.pem")
"""A certificate for 127.0.0.1 with its key, which is no secret."""
TLS = ssl.create_default_context(cafile=PEM)


@contextmanager
def server(
    data: Path, request_s: float = 60.0, *, tls: bool = False
) -> Generator[tuple[psutil.Process, str]]:
    """A server in a process of its own, and its address."""
    command = [sys.executable, "-c", SERVE, str(request_s), "web", str(data), "--port", "0"]
    command += ["--cert", str(PEM)] if tls else []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().strip()
            with urlopen(f"{address}api/v1/server", timeout=60.0, context=TLS):
                yield psutil.Process(process.pid), address
        finally:
            process.terminate()


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Generator[tuple[psutil.Process, str]]:
    with server(tmp_path_factory.mktemp("data")) as one:
        yield one


def connected(address: str) -> socket.socket:
    place = urlsplit(address)
    return socket.create_connection((place.hostname, place.port), timeout=60.0)


def is_closed(peer: socket.socket) -> bool:
    """Whether the server ends a connection; waits for that."""
    with suppress(ConnectionError):
        while peer.recv(1 << 16):
            pass
    return True


@pytest.mark.parametrize(
    "begin",
    [
        b"GET / HTTP/1.1\r\nhost: 127.0.0.1\r\n",
        b"POST / HTTP/1.1\r\nhost: 127.0.0.1\r\ntransfer-encoding: chunked\r\n\r\n0\r\n",
    ],
    ids=["headers", "trailers"],
)
def test_headers_without_an_end_are_not_kept(running: tuple[psutil.Process, str], begin: bytes) -> None:
    process, address = running
    before = process.memory_info().rss
    n_sent, part = 0, b"".join(b"x-%d: y\r\n" % i for i in range(2000))
    with connected(address) as peer, suppress(ConnectionError):
        peer.sendall(begin)
        while n_sent < 64 << 20:
            peer.sendall(part)
            n_sent += len(part)
    assert n_sent < 32 << 20
    assert process.memory_info().rss < before + (32 << 20)


@pytest.fixture(scope="module")
def encrypted(tmp_path_factory: pytest.TempPathFactory) -> Generator[tuple[psutil.Process, str]]:
    with server(tmp_path_factory.mktemp("data"), tls=True) as one:
        yield one


@pytest.mark.parametrize("name", ["running", "encrypted"])
def test_idle_connections_keep_nobody_out(name: str, request: pytest.FixtureRequest) -> None:
    _, address = request.getfixturevalue(name)
    idle = [connected(address) for _ in range(450)]
    try:
        begun_s = time.monotonic()
        with urlopen(f"{address}api/v1/server", timeout=60.0, context=TLS) as answer:
            assert answer.status == 200
        assert time.monotonic() < begun_s + 10.0  # it was 40 s
        assert is_closed(idle[0])
    finally:
        for peer in idle:
            peer.close()


@pytest.mark.skipif(sys.platform != "linux", reason="needs a second address of this computer")
def test_pages_of_one_address_leave_room_for_those_of_others(running: tuple[psutil.Process, str]) -> None:
    place = urlsplit(running[1])

    def follow(source: str) -> socket.socket:
        peer = socket.create_connection((place.hostname, place.port), 60.0, (source, 0))
        peer.sendall(b"GET /api/v1/events HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n")
        return peer

    pages = list[tuple[socket.socket, bytes]]()
    for _ in range(MAX_VIEWERS_OF_ADDRESS + 1):
        page = follow("127.0.0.1")
        pages.append((page, page.recv(1 << 12)))
    pages.append((other := follow("127.0.0.2"), other.recv(1 << 12)))
    assert [b" 503 " in answer for _, answer in pages] == [*[False] * MAX_VIEWERS_OF_ADDRESS, True, False]
    for page, _ in pages:
        page.close()


@pytest.mark.parametrize("tls", [False, True])
def test_a_request_that_does_not_end_is_not_waited_for(tmp_path: Path, tls: bool) -> None:
    begins = (b"", b"GET / HT", b"GET / HTTP/1.1\r\nhost: 127.0.0.1\r\n", b"\x16\x03\x01")
    with server(tmp_path, 1.0, tls=tls) as (_, address):
        peers = [connected(address) for _ in begins]
        for peer, begin in zip(peers, begins, strict=True):
            peer.sendall(begin)
        assert all(map(is_closed, peers))
        for peer in peers:
            peer.close()
