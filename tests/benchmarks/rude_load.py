"""A hundred rude clients and twenty pages at `labseq web` beside a run, by hand.

    python -m tests.benchmarks.rude_load --shots 120

The pages follow a run in real time, and the rude clients, each of an address of its own, are silent, slow,
endless or send garbage, in blocks of ten seconds with as long without them in between. Prints how long
shots take with all of them and without, how long the server takes to answer a page, and its memory.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import sys
import tempfile
import time
from datetime import datetime
from pathlib import Path

import numpy as np
import psutil

from labseq.data.reader import open_run
from tests.benchmarks.web_load import BLOCK_S, PROFILE, SEQUENCE, Page, started


async def be_rude(port: int, number: int) -> None:
    """Connect again and again, and misbehave in one of four ways."""
    behave = (silent, slow, endless, garbage)[number % 4]
    while True:
        with contextlib.suppress(OSError):
            source = (f"127.0.1.{1 + number}", 0)
            _, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=source)
            try:
                await behave(writer)
            finally:
                writer.close()
        await asyncio.sleep(0.1)


async def silent(_: asyncio.StreamWriter) -> None:
    await asyncio.sleep(60.0)


async def slow(writer: asyncio.StreamWriter) -> None:
    for letter in b"GET /api/v1/now HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n":
        writer.write(bytes([letter]))
        await writer.drain()
        await asyncio.sleep(0.5)


async def endless(writer: asyncio.StreamWriter) -> None:
    writer.write(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n")
    while True:
        writer.write(b"x-y: z\r\n" * 100)
        await writer.drain()
        await asyncio.sleep(0.05)


async def garbage(writer: asyncio.StreamWriter) -> None:
    while True:
        writer.write(os.urandom(1000))
        await writer.drain()
        await asyncio.sleep(0.05)


async def ask(port: int, times: list[float]) -> None:
    """Ask for the state of the run every half second, as a page that opens."""
    while True:
        start_s = time.monotonic()
        reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1 << 22)
        writer.write(b"GET /api/v1/now HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n")
        answer = await reader.read()
        assert answer.startswith(b"HTTP/1.1 200 ")
        while await reader.read(1 << 16):
            pass
        times.append(1e3 * (time.monotonic() - start_s))
        writer.close()
        await asyncio.sleep(0.5)


async def measure(port: int, asked: argparse.Namespace, command: list[str], server: psutil.Process) -> None:
    """Take the run, and print what the pages and the server say."""
    run = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.DEVNULL)
    ended = asyncio.create_task(run.wait())
    times, most = list[float](), 0
    while not ended.done():
        pages = [Page(port) for _ in range(asked.pages)]
        tasks = [asyncio.create_task(task()) for page in pages for task in (page.read, page.look)]
        tasks += [asyncio.create_task(be_rude(port, number)) for number in range(asked.rude)]
        tasks.append(asyncio.create_task(ask(port, times)))
        begun = time.time()
        await asyncio.wait([ended], timeout=BLOCK_S)
        CROWDED.append((begun, time.time()))
        most = max(most, server.memory_info().rss)
        for task in tasks:
            task.cancel()
        await asyncio.wait([ended], timeout=BLOCK_S)
    p50, p99 = np.quantile(times, (0.5, 0.99))
    print(f"an answer to a page: {p50:.0f} ms (p50), {p99:.0f} ms (p99) of {len(times)}")
    print(f"server: {most / 1e6:.0f} MB")


CROWDED: list[tuple[float, float]] = []


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pages", type=int, default=20)
    parser.add_argument("--rude", type=int, default=100)
    parser.add_argument("--shots", type=int, default=120, help="of the run, a second each")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder)
        server, port = started(data)
        command = [sys.executable, "-m", "labseq", "run", str(SEQUENCE), "--profile", str(PROFILE)]
        command += ["--realtime", f"--shots={asked.shots}", f"--output={data}"]
        asyncio.run(measure(port, asked, command, psutil.Process(server.pid)))
        server.kill()
        server.communicate()
        shots: dict[bool, list[float]] = {False: [], True: []}
        for shot in open_run(next(data.glob("*/*/run.json"))).shots[3:]:
            began, end = (
                datetime.fromisoformat(t).timestamp() for t in (shot.row.t_start_utc, shot.row.t_end_utc)
            )
            shots[any(first <= began <= last for first, last in CROWDED)].append(end - began)
    means = {is_crowded: float(np.mean(durations)) for is_crowded, durations in shots.items()}
    print(f"a shot: {means[True]:.3f} s with them, {means[False]:.3f} s without")
    print(f"ratio {means[True] / means[False]:.3f}, load {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
