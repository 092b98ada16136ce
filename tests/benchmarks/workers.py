"""Runs with workers: how much faster, how much memory, and what becomes of them when workers are killed.

    python -m tests.benchmarks.workers speed --shots 1000
    python -m tests.benchmarks.workers memory --shots 100000
    python -m tests.benchmarks.workers kills --shots 60
    python -m tests.benchmarks.workers ends --shots 40

Shots of `speed` have twelve frames each. `memory` hands the process that records a run the shots of eight
simulated workers, whose devices take no time, with a live view beside it. `kills` ends workers at random, by
SIGKILL. `ends` ends runs by Ctrl-C and by a full disk (as root on Linux), and resumes them.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console

import labseq
from labseq.cli.live import LiveView
from labseq.session import workers as session_workers
from labseq.session.workers import Recipe, ShotWorker, TakenShot
from tests.session.small_runs import table, write

N_WORKERS = 8
"""Simulated ones, whose shots are recorded."""


@contextmanager
def cluster(n_workers: int) -> Generator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A dask cluster on this computer: its address, and the processes of its workers."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    with tempfile.TemporaryDirectory() as folder, Path(folder, "log").open("wb") as log:

        def start(*arguments: str) -> subprocess.Popen[bytes]:
            command = [sys.executable, "-m", "dask", *arguments, "--no-dashboard"]
            return subprocess.Popen(command, stdout=log, stderr=log, cwd=folder)

        host, port = address.removeprefix("tcp://").split(":")
        processes = [start("scheduler", "--host", host, "--port", port)]
        workers = [start("worker", address, "--nthreads", "1") for _ in range(n_workers)]
        try:
            yield address, workers
        finally:
            for process in [*workers, *processes]:
                process.terminate()
            for process in [*workers, *processes]:
                process.wait()


def speed(n_shots: int, n_repeats: int, data: Path) -> None:
    """Time whole commands, in turn: one process, two workers, a cluster of two workers."""
    command = [sys.executable, "-m", "labseq", "run", "compact_225", "--seed", "1", "--output", str(data)]
    command += ["--set", "shot.2.rearrange.stop_when=never"]
    times: dict[str, list[float]] = {"1 process": [], "2 workers": [], "dask, 2 workers": []}
    with cluster(2) as (address, _):
        options = ["--workers=1"], ["--workers=2"], [f"--scheduler={address}"]
        for n, is_timed in ((4, False), *[(n_shots, True)] * n_repeats):
            for name, option in zip(times, options, strict=True):
                start_s = time.perf_counter()
                subprocess.run([*command, f"--shots={n}", *option], check=True, stdout=subprocess.DEVNULL)
                if is_timed:
                    times[name].append(time.perf_counter() - start_s)
                shutil.rmtree(data)
    alone_s = min(times["1 process"])
    for name, measured in times.items():
        each = ", ".join(f"{one:.1f}" for one in measured)
        print(
            f"{name:16} {each} s: {alone_s / min(measured):.2f} times as fast; load {os.getloadavg()[0]:.1f}"
        )


class NullWorkers:
    """Workers whose shots are copies of one, in any order; files are sent, as from other computers."""

    n_workers = N_WORKERS

    def __init__(self) -> None:
        self._tasks = list[int]()
        self._random = random.Random(1)

    def prepare(self, make: Any, recipe: Recipe) -> None:
        """Take the shot that is copied."""
        self._shot: TakenShot = pickle.loads(ShotWorker(replace(recipe, mark=""))((0, 0)).finish())

    def submit(self, task: int, argument: Any) -> None:
        """Take a task."""
        self._tasks.append(task)

    def finished(self, timeout_s: float) -> list[tuple[int, Any]]:
        """Half of the tasks."""
        self._random.shuffle(self._tasks)
        n = -(-len(self._tasks) // 2)
        done, self._tasks = self._tasks[:n], self._tasks[n:]
        return [(task, self._taken(task)) for task in done]

    def _taken(self, shot: int) -> bytes:
        events = list[tuple[Any, Any]]()
        for what, value in self._shot.events:
            if what == "shot_started":
                events.append((what, {**value, "shot": shot}))
            elif what == "shot_finished":
                events.append((what, {**value, "shot": replace(value["shot"], shot_index=shot)}))
            else:
                events.append((what, value) if isinstance(what, str) else ({**what, "shot": shot}, value))
        return pickle.dumps(replace(self._shot, events=events))

    def close(self) -> None:
        """Do nothing."""


class MemoryView:
    """The live view; reports the memory of this process now and then, and deletes files of shots."""

    def __init__(self, n_shots: int, screen: TextIO) -> None:
        self._view = LiveView(Console(file=screen, force_terminal=True))
        self._at = {100, 1_000, 5_000, 20_000, 50_000, n_shots}
        self._shots = Path()
        self._start_s = time.perf_counter()

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Pass it on."""
        self._view.event(name, values)
        if name == "run_starting":
            self._shots = Path(values["run_dir"]) / "shots"
        if name != "shot_finished":
            return
        n_shots = values["shot"].shot_index + 1
        if n_shots in self._at:
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            memory = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
            text = f"{n_shots:7} shots: {memory:.1f} MB, {time.perf_counter() - self._start_s:.0f} s"
            print(text, file=sys.__stdout__, flush=True)  # the view takes sys.stdout
        if n_shots % 1000 == 0:
            for file in self._shots.glob("*.h5"):
                file.unlink()


