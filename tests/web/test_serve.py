"""The server beside a run: it is started once, answers, and ends with its terminal."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from urllib.request import urlopen

import psutil
import pytest

from labseq.web import serve

PARENT = """
import sys
from pathlib import Path
from labseq.web import serve
serve.PORT = int(sys.argv[2])
print(serve.start_for_run(Path(sys.argv[1])), flush=True)
sys.stdin.read()
"""


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


def data_of(address: str) -> str:
    """The data folder of the server at an address; nothing without one."""
    with suppress(OSError), urlopen(f"{address}api/v1/server", timeout=10.0) as answer:
        return json.load(answer)["data"]
    return ""


def test_a_server_beside_a_run_is_started_once_and_ends_with_the_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A shell is the terminal here; what it runs starts the server."""
    monkeypatch.setattr(serve, "PORT", free_port())
    arguments = [sys.executable, "-c", PARENT, str(tmp_path / "data"), str(serve.PORT)]
    script = f"import subprocess; subprocess.run({arguments!r})"
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as terminal:
        assert terminal.stdout is not None
        said = terminal.stdout.readline()
        address, pid = said.split()[0], int(re.findall(r"process (\d+)", said)[0])
        server = psutil.Process(pid)
        for _ in range(6000):  # ten minutes, on a busy computer
            if data_of(address):
                break
            with pytest.raises(psutil.TimeoutExpired):
                server.wait(0.1)
        assert data_of(address) == str(tmp_path / "data")
        assert "process" not in serve.start_for_run(tmp_path / "data")
        terminal.communicate("")
    server.wait(600)
