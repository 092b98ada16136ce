"""A shutter and a timing box that outlive the process that drives them, and processes that end badly."""

from __future__ import annotations

import json
import os
import signal
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

folder = Path(sys.argv[1])
context = Context("lines", clock=FakeClock(), lines=SPECS)
shutter = SerialDevice(settings(port=str(folder / "port")), Context("shutter", clock=FakeClock()))
lines = ttl_lines(TtlSettings(port=str(folder / "box")), context)
dog = Watchdog("the run", folder / "watchdog.jsonl")
for order, (name, device) in enumerate({"shutter": shutter, "lines": lines}.items()):
    device.open()
    found = device.emergency()
    dog.add(name, order, found.script, dict(found.arguments))
print(*dog.notes(), flush=True)
for line in sys.stdin:
    shutter.command("open")
    lines._opened().set_lines(4)
    print("on", flush=True)
    sys.stdin.readline()
    print(time.monotonic(), flush=True)
    exec(sys.argv[2])
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
    """The two devices."""

    def __init__(self, shutter: Counterpart, lines: Counterpart) -> None:
        self._shutter = shutter
        self._lines = lines

    def off_since(self) -> dict[str, float | None]:
        """Device -> None while it is on, else when it went off."""
        values, commanded_s = self._shutter.order("state")
        on, since_s = self._lines.order("state")
        return {
            "shutter": None if values["open"] == "1" else commanded_s,
            "lines": None if on else since_s,
        }

    def times_to_off(self, folder: Path, cause: str) -> dict[str, float]:
        """Have a process turn both on and end or hang; how long each stays on, in seconds.

        The log of the watchdog is in the folder.
        """
        (folder / "watchdog.jsonl").unlink(missing_ok=True)
        command = [sys.executable, "-c", DRIVING, str(folder), CAUSES[cause]]
        root = str(Path(__file__).parents[2])
        process = subprocess.Popen(
            command,
            cwd=root,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": root},
        )
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "\n", "the watchdog has something to say"
            process.stdin.write("\n")
            process.stdin.flush()
            assert process.stdout.readline() == "on\n"
            assert set(self.off_since().values()) == {None}
            process.stdin.write("\n")
            process.stdin.flush()
            begun_s = float(process.stdout.readline())
            deadline_s = time.monotonic() + 20.0
            while len(log_rows(folder)) < 2 and time.monotonic() < deadline_s:
                time.sleep(5e-3)
            off = self.off_since()
            return {name: time_s - begun_s for name, time_s in off.items() if time_s is not None}
        finally:
            process.send_signal(signal.SIGKILL)
            process.communicate()


@contextmanager
def outputs(folder: Path) -> Generator[Outputs]:
    """A shutter and a timing box."""
    with Counterpart(folder) as shutter, TtlCounterpart(folder) as lines:
        yield Outputs(shutter, lines)


def log_rows(folder: Path) -> list[dict[str, object]]:
    """What the watchdog wrote down."""
    file = folder / "watchdog.jsonl"
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