def memory(n_shots: int, data: Path) -> None:
    """Record many shots of simulated workers."""
    sequence = write(data)
    session_workers.open_workers = lambda options: NullWorkers()
    options: dict[str, Any] = {"workers": N_WORKERS, "seed": 1, "output": data, "shots": n_shots}
    with Path(os.devnull).open("w", encoding="utf-8") as screen:
        options["observer"] = MemoryView(n_shots, screen)
        with labseq.Session.open(sequence, **options) as session:
            session.run()


def worker_processes(parents: list[int]) -> list[int]:
    """The processes that take shots: those started by Python's multiprocessing from some processes."""
    found = list[int]()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if parent in parents and b"spawn_main" in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
        except OSError:  # it has ended
            continue
    return found


class Killer:
    """Kills one of the workers that some processes have started, at random after a shot."""

    def __init__(self, parents: list[int]) -> None:
        self.n_killed = 0
        self._parents = parents

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Kill after one shot of six."""
        if name == "shot_finished" and random.random() < 1 / 6 and (alive := worker_processes(self._parents)):
            time.sleep(random.uniform(0.0, 0.2))
            os.kill(random.choice(alive), signal.SIGKILL)
            self.n_killed += 1


def index(run: labseq.Run) -> list[dict[str, Any]]:
    """The lines of the index without times, and without hashes of files that contain times."""
    times = {"t_start_utc", "t_end_utc", "stage_s", "sha256", "bytes"}
    lines = map(json.loads, (run.path / "index.jsonl").read_text(encoding="utf-8").splitlines())
    return [{key: value for key, value in line.items() if key not in times} for line in lines]


@contextmanager
def small_disk(folder: Path) -> Generator[None]:
    """A disk of 8 MB at a folder; needs root, and Linux."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "none", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def command(data: Path, *arguments: str, ctrl_c_s: float | None = None) -> tuple[int, str]:
    """Run labseq with two workers: its exit code, and the last line that it printed.

    Args:
        data: Folder for the data.
        arguments: Its arguments.
        ctrl_c_s: When Ctrl-C comes after the first shot; None: never.
    """
    whole = [sys.executable, "-m", "labseq", *arguments, "--workers=2"]
    with subprocess.Popen(
        whole, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        if ctrl_c_s is not None:
            begun = {path: path.stat().st_size for path in data.glob("*/*/index.jsonl")}
            while process.poll() is None and begun == {
                path: path.stat().st_size for path in data.glob("*/*/index.jsonl")
            }:
                time.sleep(0.02)
            time.sleep(ctrl_c_s)
            os.killpg(process.pid, signal.SIGINT)
        errors = process.communicate()[1].strip().splitlines()
    return process.returncode, errors[-1] if errors else ""


def ends(n_shots: int, data: Path) -> None:
    """Compare runs that were ended and resumed with one that was not."""
    with labseq.Session.open("compact_225", seed=1, shots=n_shots, output=data / "alone") as session:
        alone = session.run()

    def compare(name: str, folder: Path) -> None:
        run = labseq.open_run(next(folder.glob("*/*")))
        left = [path.name for path in (run.path / "shots").iterdir() if path.suffix != ".h5"]
        same = table(run) == table(alone) and index(run) == index(alone) and not left
        print(f"{name}: {'identical' if same else 'DIFFERENT'}", flush=True)

    first = ("run", "compact_225", "--seed=1", f"--shots={n_shots}", "--output")
    pressed = data / "pressed"
    print(*command(pressed, *first, str(pressed), ctrl_c_s=random.random()))
    for _ in range(2):
        print(*command(pressed, "resume", str(next(pressed.glob("*/*"))), ctrl_c_s=random.random()))
    print(*command(pressed, "resume", str(next(pressed.glob("*/*")))))
    compare("Ctrl-C", pressed)
    full = data / "full"
    with small_disk(full):
        print(*command(full, *first, str(full)))
        subprocess.run(["mount", "-o", "remount,size=1g", str(full)], check=True)
        print(*command(full, "resume", str(next(full.glob("*/*")))))
        compare("full disk", full)


def kills(n_shots: int, data: Path) -> None:
    """Compare runs whose workers are killed with one that has none."""

    def run(observer: Killer | None = None, **options: Any) -> labseq.Run:
        options |= {"seed": 1, "shots": n_shots, "output": data, "observer": observer}
        with labseq.Session.open("compact_225", **options) as session:
            return session.run()

    def files(of: labseq.Run) -> list[str]:
        return sorted(path.name for path in (of.path / "shots").iterdir())

    alone = run()
    tables, lines, names = table(alone), index(alone), files(alone)

    def compare(name: str, parents: list[int], **options: Any) -> None:
        killer = Killer(parents)
        found = run(killer, **options)
        same = table(found) == tables and index(found) == lines and files(found) == names
        print(f"{name}: {killer.n_killed} killed; {'identical' if same else 'DIFFERENT'}", flush=True)

    for n_workers in (2, 4):
        compare(f"{n_workers} workers", [], workers=n_workers)
    compare("2 workers", [os.getpid()], workers=2)
    with cluster(2) as (address, workers):
        compare("dask, 2 workers", [worker.pid for worker in workers], scheduler=address)


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("speed", "memory", "kills", "ends"))
    parser.add_argument("--shots", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=2, help="of `speed`; the fastest counts")
    parser.add_argument("--folder", type=Path, help="where the data are written for a while")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        data = Path(folder, "data")
        data.mkdir()
        if arguments.what == "speed":
            speed(arguments.shots, arguments.repeats, data)
        elif arguments.what == "memory":
            memory(arguments.shots, data)
        elif arguments.what == "ends":
            ends(arguments.shots, data)
        else:
            kills(arguments.shots, data)


if __name__ == "__main__":
    main()
