"""Runs, queues and calibrations under random faults, and what must hold after each: `poe chaos --minutes 60`.

A trial takes a job, interrupts it a few times (kill -9, also after its watchdogs were killed or stopped, a
stopped process, signals, no memory, a full, read-only or stalled disk, a wall clock that is set, a device or
planner that fails), gets it to its end as a user would, with `labseq resume` or the same command again, and
compares it with the same job that nothing interrupted. Its random numbers follow from the seed and the
trial's number alone.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import itertools
import json
import os
import random
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import labseq
from labseq.session.resume import is_over

from .resumable import SHOTS, check_committed, sequence_of, table

LONGEST_S: Final = 600.0
"""A command that takes longer hangs, however busy the computer is."""

PLUGIN: Final = '''
"""The virtual devices and PSCA: they note each call and what is on, and fail where CHAOS_FAULT says."""
import os
import pathlib
import threading
import time

from labseq.plugin import Emergency, hookimpl
from labseq_psca.planner import PscaPlanner, PscaSettings
from labseq_virtual import camera, settings, tweezers

LABSEQ_API = 1
FOLDER = pathlib.Path(os.environ["CHAOS_FOLDER"])
ON = {"load", "start", "play", "arm"}
PAUSE_S = 0.004  # so that faults meet every call


class Broken(BaseException):
    pass


def fail(how):
    (FOLDER / "failed").touch()
    if how == "hangs":
        threading.Event().wait()
    raise {"fails": RuntimeError("rehearsed"), "breaks": Broken(), "exits": SystemExit(0)}[how]


def watched(cls, role):
    def noting(method):
        def call(self, *args, **kwargs):
            if self.__dict__.get("inside"):  # a device that calls itself
                return getattr(cls, method)(self, *args, **kwargs)
            if method in ON:
                (FOLDER / "on" / role).touch()
            with (FOLDER / "calls").open("a") as log:
                log.write(f"{role}.{method}\\n")
            time.sleep(PAUSE_S)
            counts = self.__dict__.setdefault("counts", {})
            counts[method] = counts.get(method, 0) + 1
            failing, n, how = os.environ.get("CHAOS_FAULT", "::").split(":")
            if failing == f"{role}.{method}" and counts[method] == int(n):
                fail(how)
            self.__dict__["inside"] = True
            try:
                return getattr(cls, method)(self, *args, **kwargs)
            finally:
                self.__dict__["inside"] = False
                if method == "safe_state":
                    (FOLDER / "on" / role).unlink(missing_ok=True)

        call.__name__ = method
        return call

    def emergency(self):
        return Emergency(FOLDER / "emergency.py", {"file": str(FOLDER / "on" / role)})

    names = [name for name in dir(cls) if not name.startswith("_") and callable(getattr(cls, name))]
    methods = {name: noting(name) for name in names if name != "emergency"}
    return type("Watched" + cls.__name__, (cls,), {**methods, "emergency": emergency})


class Planner(PscaPlanner):
    """PSCA with faults."""

    n_plans = 0

    def plan(self, *args, **kwargs):
        self.n_plans += 1
        role, n, how = os.environ.get("CHAOS_FAULT", "::").split(":")
        if role == "planner" and self.n_plans == int(n):
            if how == "nonsense":
                return "no plan"
            fail(how)
        return super().plan(*args, **kwargs)


@hookimpl
def labseq_register(registry):
    add = {"virtual_time": True}
    registry.planner("chaos", Planner, PscaSettings)
    registry.camera("chaos", watched(camera.VirtualCamera, "camera"), settings.CameraSettings, **add)
    static = watched(tweezers.VirtualStaticTweezers, "static_tweezers")
    registry.static_tweezers("chaos", static, settings.StaticTweezersSettings, **add)
    mobile = watched(tweezers.VirtualMobileTweezers, "mobile_tweezers")
    registry.mobile_tweezers("chaos", mobile, settings.MobileTweezersSettings, **add)
'''

EMERGENCY: Final = '''
"""Switches a simulated device off."""
import os
import pathlib


def prepare(file):
    on = pathlib.Path(file)
    (on.parent.parent / "watchdogs" / on.name).write_text(str(os.getpid()))


def off(file):
    pathlib.Path(file).unlink(missing_ok=True)
    return "off"
'''

PROFILE: Final = """
labseq: 1
name: chaos
grid: {rows: 10, cols: 10, spacing: 4.49 um}
camera: {use: chaos}
static_tweezers: {use: chaos}
mobile_tweezers: {use: chaos}
detector: {use: threshold}
simulation: {use: virtual}
plugin_folders: [plugins]
timeouts: {call: 3 s, safe_state: 2 s, plan: 3 s}
"""

JOBS: Final = {
    "run": ["run", "run.yaml"],
    "scan": ["run", "scan.yaml"],
    "climb": ["run", "climb.yaml"],
    "queue": ["queue", "run"],
    "calibration": ["calibrate", "thresholds", "--profile", "chaos", "--seed", "7", "--shots", "40"],
}

COMPUTER: Final = '''
"""The wall clock of every process is off by the seconds in a file; another one ends its memory or disk."""
import os
import pathlib
import resource
import signal
import time

FAULT, FSYNC, FULL = pathlib.Path(os.environ["CHAOS_FOLDER"], "fault"), os.fsync, []


def fsync(fd):
    fault = FAULT.read_bytes() if FAULT.exists() else b""
    if fault:
        FAULT.unlink(missing_ok=True)
    if fault == b"disk":  # this thread stands still, and no signal reaches it
        before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        time.sleep(14.0)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    if fault == b"memory":
        size = int(pathlib.Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size, size))
        for n_bytes in (1 << 20, 1 << 14, 1 << 9):
            try:
                while True:
                    FULL.append(bytes(n_bytes))
            except MemoryError:
                pass
    return FSYNC(fd)


os.fsync = fsync

OFFSET, RIGHT = pathlib.Path(os.environ["CHAOS_FOLDER"], "clock"), time.time
time.time = lambda: RIGHT() + float(OFFSET.read_bytes() or 0)
'''


class BrokenPromiseError(AssertionError):
    """What must hold does not."""


@dataclass
class Disturbed:
    """A disturbance of a command, and whether it happened before the command ended."""

    kind: str
    command: str
    fault: str
    happened: bool = False

    def __str__(self) -> str:
        fault = f" {self.fault}" * (self.fault != "::")
        return f"{self.command}: {self.kind}{fault}{', too late' * (not self.happened)}"


@dataclass
class Bench:
    """A disk with all that labseq reads and writes, and a folder in which the devices note what is on."""

    folder: Path
    disk: Path | None
    faults: list[Disturbed] = field(default_factory=list["Disturbed"])

    def __post_init__(self) -> None:
        self.home = self.disk or self.folder
        self.data = self.home / "data"
        (self.home / "plugins").mkdir()
        (self.folder / "on").mkdir()
        (self.folder / "watchdogs").mkdir()
        files = {
            self.home / f"{job}.yaml": sequence_of(job, profile="chaos", planner="chaos") for job in SHOTS
        }
        files |= {self.home / "plugins" / "chaos.py": PLUGIN, self.home / "chaos.yaml": PROFILE}
        own = {"emergency.py": EMERGENCY, "sitecustomize.py": COMPUTER, "clock": ""}
        for path, text in {**files, **{self.folder / name: text for name, text in own.items()}}.items():
            path.write_text(text, encoding="utf-8")
        self.environment = {
            **os.environ,
            "LABSEQ_DATA": str(self.data),
            "LABSEQ_STATE": str(self.home / "state"),
            "LABSEQ_LOCKS": str(self.home / "devices"),
            "CHAOS_FOLDER": str(self.folder),
            "PYTHONPATH": str(self.folder),
            "PYTHONFAULTHANDLER": "1",
            "GIT_DIR": os.devnull,  # edits of the code while this runs are not a change of a run
        }

    def start(self, *arguments: str, fault: str = "::") -> subprocess.Popen[str]:
        """Start a command; ``fault`` is role.method:n:how."""
        return subprocess.Popen(
            [sys.executable, "-m", "labseq", *arguments],
            cwd=self.home,
            env={**self.environment, "CHAOS_FAULT": fault},
            text=True,
            errors="replace",
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )

    def end(self, process: subprocess.Popen[str]) -> str:
        """Wait for the end of a command; returns what it printed."""
        try:
            text, _ = process.communicate(timeout=LONGEST_S)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGABRT)  # prints where each thread is
            text, _ = process.communicate()
            raise BrokenPromiseError(f"hangs: {process.args}\n{text}") from None
        no_memory = any(words in text for words in ("MemoryError", "failed to map segment"))  # of a library
        if not no_memory and ("Traceback" in text or "internal error" in text):
            raise BrokenPromiseError(f"traceback: {process.args}\n{text}")
        return text

    def run(self, *arguments: str) -> str:
        """Run a command that must succeed."""
        process = self.start(*arguments)
        text = self.end(process)
        if process.returncode:
            raise BrokenPromiseError(f"exit code {process.returncode}: {arguments}\n{text}")
        return text

    def n_calls(self) -> int:
        """Number of calls of devices so far."""
        calls = self.folder / "calls"
        return calls.read_bytes().count(b"\n") if calls.exists() else 0

    def await_calls(self, process: subprocess.Popen[str], n: int) -> bool:
        """Wait until devices were called so often; False if the command ended before."""
        deadline = time.monotonic() + LONGEST_S
        while self.n_calls() < n and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.002)
        return process.poll() is None

    def runs(self) -> list[Path]:
        """The folders of all runs, oldest first."""
        return sorted(file.parent for file in self.data.glob("*/*/run.json"))

    def watchdogs(self, process: subprocess.Popen[str]) -> dict[str, int]:
        """Device -> the watchdog of a process that knows it, if it lives."""
        found: dict[str, int] = {}
        for file in (self.folder / "watchdogs").iterdir():
            with contextlib.suppress(OSError, ValueError):  # it is being written, or the process has ended
                status = Path(f"/proc/{int(file.read_text())}/stat").read_text().rpartition(")")[2].split()
                if int(status[1]) == process.pid:
                    found[file.name] = int(file.read_text())
        return found

    def is_on(self) -> list[str]:
        """Devices that are on."""
        return sorted(file.name for file in (self.folder / "on").iterdir())


def result(bench: Bench, job: str) -> Any:
    """What a finished job left: the tables of its runs, or the values of its calibration."""
    if job != "calibration":
        return sorted(
            [table(labseq.open_run(folder)) for folder in bench.runs()], key=repr
        )  # a clock that is set changes names
    found = sorted(bench.home.glob("calibrations/**/thresholds-*.json"))
    return json.loads(found[-1].read_text(encoding="utf-8"))["values"]


def check_after_end(bench: Bench, process: subprocess.Popen[str], text: str) -> None:
    """What must hold once a command has ended, however it did."""
    deadline = time.monotonic() + 2.0
    while (on := bench.is_on()) and time.monotonic() < deadline:  # after a death the watchdog is at work
        time.sleep(0.01)
    if on:
        raise BrokenPromiseError(f"still on after exit code {process.returncode}: {', '.join(on)}\n{text}")
    for run_dir in bench.runs():
        check_committed(run_dir, may_be_torn=True)


Fault = Callable[[Bench, subprocess.Popen[str], random.Random], object]
"""Returns False if it did not succeed."""


def pause(bench: Bench, process: subprocess.Popen[str], chance: random.Random) -> None:
    """Stop the process for less than counts as hanging, then let it continue."""
    process.send_signal(signal.SIGSTOP)
    time.sleep(chance.uniform(0.01, 0.2))
    process.send_signal(signal.SIGCONT)


def freeze(bench: Bench, process: subprocess.Popen[str], chance: random.Random) -> None:
    """Stop the process for so long that its outputs must go off, then let it continue."""
    process.send_signal(signal.SIGSTOP)
    time.sleep(chance.uniform(2.0, 3.0))
    on = bench.is_on() if process.poll() is None else []
    process.send_signal(signal.SIGCONT)
    if on:
        raise BrokenPromiseError(f"still on 2 s after the process was stopped: {', '.join(on)}")


def interrupt(bench: Bench, process: subprocess.Popen[str], chance: random.Random) -> None:
    """Ctrl-C, SIGTERM or the loss of the terminal, perhaps twice."""
    for _ in range(chance.randint(1, 2)):
        process.send_signal(chance.choice([signal.SIGINT, signal.SIGTERM, signal.SIGHUP]))
        time.sleep(chance.uniform(0.0, 0.05))


def set_clock(bench: Bench, process: subprocess.Popen[str], chance: random.Random) -> None:
    """Set the wall clock back or forward, by up to a year."""
    offset_s = chance.choice([-1, 1]) * chance.choice([1, 60, 3600, 86400, 31536000])
    (bench.folder / "clock").write_text(str(offset_s), encoding="utf-8")


def fill_disk(bench: Bench, process: subprocess.Popen[str], chance: random.Random) -> None:
    """Fill the disk until the command has ended; the queue does not end, but waits until there is room."""
    ballast = bench.data.parent / "ballast"
    with contextlib.suppress(OSError), ballast.open("wb") as file:
        while True:
            file.write(bytes(65536))
    deadline = time.monotonic() + 10.0
    while process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.1)
    if process.poll() is None:
        ballast.unlink()


def lock_disk(bench: Bench, process: subprocess.Popen[str], chance: random.Random) -> bool:
    """Make the disk read-only until the command has ended, as soon as no file is open for writing."""
    remount = ["mount", "-o", "remount,ro", str(bench.disk)]
    deadline = time.monotonic() + 1.0
    while process.poll() is None and time.monotonic() < deadline:
        if subprocess.run(remount, check=False, capture_output=True).returncode == 0:
            return True
    return False


def stall_disk(bench: Bench, process: subprocess.Popen[str], chance: random.Random) -> bool:
    """Let the disk stand still for 14 s, longer than the time limit after which the outputs must be off."""
    return _befalls(bench, process, "disk", 8.0)


def take_memory(bench: Bench, process: subprocess.Popen[str], chance: random.Random) -> bool:
    """Give the process no more memory while its devices are open."""
    return bool(bench.watchdogs(process)) and _befalls(bench, process, "memory", 0.0)


def _befalls(bench: Bench, process: subprocess.Popen[str], fault: str, limit_s: float) -> bool:
    """Have a fault come at the next flush to the disk; outputs are off after a time, unless that is 0."""
    file = bench.folder / "fault"
    file.write_text(fault, encoding="utf-8")
    while file.exists() and process.poll() is None:
        time.sleep(0.005)
    if file.exists():
        file.unlink()
        return False
    deadline = time.monotonic() + limit_s
    while time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.05)
    if limit_s and process.poll() is None and (on := bench.is_on()):
        raise BrokenPromiseError(f"still on {limit_s:g} s after the disk stood still: {', '.join(on)}")
    return True


def kill_watchdogs(bench: Bench, process: subprocess.Popen[str], chance: random.Random) -> bool:
    """Kill or stop watchdogs, and the process once another one is ready."""
    for _ in range(chance.randint(1, 4)):
        before = bench.watchdogs(process)
        for pid in set(before.values()):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, chance.choice([signal.SIGKILL, signal.SIGSTOP]))
        while before.keys() != (now := bench.watchdogs(process)).keys() or before.items() & now.items():
            if process.poll() is not None:
                return False
            time.sleep(0.005)
    process.kill()
    return True


DISTURBANCES: Final[dict[str, Fault]] = {
    "kill -9": lambda _, process, __: process.kill(),
    "watchdogs": kill_watchdogs,
    "disk stalls": stall_disk,
    "memory": take_memory,
    "pause": pause,
    "freeze": freeze,
    "signal": interrupt,
    "clock": set_clock,
    "disk full": fill_disk,
    "disk read-only": lock_disk,
}
DEVICE_CALLS: Final = [
    f"{role}.{method}"
    for role, methods in {
        "camera": ("open", "arm", "trigger", "read", "safe_state", "close"),
        "static_tweezers": ("open", "load", "start", "safe_state", "close"),
        "mobile_tweezers": ("open", "prepare", "play", "wait", "safe_state", "close"),
    }.items()
    for method in methods
]


def fault_of(kind: str, chance: random.Random) -> str:
    """Where a device or the planner fails, hangs, exits, raises what cannot be printed, or plans nonsense."""
    ways = ["fails", "hangs", "breaks", "exits"]
    if kind == "planner":
        return f"planner:{chance.randint(1, 20)}:{chance.choice([*ways, 'nonsense'])}"
    if kind != "device":
        return "::"
    call = chance.choice(DEVICE_CALLS)
    n = 1 if call.endswith((".open", ".safe_state", ".close")) else chance.randint(1, 20)
    return f"{call}:{n}:{chance.choice(ways)}"


def repair_machine(bench: Bench) -> None:
    """Put the disk right, as somebody would before going on."""
    if bench.disk is not None:
        subprocess.run(["mount", "-o", "remount,rw", str(bench.disk)], check=True)
        (bench.disk / "ballast").unlink(missing_ok=True)


def disturbed(bench: Bench, command: list[str], chance: random.Random) -> str:
    """Run a command with one disturbance; returns what it printed."""
    kinds = ["device", "planner", *DISTURBANCES]
    if bench.disk is None:
        kinds = [kind for kind in kinds if kind not in ("disk full", "disk read-only")]
    kind = chance.choice(kinds)
    fault = fault_of(kind, chance)
    n = bench.n_calls() + chance.randint(1, 150)
    bench.faults.append(Disturbed(kind, command[0], fault))
    process = bench.start(*command, fault=fault)
    try:
        if kind in DISTURBANCES and bench.await_calls(process, n):
            time.sleep(chance.uniform(0.0, 0.02))
            if process.poll() is None:
                bench.faults[-1].happened = DISTURBANCES[kind](bench, process, chance) is not False
        text = bench.end(process)
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()
    with contextlib.suppress(FileNotFoundError):
        (bench.folder / "failed").unlink()
        bench.faults[-1].happened = True
    repair_machine(bench)
    may_be_unsafe = ".safe_state:" in fault  # the device itself refuses; `labseq safe` must reach it later
    if may_be_unsafe and process.returncode == 3:
        bench.run("safe", "chaos.yaml")
    check_after_end(bench, process, text)
    return text


def next_command(bench: Bench, job: str) -> list[str] | None:
    """The command that gets a job on; None once it is done."""
    if job == "calibration":
        return None if list(bench.home.glob("calibrations/**/thresholds-*.json")) else JOBS[job]
    runs = bench.runs()
    if job == "queue":
        entries = json.loads(bench.run("queue", "list", "--json"))["entries"]
        waiting = [entry for entry in entries if entry["state"] in ("waiting", "running", "interrupted")]
    else:
        waiting = not runs
    if waiting:
        return JOBS[job]
    # a run that failed after its last shot, because a device was not safe, stays failed
    left = [run for run in map(labseq.open_run, runs) if run.status != "complete" and not is_over(run)]
    return ["resume", str(left[0].path)] if left else None


def prepare(bench: Bench, job: str) -> None:
    """Queue what the queue runs."""
    if job == "queue":
        for sequence in ("scan.yaml", "run.yaml"):
            bench.run("queue", "add", sequence)


def trial(bench: Bench, job: str, chance: random.Random, expected: Any) -> None:
    """Take a job to its end through a few disturbances, and compare it with the undisturbed one."""
    prepare(bench, job)
    for _ in range(chance.randint(1, 4)):
        command = next_command(bench, job)
        if command is not None:
            disturbed(bench, command, chance)
    for _ in range(4):
        if (command := next_command(bench, job)) is None:
            break
        bench.run(*command)
    check_in_the_end(bench, job, expected)


def check_in_the_end(bench: Bench, job: str, expected: Any) -> None:
    """What must hold of a job that was got to its end."""
    if (command := next_command(bench, job)) is not None:
        raise BrokenPromiseError(f"not done, however often: {command}")
    bench.run("doctor")
    report = bench.run("doctor", "--dry-run", "--json")
    if json.loads(report)["findings"]:
        raise BrokenPromiseError(f"the doctor leaves damage: {report}")
    for run_dir in bench.runs():
        check_committed(run_dir)
        run = labseq.open_run(run_dir)
        for shot in (*run.shots, *run.attempts):
            shot.verify()
    if result(bench, job) != expected:
        raise BrokenPromiseError("the result differs from that of the undisturbed job")
    if on := bench.is_on():
        raise BrokenPromiseError(f"still on in the end: {', '.join(on)}")


@contextlib.contextmanager
def made_bench(*, small_disk: bool) -> Generator[Bench]:
    """A bench in a folder of its own, if possible with a disk of its own."""
    folder = Path(tempfile.mkdtemp(prefix="labseq-chaos-"))
    disk = folder / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=256m", "tmpfs", str(disk)]
    is_mounted = small_disk and subprocess.run(mount, check=False, capture_output=True).returncode == 0
    try:
        yield Bench(folder, disk if is_mounted else None)
    finally:
        if is_mounted:
            subprocess.run(["umount", "-l", str(disk)], check=True)
        shutil.rmtree(folder, ignore_errors=True)


def undisturbed(job: str) -> Any:
    """The result of a job that nothing interrupts."""
    with made_bench(small_disk=False) as bench:
        prepare(bench, job)
        bench.run(*JOBS[job])
        return result(bench, job)


def one_trial(seed: int, number: int, expected: dict[str, Any]) -> tuple[str, list[Disturbed], str]:
    """Job, disturbances, and what does not hold ("" if all does) of a trial."""
    chance = random.Random(f"{seed}/{number}")
    job = chance.choice(list(JOBS))
    with made_bench(small_disk=True) as bench:
        try:
            trial(bench, job, chance, expected[job])
        except BrokenPromiseError as error:
            return job, bench.faults, str(error)
        except Exception:  # noqa: BLE001 - reported with the others
            return job, bench.faults, traceback.format_exc()
        return job, bench.faults, ""


def print_table(counts: collections.Counter[tuple[str, str]]) -> None:
    """Print the number of disturbances by job."""
    kinds = ["device", "planner", *DISTURBANCES]
    print(f"{'':12}" + "".join(f"{kind:>16}" for kind in kinds))
    for job in JOBS:
        print(f"{job:12}" + "".join(f"{counts[job, kind]:16}" for kind in kinds))


def main(arguments: list[str] | None = None) -> int:
    """Take trials until the time is over; returns 1 if anything did not hold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=secrets.randbits(32))
    parser.add_argument("--trial", type=int, default=None, help="only this one")
    chosen = parser.parse_args(arguments)
    counts: collections.Counter[tuple[str, str]] = collections.Counter()
    deadline = time.monotonic() + 60 * chosen.minutes
    numbers = itertools.count() if chosen.trial is None else iter([chosen.trial])
    n_processes = os.cpu_count() or 1

    def take_some() -> Iterator[tuple[str, list[Disturbed], str]]:
        for number in numbers:
            job, faults, why = one_trial(chosen.seed, number, expected)
            if why:
                done = "; ".join(map(str, faults))
                print(f"--seed {chosen.seed} --trial {number} ({job}: {done}): {why}", flush=True)
            yield job, faults, why
            if time.monotonic() > deadline:
                return

    with ThreadPoolExecutor(n_processes) as pool:
        expected = dict(zip(JOBS, pool.map(undisturbed, JOBS), strict=True))
        taken = [*itertools.chain(*pool.map(lambda _: [*take_some()], range(n_processes)))]
    for job, faults, _ in taken:
        counts.update((job, fault.kind) for fault in faults if fault.happened)
    n_late = sum(not fault.happened for _, faults, _ in taken for fault in faults)
    n_failures = sum(bool(why) for *_, why in taken)
    print(f"seed {chosen.seed}: {len(taken)} trials, {n_failures} in which something did not hold")
    print(f"{counts.total()} disturbances, and {n_late} that came too late:")
    print_table(counts)
    return 1 if n_failures else 0


if __name__ == "__main__":
    sys.exit(main())
