"""Load on `labseq web`, by hand: pages that are open while a run writes ten shots a second.

    python -m tests.benchmarks.web_load --clients 20 --seconds 20

Prints how long a shot takes from the disk to the pages, the server's share of a core and its memory, what it
costs the run, and how long a folder of 2,000 runs and a run of 20,000 shots take to open.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import psutil

from labseq.data.reader import Run, open_run
from labseq.plain import dumps

ROOT = Path(__file__).parents[2]
SEQUENCE, PROFILE = ROOT / "sequences" / "compact_225.yaml", ROOT / "hardware_profiles" / "virtual.yaml"
FRAME_S = 0.5
"""A page waits so long between two frames."""

WRITE = """
import sys, time
from dataclasses import replace
from pathlib import Path
from labseq.data.reader import open_run
from labseq.recording.writer import RunWriter
from tests.recording.records import make_run
source, root = open_run(sys.argv[1]), Path(sys.argv[2])
n_shots, interval_s = int(sys.argv[3]), float(sys.argv[4])
shots = [shot.record() for shot in source.shots]
writer = RunWriter.create(root, replace(make_run(target=source.target, n_shots=n_shots), record_frames="all"))
begun = time.monotonic()
for index in range(n_shots):
    writer.write_shot(replace(shots[index % len(shots)], shot_index=index))
    print(index, time.time(), flush=True)
    time.sleep(max(0.0, begun + (index + 1) * interval_s - time.monotonic()))
writer.finish("complete")
"""


class Page:
    """What an open page does: it reads states, and fetches the newest frame when it is ready."""

    def __init__(self, port: int) -> None:
        self._port = port
        self.seen: dict[int, float] = {}
        self.counted: dict[int, float] = {}
        self.n_bytes = 0
        self._newest = asyncio.Event()
        self._frame = ""

    async def read(self) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", self._port, limit=1 << 22)
        writer.write(b"GET /api/v1/events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        shot = None
        while line := await reader.readline():
            self.n_bytes += len(line)
            if line.startswith(b"event: shot"):
                shot = json.loads((await reader.readline())[6:])
            elif line.startswith(b"data: "):
                state = json.loads(line[6:])
                if state["run"]:
                    self.counted.setdefault(state["run"]["n_done"] - 1, time.time())
                if state["run"] and shot and "images" in shot:
                    self.seen.setdefault(shot["shot"], time.time())
                    at = f"{state['run']['id']}/shots/{shot['shot']}/frames/{len(shot['images']) - 1}"
                    self._frame = f"/api/v1/runs/{at}.png?width=512"
                    self._newest.set()

    async def look(self) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", self._port, limit=1 << 22)
        while True:
            await self._newest.wait()
            self._newest.clear()
            writer.write(f"GET {self._frame} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
            head = await reader.readuntil(b"\r\n\r\n")
            length = int(head.lower().partition(b"content-length: ")[2].partition(b"\r")[0])
            self.n_bytes += len(await reader.readexactly(length))
            await asyncio.sleep(FRAME_S)


async def load(port: int, n_clients: int, command: list[str], server: psutil.Process) -> None:
    """Open the pages, let a run be written, and print what was seen."""
    pages = [Page(port) for _ in range(n_clients)]
    tasks = [asyncio.create_task(task()) for page in pages for task in (page.read, page.look)]
    await asyncio.sleep(1.0)
    run = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE, cwd=ROOT)
    assert run.stdout is not None
    written: dict[int, float] = {}
    begun_s, cpu_s = 0.0, 0.0
    async for line in run.stdout:
        index, at = line.split()
        written[int(index)] = float(at)
        if not begun_s:
            begun_s, cpu_s = time.monotonic(), sum(server.cpu_times()[:2])
    elapsed_s = time.monotonic() - begun_s
    share = (sum(server.cpu_times()[:2]) - cpu_s) / elapsed_s
    await asyncio.sleep(1.0)
    for task in tasks:
        task.cancel()
    shots = len(written) / elapsed_s
    print(f"{n_clients} pages, {shots:.1f} shots/s, load {os.getloadavg()[0]:.1f}")
    for what, seen in (
        ("figures", [p.counted for p in pages]),
        ("images and moves", [p.seen for p in pages]),
    ):
        late_s = [at - written[shot] for one in seen for shot, at in one.items() if shot in written]
        p50, p99 = np.quantile(late_s, (0.5, 0.99))
        part = np.mean([len(one) / len(written) for one in seen])
        times = f"{1e3 * p50:.0f} ms (p50), {1e3 * p99:.0f} ms (p99)"
        print(f"  from the disk to a page, {what}: {times}; {part:.0%} of the shots")
    print(f"  server: {share:.1%} of a core, {server.memory_info().rss / 1e6:.0f} MB")
    print(f"  sent: {sum(page.n_bytes for page in pages) / elapsed_s / 1e6:.1f} MB/s")


def recorded(root: Path) -> Run:
    """A few shots of the virtual lab, as a template."""
    command = [sys.executable, "-m", "labseq", "run", str(SEQUENCE), "--profile", str(PROFILE), "--shots=5"]
    subprocess.run([*command, f"--output={root}", "--json"], check=True, capture_output=True)
    return open_run(next(root.glob("*/*/run.json")))


BLOCK_S = 10.0
"""For so long pages are open, and then for as long closed."""
FEEDBACK = ("detect", "plan", "check", "tones", "prepare")
"""Stages from a frame to the first move."""


async def cost(port: int, n_clients: int, command: list[str]) -> None:
    """Take a real-time run while pages are open every other block; print the feedback times of both."""
    run = await asyncio.create_subprocess_exec(*command, stdout=subprocess.DEVNULL)
    ended = asyncio.create_task(run.wait())
    blocks: list[tuple[float, float]] = []
    while not ended.done():
        pages = [Page(port) for _ in range(n_clients)]
        tasks = [asyncio.create_task(task()) for page in pages for task in (page.read, page.look)]
        begun = time.time()
        await asyncio.wait([ended], timeout=BLOCK_S)
        blocks.append((begun, time.time()))
        for task in tasks:
            task.cancel()
        await asyncio.wait([ended], timeout=BLOCK_S)
    OPEN.extend(blocks)


OPEN: list[tuple[float, float]] = []


def feedback_ms(run: Run) -> tuple[list[float], list[float]]:
    """From each frame to its first move, on this computer's clock: with pages open, and without."""
    found: tuple[list[float], list[float]] = ([], [])
    for shot in run.shots[3:]:
        began = datetime.fromisoformat(shot.row.t_start_utc).timestamp()
        is_open = any(first <= began <= last for first, last in OPEN)
        cycles: dict[int, float] = {}
        for one in shot.timing:
            if one.cycle >= 0 and one.stage in FEEDBACK:
                cycles[one.cycle] = cycles.get(one.cycle, 0.0) + 1e3 * one.host_s
        found[not is_open].extend(cycles.values())
    return found


