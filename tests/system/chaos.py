"""Runs, queues and calibrations under random faults, and what must hold after each: `poe chaos --minutes 60`.

A trial takes a job, interrupts it a few times (kill -9, a stopped process, signals, a full or
read-only disk, a wall clock that is set, a device or planner that fails), gets it to its end as a
user would, with `labseq resume` or the same command again, and compares it with the same job
that nothing interrupted. Its random numbers follow from the seed and the trial's number alone.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import os
import random
import secrets
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import labseq

from .resumable import SHOTS, check_committed, sequence_of, table

LONGEST_S: Final = 120.0
"""A command that takes longer hangs."""

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
    def __str__(self):
        raise RuntimeError("no text")

    __repr__ = __str__


def fail(how):
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
import pathlib


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

CLOCK: Final = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

/* The wall clock is off by the seconds in the file CHAOS_CLOCK; every other clock is right. */
int clock_gettime(clockid_t clock, struct timespec *now) {
    static int (*real)(clockid_t, struct timespec *);
    static const volatile long long *offset;
    if (!real) {
        real = dlsym(RTLD_NEXT, "clock_gettime");
        int file = open(getenv("CHAOS_CLOCK"), O_RDONLY);
        void *page = mmap(0, sizeof *offset, PROT_READ, MAP_SHARED, file, 0);
        if (page != MAP_FAILED) offset = page;
        close(file);
    }
    int result = real(clock, now);
    if (clock == CLOCK_REALTIME && offset) now->tv_sec += *offset;
    return result;
}
"""


class BrokenPromiseError(AssertionError):
    """What must hold does not."""


