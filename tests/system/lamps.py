"""A lab with a lamp that outlives its process, and what may happen to a run that has turned it on.

``python -m tests.system.lamps --repeats 20`` prints how long the lamp stays on, for each cause;
``--shots 20000`` takes a long run to which nothing happens, and prints what its watchdog reported.
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Final

from labseq.wire import new_keys
from tests.remote.conftest import free_port

PLUGIN: Final = """
import os, pathlib, runpy
import labseq
from labseq.plugin import Emergency

LABSEQ_API = 1
FOLDER = pathlib.Path(os.environ["LAMPS_FOLDER"])
PORT = str(FOLDER / "port") if "LAMPS_HOLDS_PORT" in os.environ else ""
OPENED = []
SCRIPT = FOLDER / "emergency.py"
OFF = runpy.run_path(str(SCRIPT))["off"]


class Settings(labseq.plugin.Settings):
    def identities(self):
        return ["the lamp"]


class Lamp(labseq.plugin.Device):
    def __init__(self, settings, context): pass
    def open(self):
        if PORT and not OPENED:  # as a serial line, which only one process can open
            import fcntl
            line = open(PORT, "w")
            fcntl.flock(line, fcntl.LOCK_EX | fcntl.LOCK_NB)
            OPENED.append(line)
    def close(self): pass  # the line stays open until the process ends
    def safe_state(self):
        if (FOLDER / "refuses").exists() or (PORT and not OPENED):
            raise OSError("the lamp does not answer")
        OFF(str(FOLDER))
    def describe(self): return {}
    def command(self, name, **arguments): (FOLDER / "on").touch()
    def read(self, name): pass
    def emergency(self): return Emergency(SCRIPT, {"folder": str(FOLDER), "port": PORT})


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.device("lamp", Lamp, Settings)
"""
EMERGENCY: Final = """
import os, pathlib, time

def prepare(folder, port):
    if pathlib.Path(folder, "no watchdog").exists():
        os._exit(1)
    pathlib.Path(folder, "watchdog").write_text(str(os.getpid()))

def off(folder, port=""):
    if port:
        import fcntl
        with open(port, "w") as line:
            fcntl.flock(line, fcntl.LOCK_EX | fcntl.LOCK_NB)
    on = pathlib.Path(folder, "on")
    if on.exists():
        pathlib.Path(folder, "off").write_text(str(time.monotonic()))
        on.unlink()
    return "off"
"""
FAULTS: Final = """
import os, pathlib, resource, signal, time

FOLDER, FSYNC = pathlib.Path(os.environ["LAMPS_FOLDER"]), os.fsync
FULL = []


def fsync(fd):
    fault = FOLDER / "fault"
    what = fault.read_text() if fault.exists() else ""
    if what:
        (FOLDER / "began").write_text(str(time.monotonic()))
    if what not in ("", "slow"):
        fault.unlink()
    if what == "disk":  # as in the kernel: this thread returns never, and no signal reaches it
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        os.read(os.pipe()[0], 1)
    if what.startswith("memory"):
        size = int(pathlib.Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size, size))
        for n_bytes in (1 << 20, 1 << 14, 1 << 9):
            try:
                while True:
                    FULL.append(bytes(n_bytes))
            except MemoryError:
                pass
        left = int(what.split()[1])
        while left > 0:
            left -= len(FULL.pop(0))
    if what == "slow":
        time.sleep(2.0)
    return FSYNC(fd)


