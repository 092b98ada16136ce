"""Serial instruments behind a port of the network, on loopback."""

from __future__ import annotations

import importlib
import socket
import socketserver
import threading
from typing import Any

import pytest

from labseq import TransientError

from .labseq_serial_rig import opened


class Answering(socketserver.StreamRequestHandler):
    """An instrument on the network; it hangs up when told so."""

    def handle(self) -> None:
        for line in self.rfile:
            if line == b"BYE\n":
                return
            self.wfile.write(line.replace(b"T?", b"21.5"))


def test_an_instrument_behind_a_network_port_is_the_same() -> None:
    values = {"t": {"ask": "T?"}, "bye": {"ask": "BYE"}}
    with socketserver.TCPServer(("127.0.0.1", 0), Answering) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        port = f"socket://127.0.0.1:{server.server_address[1]}"
        with opened(port, values=values, commands={}, safe_state=[], identify=None) as synth:
            assert synth.read("t") == 21.5
            with pytest.raises(TransientError, match="synth: the line broke at 'BYE'"):
                synth.read("bye")
            assert synth.read("t") == 21.5, "it was opened again"
        server.shutdown()


@pytest.mark.filterwarnings("ignore:set(Daemon|Name)")  # pyserial 3.5
def test_an_instrument_behind_a_terminal_server_is_the_same() -> None:
    serial: Any = importlib.import_module("serial.rfc2217")
    behind: Any = importlib.import_module("serial").serial_for_url("loop://", timeout=0.02)
    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=serve_rfc2217, args=(serial, behind, server), daemon=True).start()
        port = f"rfc2217://127.0.0.1:{server.getsockname()[1]}"
        values = {"t": {"ask": "T?", "type": "text"}}
        with opened(port, values=values, commands={}, safe_state=[], identify=None) as synth:
            assert synth.read("t") == "T?", "behind the server is a loop"


def serve_rfc2217(serial: Any, behind: Any, server: socket.socket) -> None:
    """One client of a terminal server, until it hangs up."""
    client, _ = server.accept()
    with client, client.makefile("wb", 0) as out:
        manager = serial.PortManager(behind, out)
        while data := client.recv(1024):
            behind.write(b"".join(manager.filter(data)))
            if behind.in_waiting:
                client.sendall(b"".join(manager.escape(behind.read(behind.in_waiting))))