@dataclass
class Bench:
    """A folder with the files of all jobs, a disk for the data, and devices that note what is on."""

    folder: Path
    disk: Path | None
    clock: Path | None
    faults: list[str] = field(default_factory=list[str])

    def __post_init__(self) -> None:
        (self.folder / "plugins").mkdir()
        (self.folder / "on").mkdir()
        files = {"plugins/chaos.py": PLUGIN, "emergency.py": EMERGENCY, "chaos.yaml": PROFILE}
        files |= {f"{job}.yaml": sequence_of(job, profile="chaos", planner="chaos") for job in SHOTS}
        for name, text in files.items():
            (self.folder / name).write_text(text, encoding="utf-8")
        self.data = (self.disk or self.folder) / "data"
        self.environment = {
            **os.environ,
            "LABSEQ_DATA": str(self.data),
            "LABSEQ_STATE": str(self.folder / "state"),
            "LABSEQ_LOCKS": str(self.folder / "devices"),
            "CHAOS_FOLDER": str(self.folder),
            "GIT_DIR": os.devnull,  # edits of the code while this runs are no change of a run
        }
        if self.clock is not None:
            offset = self.folder / "clock"
            offset.write_bytes(struct.pack("q", 0))
            self.environment |= {"LD_PRELOAD": str(self.clock), "CHAOS_CLOCK": str(offset)}

    def start(self, *arguments: str, fault: str = "::") -> subprocess.Popen[str]:
        """Start a command; ``fault`` is role.method:n:how."""
        return subprocess.Popen(
            [sys.executable, "-m", "labseq", *arguments],
            cwd=self.folder,
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
            process.kill()
            text, _ = process.communicate()
            raise BrokenPromiseError(f"hangs: {process.args}\n{text}") from None
        if "Traceback" in text or "internal error" in text:
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

    def is_on(self) -> list[str]:
        """Devices that are on."""
        return sorted(file.name for file in (self.folder / "on").iterdir())

    def set_clock(self, offset_s: int) -> None:
        """Set the wall clock of all commands."""
        with (self.folder / "clock").open("r+b") as file:
            file.write(struct.pack("q", offset_s))

    def remount(self, options: str) -> None:
        """Change the disk of the data."""
        subprocess.run(["mount", "-o", f"remount,{options}", str(self.disk)], check=True)


def result(bench: Bench, job: str) -> Any:
    """What a finished job left: the tables of its runs, or the values of its calibration."""
    if job != "calibration":
        return sorted(
            [table(labseq.open_run(folder)) for folder in bench.runs()], key=repr
        )  # a clock that is set changes names
    found = sorted(bench.folder.glob("calibrations/**/thresholds-*.json"))
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


Fault = Callable[[Bench, subprocess.Popen[str], random.Random], None]


def kill(bench: Bench, process: subprocess.Popen[str], chance: random.Random) -> None:
    """Kill -9."""
    process.kill()


def pause(bench: Bench, process: subprocess.Popen[str], chance: random.Random) -> None:
    """Stop the process for less than counts as hanging, then let it continue."""
    process.send_signal(signal.SIGSTOP)
    time.sleep(chance.uniform(0.01, 0.2))
    process.send_signal(signal.SIGCONT)


def freeze(bench: Bench, process: subprocess.Popen[str], chance: random.Random) -> None:
    """Stop the process for so long that its outputs must go off, then let it continue or kill it."""
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
    bench.set_clock(chance.choice([-1, 1]) * chance.choice([1, 60, 3600, 86400, 31536000]))


def fill_disk(bench: Bench, process: subprocess.Popen[str], chance: random.Random) -> None:
    """Fill the disk until the command has ended."""
    ballast = bench.data.parent / "ballast"
    with contextlib.suppress(OSError), ballast.open("wb") as file:
        while True:
            file.write(bytes(65536))


def lock_disk(bench: Bench, process: subprocess.Popen[str], chance: random.Random) -> None:
    """Make the disk read-only until the command has ended; busy files may prevent it."""
    with contextlib.suppress(subprocess.CalledProcessError):
        subprocess.run(["mount", "-o", "remount,ro", str(bench.disk)], check=True, stderr=subprocess.DEVNULL)


DISTURBANCES: Final[dict[str, Fault]] = {
    "kill -9": kill,
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


def device_fault(chance: random.Random) -> str:
    """A device that fails, hangs, exits, or raises what cannot be printed, at some call."""
    call = chance.choice(DEVICE_CALLS)
    n = 1 if call.endswith((".open", ".safe_state", ".close")) else chance.randint(1, 20)
    return f"{call}:{n}:{chance.choice(['fails', 'hangs', 'breaks', 'exits'])}"


def planner_fault(chance: random.Random) -> str:
    """The same for the planner, which may also return nonsense."""
    how = chance.choice(["fails", "hangs", "breaks", "exits", "nonsense"])
    return f"planner:{chance.randint(1, 20)}:{how}"


def repair_machine(bench: Bench) -> None:
    """Put the disk right, as somebody would before going on."""
    if bench.disk is not None:
        bench.remount("rw")
        (bench.disk / "ballast").unlink(missing_ok=True)


def disturbed(bench: Bench, command: list[str], chance: random.Random) -> str:
    """Run a command with one disturbance; returns what it printed."""
    kinds = ["device", "planner", *DISTURBANCES]
    if bench.disk is None:
        kinds = [kind for kind in kinds if not kind.startswith("disk")]
    if bench.clock is None:
        kinds.remove("clock")
    kind = chance.choice(kinds)
    fault = {"device": device_fault, "planner": planner_fault}.get(kind, lambda _: "::")(chance)
    n = bench.n_calls() + chance.randint(1, 150)
    bench.faults.append(kind if fault == "::" else f"{kind} {fault}")
    process = bench.start(*command, fault=fault)
    try:
        if kind in DISTURBANCES and bench.await_calls(process, n):
            time.sleep(chance.uniform(0.0, 0.02))
            if process.poll() is None:
                DISTURBANCES[kind](bench, process, chance)
        text = bench.end(process)
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()
    repair_machine(bench)
    may_be_unsafe = ".safe_state:" in fault  # the device itself refuses; `labseq safe` must reach it later
    if may_be_unsafe and process.returncode == 3:
        bench.run("safe", "chaos.yaml")
    check_after_end(bench, process, text)
    return text


def next_command(bench: Bench, job: str) -> list[str] | None:
    """The command that gets a job on; None once it is done."""
    if job == "calibration":
        return None if list(bench.folder.glob("calibrations/**/thresholds-*.json")) else JOBS[job]
    runs = bench.runs()
    if job == "queue":
        entries = json.loads(bench.run("queue", "list", "--json"))["entries"]
        waiting = [entry for entry in entries if entry["state"] not in ("failed", "stopped")]
    else:
        waiting = not runs
    if waiting:
        return JOBS[job]
    left = [run for run in runs if labseq.open_run(run).status != "complete"]
    return ["resume", str(left[0])] if left else None


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
def made_bench(clock: Path | None, *, small_disk: bool) -> Generator[Bench]:
    """A bench in a folder of its own, if possible with a disk of its own."""
    folder = Path(tempfile.mkdtemp(prefix="labseq-chaos-"))
    disk = folder / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(disk)]
    is_mounted = small_disk and subprocess.run(mount, check=False, capture_output=True).returncode == 0
    try:
        yield Bench(folder, disk if is_mounted else None, clock)
    finally:
        if is_mounted:
            subprocess.run(["umount", "-l", str(disk)], check=True)
        shutil.rmtree(folder, ignore_errors=True)


def built_clock(folder: Path) -> Path | None:
    """The library that sets a clock; None without a C compiler."""
    source, library = folder / "clock.c", folder / "clock.so"
    source.write_text(CLOCK, encoding="utf-8")
    command = ["gcc", "-shared", "-fPIC", "-O2", "-o", str(library), str(source)]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return library


def undisturbed(job: str, clock: Path | None) -> Any:
    """The result of a job that nothing interrupts."""
    with made_bench(clock, small_disk=False) as bench:
        prepare(bench, job)
        bench.run(*JOBS[job])
        return result(bench, job)


def one_trial(
    seed: int, number: int, clock: Path | None, expected: dict[str, Any]
) -> tuple[str, list[str], str]:
    """Job, faults, and what does not hold ("" if all does) of a trial."""
    chance = random.Random(f"{seed}/{number}")
    job = chance.choice(list(JOBS))
    with made_bench(clock, small_disk=True) as bench:
        try:
            trial(bench, job, chance, expected[job])
        except BrokenPromiseError as error:
            return job, bench.faults, str(error)
        except Exception:  # noqa: BLE001 - reported with the others
            return job, bench.faults, traceback.format_exc()
        return job, bench.faults, ""


def main(arguments: list[str] | None = None) -> int:
    """Take trials until the time is over; returns 1 if anything did not hold."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--trial", type=int, default=None, help="only this one")
    chosen = parser.parse_args(arguments)
    seed = secrets.randbits(32) if chosen.seed is None else chosen.seed
    counts: collections.Counter[tuple[str, str]] = collections.Counter()
    failures: list[str] = []
    deadline = time.monotonic() + 60 * chosen.minutes

    def take(number: int) -> None:
        if chosen.trial is None and time.monotonic() > deadline:
            return
        job, faults, why = one_trial(seed, number, clock, expected)
        counts.update((job, fault.partition(" ")[0] if ":" in fault else fault) for fault in faults)
        if why:
            failures.append(f"--seed {seed} --trial {number} ({job}: {'; '.join(faults)}): {why}")
            print(failures[-1], flush=True)

    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        clock = built_clock(Path(folder))
        expected = dict(zip(JOBS, pool.map(undisturbed, JOBS, [clock] * len(JOBS)), strict=True))
        numbers = range(10**6) if chosen.trial is None else [chosen.trial]
        waiting: collections.deque[Any] = collections.deque()
        for number in numbers:
            waiting.append(pool.submit(take, number))
            if len(waiting) > 2 * (os.cpu_count() or 1):
                waiting.popleft().result()
            if time.monotonic() > deadline:
                break
    kinds = sorted({kind for _, kind in counts})
    print(f"seed {seed}; disturbances by job")
    print(f"{'':12}" + "".join(f"{kind:>16}" for kind in kinds))
    for job in JOBS:
        print(f"{job:12}" + "".join(f"{counts[job, kind]:16}" for kind in kinds))
    print(f"{sum(counts.values())} disturbances, {len(failures)} trials in which something did not hold")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