def costing(home: Path, n_clients: int, n_shots: int) -> None:
    """Print what pages cost a run."""
    data = home / "cost"
    data.mkdir()
    server, port = started(data)
    command = [sys.executable, "-m", "labseq", "run", str(SEQUENCE), "--profile", str(PROFILE), "--realtime"]
    asyncio.run(cost(port, n_clients, [*command, f"--shots={n_shots}", f"--output={data}"]))
    server.kill()
    server.communicate()
    opened, closed = feedback_ms(open_run(next(data.glob("*/*/run.json"))))
    print(f"from a frame to its first move, {n_clients} pages open or not, load {os.getloadavg()[0]:.1f}")
    for name, times in (("open", opened), ("closed", closed)):
        p50, p99 = np.quantile(times, (0.5, 0.99))
        print(f"  {name}: {p50:.2f} ms (p50), {p99:.2f} ms (p99) of {len(times)} cycles")
    ratio = np.quantile(opened, (0.5, 0.99)) / np.quantile(closed, (0.5, 0.99))
    print(f"  ratio: {ratio[0]:.2f} (p50), {ratio[1]:.2f} (p99)")


def many_runs(source: Run, root: Path, n_runs: int) -> None:
    """Copies of a run without its shots' files."""
    for number in range(n_runs):
        folder = (
            root
            / f"2026-{1 + number // 200:02}-{1 + number % 20:02}"
            / f"{1 + number // 20:04}_{source.name}"
        )
        folder.mkdir(parents=True, exist_ok=True)
        for name in ("run.json", "STATE", "index.jsonl"):
            shutil.copyfile(source.path / name, folder / name)


def long_run(source: Run, root: Path, n_shots: int) -> str:
    """A run of so many shots without their files."""
    many_runs(source, root, 1)
    folder = next(root.glob("*/*"))
    lines = [dumps(replace(source.shots[i % len(source.shots)].row, shot=i)) for i in range(n_shots)]
    (folder / "index.jsonl").write_text("\n".join(lines) + "\n")
    return f"{folder.parent.name}/{folder.name}"


def started(data: Path) -> tuple[subprocess.Popen[str], int]:
    """A server, and its port."""
    command = [sys.executable, "-m", "labseq", "web", str(data), "--port=0"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    return server, int(server.stdout.readline().rstrip("/\n").rpartition(":")[2])


def timed(port: int, path: str) -> float:
    begun_s = time.monotonic()
    with urlopen(f"http://127.0.0.1:{port}{path}") as answer:
        answer.read()
    return time.monotonic() - begun_s


def opening(data: Path, paths: list[str]) -> None:
    """Print how long the first answers of a new server take."""
    server, port = started(data)
    try:
        process = psutil.Process(server.pid)
        for path in paths:
            cpu_s = sum(process.cpu_times()[:2])
            first_s = timed(port, path)
            cpu_s = sum(process.cpu_times()[:2]) - cpu_s
            again = f"again {1e3 * timed(port, path):.0f} ms"
            print(f"  {path}: {1e3 * first_s:.0f} ms ({1e3 * cpu_s:.0f} ms of the processor), {again}")
        print(f"  {psutil.Process(server.pid).memory_info().rss / 1e6:.0f} MB")
    finally:
        server.kill()
        server.communicate()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clients", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--shots", type=int, default=120, help="of the real-time run, a second each; 0: none")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        source = recorded(home / "source")
        for n_clients in (1, asked.clients):
            data = home / f"live{n_clients}"
            data.mkdir()
            server, port = started(data)
            n_shots = str(int(10 * asked.seconds))
            command = [sys.executable, "-c", WRITE, str(source.path), str(data), n_shots, "0.1"]
            asyncio.run(load(port, n_clients, command, psutil.Process(server.pid)))
            server.kill()
            server.communicate()
            shutil.rmtree(data)
        if asked.shots:
            costing(home, asked.clients, asked.shots)
        print("2,000 runs")
        many_runs(source, home / "many", 2000)
        opening(home / "many", ["/api/v1/runs?n=50", "/api/v1/now", "/api/v1/runs?q=compact%20complete"])
        print("a run of 20,000 shots")
        run = long_run(source, home / "long", 20_000)
        opening(home / "long", ["/api/v1/now", f"/api/v1/runs/{run}", f"/api/v1/runs/{run}/statistics"])


if __name__ == "__main__":
    main()