os.fsync = fsync
"""
STRANGERS: Final = """
import socket, sys, time
port, n = int(sys.argv[1]), int(sys.argv[2])
made = [None] * n
while True:
    for k in range(n):
        try:
            if made[k] is None:
                made[k] = socket.create_connection(("127.0.0.1", port + k % 2), timeout=0.2)
                made[k].setblocking(False)
            elif not made[k].recv(100):
                made[k] = None
        except BlockingIOError:
            pass
        except OSError:
            made[k] = None
    time.sleep(0.01)
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
alarms: {stop_after: 0}
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
        self.port = 0
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

    def start(
        self, *arguments: str, limits: Mapping[str, tuple[int, int]] = MappingProxyType({})
    ) -> subprocess.Popen[str]:
        """Start a command, with limits of its resources."""

        def prepare() -> None:
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                signal.signal(
                    number, signal.SIG_DFL
                )  # a process that ignored one would have its child ignore it
            for name, limit in limits.items():
                resource.setrlimit(getattr(resource, name), limit)

        with (self.folder / "output").open("a") as output:  # a stopped watchdog keeps a pipe open
            return subprocess.Popen(
                [sys.executable, "-m", "labseq", *arguments],
                cwd=self.folder,
                env=self.environment,
                text=True,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                preexec_fn=prepare,  # noqa: PLW1509 - no threads hold locks that it needs
            )

    def in_terminal(self, typed: str, *arguments: str) -> tuple[int, str]:
        """Carry out a command in a terminal; returns its exit code, and what it printed."""
        ours, theirs = os.openpty()
        os.write(ours, typed.encode())
        command = [sys.executable, "-m", "labseq", *arguments]
        with subprocess.Popen(
            command, cwd=self.folder, env=self.environment, stdin=theirs, stdout=theirs, stderr=theirs
        ) as process:
            os.close(theirs)
            code = process.wait(60.0)
        said = os.read(ours, 1 << 16).decode()
        os.close(ours)
        return code, said

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
    def served(self, *, keys: bool = False, n_files: int = 0) -> Generator[subprocess.Popen[str]]:
        """A server of the lamp; ``far.yaml`` is a profile that uses it.

        Args:
            keys: Whether it has keys.
            n_files: Number of files that it may open; 0 for the computer's limit.
        """
        self.port = free_port(4)
        address, key = f"tcp://127.0.0.1:{self.port}", ", server_key: here" if keys else ""
        far = PROFILE.replace("{use: lamp}", f"{{use: remote, address: '{address}', device: lamp{key}}}")
        (self.folder / "far.yaml").write_text(far, encoding="utf-8")
        limit = {"RLIMIT_NOFILE": (n_files, n_files)} if n_files else {}
        options = [] if keys else ["--plain"]
        process = self.start("serve-devices", "lamps.yaml", "--bind", address, *options, limits=limit)
        try:
            until(lambda: process.poll() is not None or "Ctrl-C stops it" in self.output)
            yield process
        finally:
            process.kill()
            process.wait()

    def make_keys(self, folder: Path) -> None:
        """Make the key of this computer, which knows itself."""
        _, public = new_keys("here", folder)
        (folder / "known" / "here.key").write_bytes(public.read_bytes())
        self.environment["LABSEQ_KEYS"] = str(folder)

    @contextmanager
    def strangers(self, n: int) -> Generator[None]:
        """Connections to the ports of the server that say nothing, made again when they are closed."""
        with subprocess.Popen([sys.executable, "-c", STRANGERS, str(self.port), str(n)]) as process:
            time.sleep(1.0)
            try:
                yield
            finally:
                process.kill()

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

    @property
    def watchdog(self) -> int:
        """The process of the watchdog that was the last one to be ready."""
        return int((self.folder / "watchdog").read_text() or 0)

    def replaced_after_s(self, number: int) -> float:
        """Send a signal to the watchdog; returns after how long another one is ready."""
        before, begun_s = self.watchdog, time.monotonic()
        os.kill(before, number)
        until(lambda: self.watchdog not in (0, before))
        return time.monotonic() - begun_s

    def interrupt(self, process: subprocess.Popen[str]) -> int:
        """Ctrl-C; returns the exit code."""
        process.send_signal(signal.SIGINT)
        return process.wait(60.0)

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


def until(condition: Callable[[], bool], limit_s: float = 60.0) -> None:
    """Wait for something."""
    deadline_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline_s, "it did not happen in time"
        time.sleep(0.002)


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


def _no_memory(left: int) -> Callable[[Lamps, subprocess.Popen[str]], float]:
    """The system gives the run no more memory; if it goes on with what it has, Ctrl-C comes."""

    def act(lamps: Lamps, process: subprocess.Popen[str]) -> float:
        n_before = lamps.n_shots
        begun_s = lamps.fault(f"memory {left}")
        until(lambda: not lamps.is_on or lamps.n_shots > n_before + 5)
        if lamps.is_on:
            process.send_signal(signal.SIGINT)
            return time.monotonic()
        return begun_s

    return act


