"""A shutter and a timing box that outlive the process that drives them, and processes that end badly."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from .labseq_serial_rig import Counterpart

DRIVING = """
import ctypes, os, signal, sys, time
from pathlib import Path
from labseq_serial.device import SerialDevice
from labseq_ttl.go_lines import ttl_lines
from labseq_ttl.settings import TtlSettings
from labseq.plugin import Context
from labseq.testing.contracts.instruments import SPECS
from labseq.testing.fakes import FakeClock
from labseq.watchdog import Watchdog
from tests.plugins.labseq_serial_rig import settings

def drive(folder, cause):
    clock = FakeClock()
    shutter = SerialDevice(settings(port=str(folder / "port")), Context("shutter", clock=clock))
    lines = ttl_lines(TtlSettings(port=str(folder / "box")), Context("lines", clock=clock, lines=SPECS))
    dog = Watchdog("the run", folder / "watchdog.jsonl")
    for order, (name, device) in enumerate({"shutter": shutter, "lines": lines}.items()):
        device.open()
        found = device.emergency()
        dog.add(name, order, found.script, dict(found.arguments))
    shutter.command("open")
    lines._opened().set_lines(4)
    print("on", *dog.notes(), flush=True)
    sys.stdin.readline()
    print(time.monotonic(), flush=True)
    exec(cause)

for cause in sys.stdin:
    if child := os.fork():
        os.waitpid(child, 0)
    else:
        drive(Path(sys.argv[1]), cause)
"""
CAUSES: Final = {
    "kill -9": "os.kill(os.getpid(), signal.SIGKILL)",
    "os._exit": "os._exit(1)",
    "SIGSTOP": "os.kill(os.getpid(), signal.SIGSTOP)",
    "C call": "ctypes.PyDLL(None).sleep(60)",
}
"""What ends or stops the process."""


class TtlCounterpart(Counterpart):
    """A timing box on a pty, in a process of its own."""

    def __init__(self, folder: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("labseq_ttl_counterpart.py")), str(folder / "box")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.order("state")


class Outputs:
    """The two devices, and a process that has a child drive them."""

    def __init__(self, folder: Path, shutter: Counterpart, lines: Counterpart) -> None:
        self._folder, self._shutter, self._lines = folder, shutter, lines
        root = str(Path(__file__).parents[2])
        self._process = subprocess.Popen(
            [sys.executable, "-c", DRIVING, str(folder)],
            cwd=root,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": root},
        )

    def _ask(self, line: str) -> str:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        return self._process.stdout.readline()

    def close(self) -> None:
        """End the process."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.communicate()

    def off_since(self) -> dict[str, float | None]:
        """Device -> None while it is on, else when it went off."""
        values, commanded_s = self._shutter.order("state")
        on, since_s = self._lines.order("state")
        return {
            "shutter": None if values["open"] == "1" else commanded_s,
            "lines": None if on else since_s,
        }

    def times_to_off(self, cause: str) -> dict[str, float]:
        """Have a process turn both on and end or hang; how long each stays on, in seconds."""
        (self._folder / "watchdog.jsonl").unlink(missing_ok=True)
        assert self._ask(CAUSES[cause]) == "on\n"
        assert set(self.off_since().values()) == {None}
        begun_s = float(self._ask(""))
        deadline_s = time.monotonic() + 20.0
        while len(log_rows(self._folder)) < 2 and time.monotonic() < deadline_s:
            time.sleep(5e-3)
        return {name: since_s - begun_s for name, since_s in self.off_since().items() if since_s is not None}


@contextmanager
def outputs(folder: Path, *, driven: bool = True) -> Generator[Outputs]:
    """A shutter and a timing box, driven by a process unless somebody else does."""
    with Counterpart(folder) as shutter, TtlCounterpart(folder) as lines:
        devices = Outputs(folder, shutter, lines)
        if not driven:
            devices.close()
        try:
            yield devices
        finally:
            devices.close()


def log_rows(folder: Path) -> list[dict[str, object]]:
    """What the watchdog wrote down."""
    file = folder / "watchdog.jsonl"
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
