"""Devices on three computers, which are network namespaces of this one, and what a pulled cable does.

``python -m tests.remote.cables`` as root on Linux, with `ip` (package iproute2). `camera-pc` serves a camera,
`awg-pc` the other devices, and `control` runs a sequence, all with keys. The cable of each computer is pulled
in the middle of a shot (nothing arrives any more, and no connection ends), and plugged in again. It prints
the exit code and the message of the run, and when each device was safe: by the run's event log and by the
reports of the servers.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from labseq.plain import now
from labseq.wire import new_keys
from tests.remote.conftest import PROFILE
from tests.remote.test_runs import write_client

COMPUTERS: Final = {"control": "10.123.45.1", "camera-pc": "10.123.45.2", "awg-pc": "10.123.45.3"}
SERVED: Final = {
    "camera-pc": ("camera",),
    "awg-pc": ("static_tweezers", "mobile_tweezers", "lines", "instrument"),
}
SWITCH: Final = f"labseq{os.getpid()}"


def ip(*arguments: str) -> None:
    """Carry out a command of `ip`."""
    subprocess.run(["ip", *arguments], check=True)


def namespace(computer: str) -> str:
    """The name of a computer's namespace."""
    return f"{SWITCH}-{computer}"


def cable(computer: str, state: str) -> None:
    """Pull a computer's cable ("down"), or plug it in ("up")."""
    ip("-n", SWITCH, "link", "set", computer, state)


@contextmanager
def connected() -> Generator[None]:
    """The computers, each with a cable to a switch."""
    try:
        ip("netns", "add", SWITCH)
        ip("-n", SWITCH, "link", "add", "switch", "type", "bridge")
        ip("-n", SWITCH, "link", "set", "switch", "up")
        for computer, address in COMPUTERS.items():
            name = namespace(computer)
            ip("netns", "add", name)
            ip("-n", name, "link", "set", "lo", "up")
            peer = ("peer", "name", "cable", "netns", name)
            ip("-n", SWITCH, "link", "add", computer, "type", "veth", *peer)
            ip("-n", SWITCH, "link", "set", computer, "master", "switch")
            ip("-n", name, "address", "add", f"{address}/24", "dev", "cable")
            ip("-n", name, "link", "set", "cable", "up")
            cable(computer, "up")
        yield
    finally:
        for name in (SWITCH, *map(namespace, COMPUTERS)):
            subprocess.run(["ip", "netns", "delete", name], check=False)


def exchange_keys(folder: Path) -> None:
    """A key for each computer, and its public part for the others."""
    for computer in COMPUTERS:
        _, public = new_keys(computer, folder / computer)
        for other in COMPUTERS:
            known = folder / other / "known" / public.name
            known.parent.mkdir(parents=True, exist_ok=True)
            known.write_bytes(public.read_bytes())


def start(folder: Path, computer: str, *arguments: str, **pipes: Any) -> subprocess.Popen[str]:
    """Start labseq on a computer, with its keys."""
    on = ["ip", "netns", "exec", namespace(computer), "env", f"LABSEQ_KEYS={folder / computer}"]
    return subprocess.Popen([*on, sys.executable, "-m", "labseq", *arguments], text=True, **pipes)


class Server:
    """A process that serves devices, and when it printed what."""

    def __init__(self, folder: Path, computer: str, devices: Sequence[str]) -> None:
        self.lines: list[tuple[float, str]] = []
        names = [f"--device={name}" for name in devices]
        bind = f"--bind=tcp://{COMPUTERS[computer]}:5760"
        profile = str(folder / "served.yaml")
        pipe = subprocess.PIPE
        self.process = start(folder, computer, "serve-devices", profile, bind, *names, stdout=pipe)
        serves = threading.Event()
        threading.Thread(target=self._read, args=[serves], daemon=True).start()
        assert serves.wait(300.0), f"the server of {devices} does not start"

    def _read(self, serves: threading.Event) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append((time.monotonic(), line.strip()))
            if " serves " in line:
                serves.set()


def events(folder: Path) -> list[dict[str, Any]]:
    """The events of the run in a folder so far."""
    lines = [line for path in folder.glob("*/*/events.jsonl") for line in path.read_text().splitlines()]
    return [json.loads(line) for line in lines if line.endswith("}")]


def pull(servers: Mapping[str, Server], folder: Path, computer: str) -> None:
    """Pull a cable in the middle of a shot, and print what follows."""
    runs = Path(tempfile.mkdtemp(dir=folder))
    arguments = ("run", str(folder / "small.yaml"), "--shots", "50", "--output", str(runs))
    pipe = subprocess.PIPE
    client = start(folder, "control", *arguments, stdout=subprocess.DEVNULL, stderr=pipe)
    while "shot_started" not in [one["event"] for one in events(runs)]:
        assert client.poll() is None, client.communicate()[1]
        time.sleep(0.01)
    time.sleep(random.uniform(0.0, 1.0))
    begun_s, begun_utc = time.monotonic(), now()
    cable(computer, "down")
    message = " ".join(client.communicate(timeout=120.0)[1].split())
    took_s = time.monotonic() - begun_s
    print(f"\ncable of {computer}: exit code {client.returncode} after {took_s:.2f} s: {message}")
    for one in events(runs):
        if one["event"] == "safe_state":
            at_s = (datetime.fromisoformat(one["t_utc"]) - begun_utc).total_seconds()
            outcome = "safe" if one["values"]["ok"] else one["values"]["error"]
            print(f"  {at_s:6.2f} s run reports: {one['values']['device']}: {outcome}")
    time.sleep(2.0)
    for name, server in servers.items():
        for at_s, line in server.lines:
            if at_s > begun_s:
                print(f"  {at_s - begun_s:6.2f} s {name}: {line}", flush=True)
    cable(computer, "up")


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--computers", nargs="*", default=[*COMPUTERS])
    options = parser.parse_args()
    if sys.platform != "linux" or os.geteuid() != 0:
        parser.error("network namespaces need root, on Linux")
    with tempfile.TemporaryDirectory() as name, connected():
        folder = Path(name)
        exchange_keys(folder)
        (folder / "served.yaml").write_text(PROFILE, encoding="utf-8")
        at = {
            device: f"address: 'tcp://{COMPUTERS[computer]}:5760', server_key: {computer}"
            for computer, devices in SERVED.items()
            for device in devices
        }
        write_client(folder, at, load="1 s")
        servers: dict[str, Server] = {}
        try:
            for computer, devices in SERVED.items():
                servers[computer] = Server(folder, computer, devices)
            for computer in options.computers:
                pull(servers, folder, computer)
        finally:
            for server in servers.values():
                server.process.terminate()
                server.process.wait()


if __name__ == "__main__":
    main()