def _watchdog_first(before_s: float) -> Callable[[Lamps, subprocess.Popen[str]], float]:
    """The watchdog is killed, and soon after it the run."""

    def act(lamps: Lamps, process: subprocess.Popen[str]) -> float:
        os.kill(lamps.watchdog, signal.SIGKILL)
        time.sleep(before_s)
        return _kill(process)

    return act


def _watchdogs_first(number: int, n: int) -> Callable[[Lamps, subprocess.Popen[str]], float]:
    """Watchdogs are killed or stopped; once another one has taken the place of the last, the run."""

    def act(lamps: Lamps, process: subprocess.Popen[str]) -> float:
        for _ in range(n):
            lamps.replaced_after_s(number)
        return _kill(process)

    return act


def _kill(process: subprocess.Popen[str]) -> float:
    begun_s = time.monotonic()
    process.kill()
    return begun_s


Cause = Callable[[Lamps, subprocess.Popen[str]], float]
"""Happens to a run; returns when it did."""

CAUSES: Final[dict[str, Cause]] = {
    "the disk hangs": disk_hangs,
    "the disk hangs, Ctrl-C twice": _disk_hangs_then(signal.SIGINT, 2),
    "the disk hangs, SIGTERM twice": _disk_hangs_then(signal.SIGTERM, 2),
    "no memory": _no_memory(0),
    "no memory beyond 100 kB": _no_memory(100_000),
    "no memory beyond 9 MB": _no_memory(9_000_000),
    "watchdog replaced after SIGKILL, then the run": _watchdogs_first(signal.SIGKILL, 5),
    "watchdog replaced after SIGSTOP, then the run": _watchdogs_first(signal.SIGSTOP, 1),
}
TOO_SOON: Final = {
    f"watchdog killed {1e3 * before_s:.0f} ms before the run": _watchdog_first(before_s)
    for before_s in (0.0, 0.05, 0.1, 0.2, 0.5)
}
"""What a single watchdog cannot cover: both processes die within the time that another one takes to start."""


@contextmanager
def lamps() -> Generator[Lamps]:
    """A lab in a folder of its own."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        yield Lamps(Path(folder))


def print_replacements(repeats: int) -> None:
    """Print how long it takes until another watchdog is ready."""
    with lamps() as lab, lab.run():
        for number in (signal.SIGKILL, signal.SIGSTOP):
            times = sorted(lab.replaced_after_s(number) for _ in range(repeats))
            print(
                f"{number.name}: {times[len(times) // 2]:.3f} {times[-1]:.3f} s (median, worst of {repeats})"
            )


def print_alarms(n_shots: int) -> None:
    """Take a run to which nothing happens, and print how it ended and what its watchdog reported: nothing."""
    with lamps() as lab, lab.run("--shots", str(n_shots)) as process:
        watchdog, begun_s = lab.watchdog, time.monotonic()
        code = process.wait()
        reports = [path.read_text() for path in lab.folder.glob("data/*/*/watchdog.jsonl")]
        per_shot_ms = (time.monotonic() - begun_s) / n_shots * 1e3
        print(
            f"{lab.n_shots} shots, {per_shot_ms:.0f} ms each; exit code {code}; reports: {reports or 'none'}"
        )
        print(f"the watchdog was {'the same' if lab.watchdog == watchdog else 'replaced'} at the end")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--replacements", action="store_true", help="how long they take instead")
    parser.add_argument("--causes", nargs="+", choices=[*CAUSES, *TOO_SOON], default=[*CAUSES])
    parser.add_argument("--shots", type=int, help="take so many shots instead, and look for false alarms")
    options = parser.parse_args()
    if options.shots:
        print_alarms(options.shots)
        return
    if options.replacements:
        print_replacements(options.repeats)
        return
    for cause in options.causes:
        times: list[float] = []
        with lamps() as lab:
            for _ in range(options.repeats):
                with lab.run() as process:
                    try:
                        times.append(lab.off_after_s({**CAUSES, **TOO_SOON}[cause](lab, process)))
                    except AssertionError:
                        (lab.folder / "on").unlink(missing_ok=True)
        times.sort()
        found = f"{times[len(times) // 2]:6.2f} {times[-1]:6.2f} s (median, worst)" if times else ""
        print(f"{cause:50} {found}; not off: {options.repeats - len(times)} of {options.repeats}", flush=True)


if __name__ == "__main__":
    main()
