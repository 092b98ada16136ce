"""A lab with a lamp that outlives its process, and what may happen to a run that has turned it on.

``python -m tests.system.lamps --repeats 20`` prints how long the lamp stays on, for each cause.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from tests.remote.conftest import free_port

PLUGIN: Final = """
import os, pathlib, runpy
import labseq
from labseq.plugin import Emergency

LABSEQ_API = 1
FOLDER = pathlib.Path(os.environ["LAMPS_FOLDER"])
SCRIPT = FOLDER / "emergency.py"
OFF = runpy.run_path(str(SCRIPT))["off"]


class Settings(labseq.plugin.Settings):
    def identities(self):
        return ["the lamp"]


class Lamp:
    def __init__(self, settings, context): pass
    def open(self):
        if os.environ.get("LAMPS_HOLDS_PORT"):  # as a serial line, which only one process can open
            import fcntl
            self._port = (FOLDER / "port").open("w")
            fcntl.flock(self._port, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self.is_open = True
    def close(self): pass
    def safe_state(self):
        if (FOLDER / "refuses").exists() or (os.environ.get("LAMPS_HOLDS_PORT") and not self.is_open):
            raise OSError("the lamp does not answer")
        OFF(str(FOLDER))
    def describe(self): return {}
    def command(self, name, **arguments): (FOLDER / "on").touch()
    def read(self, name): pass
    is_open = False
    def emergency(self): return Emergency(SCRIPT, {"folder": str(FOLDER)})


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.device("lamp", Lamp, Settings)
"""
EMERGENCY: Final = """
import pathlib, time

def off(folder):
    on = pathlib.Path(folder, "on")
    if on.exists():
        pathlib.Path(folder, "off").write_text(str(time.monotonic()))
        on.unlink()
    return "off"
"""
FAULTS: Final = """
import os, pathlib, resource, signal, time

FOLDER, FSYNC = pathlib.Path(os.environ["LAMPS_FOLDER"]), os.fsync


def fsync(fd):
    fault = FOLDER / "fault"
    what = fault.read_text() if fault.exists() else ""
    if what == "disk" or what.startswith("memory"):
        fault.unlink()
        (FOLDER / "began").write_text(str(time.monotonic()))
    if what == "disk":  # as in the kernel: this thread returns never, and no signal reaches it
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        os.read(os.pipe()[0], 1)
    if what.startswith("memory"):
        size = int(pathlib.Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        size += int(what.split()[1])
        resource.setrlimit(resource.RLIMIT_AS, (size, size))
    if what == "slow":
        time.sleep(2.0)
    return FSYNC(fd)


os.fsync = fsync
"""
PROFILE: Final = """
labseq: 1
name: lamps
grid: {rows: 3, cols: 3, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
detector: {use: threshold, frame: [64, 64], centre_px: [31.5, 31.5]}
simulation: {use: virtual, image: {frame: [64, 64], centre_px: [31.5, 31.5]}}
devices: {lamp: {use: lamp}}
plugin_folders: [plugins]
"""
SEQUENCE: Final = """
labseq: 1
name: lamps
profile: ./lamps.yaml
shots: 100000
target: {pattern: compact, rows: 2, cols: 2}
shot:
  - device: {name: lamp, do: "on"}
  - load: {duration: 1 ms}
  - image: {exposure: 1 ms}
"""


class Lamps:
    """The folder of the lab, and a run in it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "plugins").mkdir()
        (folder / "faults").mkdir()
        files = {"plugins/lamp.py": PLUGIN, "emergency.py": EMERGENCY, "faults/sitecustomize.py": FAULTS}
        files |= {"lamps.yaml": PROFILE, "run.yaml": SEQUENCE}
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
        self.environment = {
            **os.environ,
            "LABSEQ_DATA": str(folder / "data"),
            "LABSEQ_LOCKS": str(folder / "locks"),
            "LABSEQ_STATE": str(folder / "state"),
            "LAMPS_FOLDER": str(folder),
            "PYTHONPATH": str(folder / "faults"),
        }

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """Start a command."""
        with (self.folder / "output").open("a") as output:  # a stopped watchdog keeps a pipe open
            return subprocess.Popen(
                [sys.executable, "-m", "labseq", *arguments],
                cwd=self.folder,
                env=self.environment,
                text=True,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                preexec_fn=_with_signals,  # noqa: PLW1509 - no threads hold locks that it needs
            )

    @contextmanager
    def run(self, *arguments: str) -> Generator[subprocess.Popen[str]]:
        """A run that has turned the lamp on and written a shot."""
        process = self.start("run", "run.yaml", *arguments)
        try:
            until(lambda: process.poll() is not None or (self.is_on and self.n_shots > 1))
            assert process.poll() is None, self.output
            yield process
        finally:
            process.kill()
            process.wait()
            (self.folder / "fault").unlink(missing_ok=True)

    @contextmanager
    def served(self) -> Generator[subprocess.Popen[str]]:
        """A server of the lamp; ``far.yaml`` is a profile that uses it."""
        port = free_port(4)
        address = f"tcp://127.0.0.1:{port}"
        far = PROFILE.replace("{use: lamp}", f"{{use: remote, address: '{address}', device: lamp}}")
        (self.folder / "far.yaml").write_text(far, encoding="utf-8")
        process = self.start("serve-devices", "lamps.yaml", "--plain", "--bind", address)
        try:
            until(lambda: process.poll() is not None or "Ctrl-C ends it" in self.output)
            yield process
        finally:
            process.kill()
            process.wait()

    @property
    def output(self) -> str:
        """What the commands have printed."""
        return (self.folder / "output").read_text()

    @property
    def is_on(self) -> bool:
        """Whether the lamp is on."""
        return (self.folder / "on").exists()

    @property
    def n_shots(self) -> int:
        """Shots that were written."""
        return sum(path.read_bytes().count(b"\n") for path in self.folder.glob("data/*/*/index.jsonl"))

    def fault(self, what: str) -> float:
        """Have a fault happen in the run; returns when it did."""
        (self.folder / "began").unlink(missing_ok=True)
        (self.folder / "fault").write_text(what, encoding="utf-8")
        until((self.folder / "began").exists)
        time.sleep(0.01)
        return float((self.folder / "began").read_text())

    def off_after_s(self, begun_s: float, limit_s: float = 20.0) -> float:
        """How long the lamp stayed on.

        Raises:
            AssertionError: It is still on.
        """
        until(lambda: not self.is_on, limit_s)
        return float((self.folder / "off").read_text()) - begun_s


def _with_signals() -> None:
    """A process that ignored a signal would have its child ignore it."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def until(condition: Callable[[], bool], limit_s: float = 60.0) -> None:
    """Wait for something."""
    deadline_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline_s, "it did not happen in time"
        time.sleep(0.002)


def watchdog_of(process: subprocess.Popen[str]) -> int:
    """The process of a run's watchdog.

    Raises:
        AssertionError: It has none now.
    """
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((path / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == process.pid and b"watchdog.py" in (path / "cmdline").read_bytes():
                return int(path.name)
        except (OSError, ValueError):  # it has ended
            continue
    raise AssertionError("the run has no watchdog")


def disk_hangs(lamps: Lamps, process: subprocess.Popen[str]) -> float:
    """The disk does not answer any more."""
    return lamps.fault("disk")


def _disk_hangs_then(number: int, n: int) -> Callable[[Lamps, subprocess.Popen[str]], float]:
    def act(lamps: Lamps, process: subprocess.Popen[str]) -> float:
        lamps.fault("disk")
        for _ in range(n):
            time.sleep(0.3)
            process.send_signal(number)
        return time.monotonic()

    return act


def no_memory(lamps: Lamps, process: subprocess.Popen[str]) -> float:
    """The system gives the run no more memory, except a little."""
    return lamps.fault(f"memory {9 << 20}")


def _watchdog_first(before_s: float, number: int) -> Callable[[Lamps, subprocess.Popen[str]], float]:
    def act(lamps: Lamps, process: subprocess.Popen[str]) -> float:
        os.kill(watchdog_of(process), number)
        time.sleep(before_s)
        begun_s = time.monotonic()
        process.kill()
        return begun_s

    return act


def watchdog_killed_often(lamps: Lamps, process: subprocess.Popen[str]) -> float:
    """The watchdog is killed again and again, then the run."""
    for _ in range(5):
        until(lambda: _has_watchdog(process))
        os.kill(watchdog_of(process), signal.SIGKILL)
        time.sleep(0.5)
    begun_s = time.monotonic()
    process.kill()
    return begun_s


def _has_watchdog(process: subprocess.Popen[str]) -> bool:
    try:
        return watchdog_of(process) > 0
    except AssertionError:
        return False


Cause = Callable[[Lamps, subprocess.Popen[str]], float]
"""Happens to a run; returns when it did."""

CAUSES: Final[dict[str, Cause]] = {
    "the disk hangs": disk_hangs,
    "the disk hangs, Ctrl-C twice": _disk_hangs_then(signal.SIGINT, 2),
    "the disk hangs, SIGTERM twice": _disk_hangs_then(signal.SIGTERM, 2),
    "no memory": no_memory,
    "watchdog killed 0.2 s before the run": _watchdog_first(0.2, signal.SIGKILL),
    "watchdog stopped 0.8 s before the run is killed": _watchdog_first(0.8, signal.SIGSTOP),
    "watchdog killed five times, then the run": watchdog_killed_often,
}


@contextmanager
def lamps() -> Generator[Lamps]:
    """A lab in a folder of its own."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        yield Lamps(Path(folder))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--causes", nargs="+", choices=[*CAUSES], default=[*CAUSES])
    options = parser.parse_args()
    for cause in options.causes:
        times: list[float] = []
        with lamps() as lab:
            for _ in range(options.repeats):
                with lab.run() as process:
                    try:
                        times.append(lab.off_after_s(CAUSES[cause](lab, process)))
                    except AssertionError:
                        (lab.folder / "on").unlink(missing_ok=True)
        times.sort()
        found = f"{times[len(times) // 2]:6.2f} {times[-1]:6.2f} s (median, worst)" if times else ""
        print(f"{cause:50} {found}; not off: {options.repeats - len(times)} of {options.repeats}", flush=True)


if __name__ == "__main__":
    main()
