"""Devices on three computers, which are network namespaces of this one, and what a pulled cable does.

``python -m tests.remote.cables`` as root on Linux, with `ip` (package iproute2). `camera-pc` serves the
cameras of `bench`, `awg-pc` all other devices and the simulation, and `control` runs `compact_225`, all with
keys. The data are compared with those of plain `bench`; then the cable of each computer is pulled in the
middle of a shot (nothing arrives any more, and no connection ends), and plugged in again.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from labseq.plain import now
from labseq.wire import new_keys
from tests.remote.apart import (
    SHOT_S,
    Client,
    Server,
    identical,
    print_reports,
    print_safe_states,
    serving_apart,
)

COMPUTERS: Final = {"control": "10.123.45.1", "camera-pc": "10.123.45.2", "awg-pc": "10.123.45.3"}
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


def prefix(folder: Path, computer: str) -> list[str]:
    """What carries out a command on a computer, with its keys."""
    return ["ip", "netns", "exec", namespace(computer), "env", f"LABSEQ_KEYS={folder / computer}"]


def exchange_keys(folder: Path) -> None:
    """A key for each computer, and its public part for the others."""
    for computer in COMPUTERS:
        _, public = new_keys(computer, folder / computer)
        for other in COMPUTERS:
            known = folder / other / "known" / public.name
            known.parent.mkdir(parents=True, exist_ok=True)
            known.write_bytes(public.read_bytes())


def pull(servers: Mapping[str, Server], folder: Path, computer: str) -> None:
    """Pull a cable in the middle of a shot, and print what follows."""
    client = Client(folder, 50, prefix(folder, "control"))
    client.await_shot()
    time.sleep(random.uniform(0.0, SHOT_S))
    begun_s, begun_utc = time.monotonic(), now()
    cable(computer, "down")
    code, message = client.end()
    print(f"\ncable of {computer}: exit code {code} after {time.monotonic() - begun_s:.2f} s: {message}")
    print_safe_states(client, begun_utc)
    time.sleep(2.0)
    print_reports(servers, begun_s)
    cable(computer, "up")


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shots", type=int, default=2, help="of the runs that are compared; 0: none")
    parser.add_argument("--computers", nargs="*", default=[*COMPUTERS])
    options = parser.parse_args()
    if sys.platform != "linux" or os.geteuid() != 0:
        parser.error("network namespaces need root, on Linux")
    with tempfile.TemporaryDirectory() as name, connected():
        folder = Path(name)
        exchange_keys(folder)
        devices = {
            "awg-pc": ("simulation", "static_tweezers", "mobile_tweezers", "lines", "shutter"),
            "camera-pc": ("camera", "trap_camera"),
        }
        servers = {
            one: Server(names, COMPUTERS[one], 5760, one, prefix(folder, one))
            for one, names in devices.items()
        }
        with serving_apart(folder, servers):
            if options.shots:
                same = identical(folder, options.shots, prefix(folder, "control"))
                print(f"{options.shots} shots: {'identical' if same else 'DIFFERENT'}", flush=True)
            for computer in options.computers:
                pull(servers, folder, computer)


if __name__ == "__main__":
    main()
