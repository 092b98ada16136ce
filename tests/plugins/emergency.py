"""For the tests of emergency scripts: a plain Python process that runs them, as labseq's watchdog does."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

OUTSIDER = """
import json, runpy, sys, time
jobs = {name: (runpy.run_path(path), arguments) for name, (path, arguments) in json.loads(input()).items()}
def attempt(call, arguments):
    try:
        return call(**arguments)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
prepared = {n: attempt(s["prepare"], a) if "prepare" in s else None for n, (s, a) in jobs.items()}
heavy = {"numpy", "h5py", "numba", "pydantic", "labseq", "labseq_spcm", "labseq_soapy_stream", "spcm_core"}
print(json.dumps([prepared, sorted(heavy & set(sys.modules))]), flush=True)
for line in sys.stdin:
    done = {}
    for name, (script, arguments) in jobs.items():
        start_s = time.monotonic()
        done[name] = attempt(script["off"], arguments), start_s, time.monotonic()
    print(json.dumps(done), flush=True)
"""


@dataclass(frozen=True)
class Done:
    """What one script's ``off`` returned or raised, and when it began and ended (CLOCK_MONOTONIC)."""

    text: str
    start_s: float
    end_s: float


class Outsider:
    """The process."""

    def __init__(self, process: subprocess.Popen[str], jobs: Mapping[str, Any]) -> None:
        self._process = process
        self._send(json.dumps(jobs))
        self.prepared, self.heavy_modules = json.loads(self._receive())

    def _send(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def _receive(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()

    def off(self) -> dict[str, Done]:
        """Run ``off`` of every script, one after the other."""
        self._send("go")
        return {name: Done(*values) for name, values in json.loads(self._receive()).items()}


@contextmanager
def outsider(jobs: Mapping[str, tuple[str, Mapping[str, Any]]]) -> Generator[Outsider]:
    """A process that has prepared these scripts with these arguments."""
    command = [sys.executable, "-I", "-c", OUTSIDER]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        yield Outsider(process, jobs)
    finally:
        process.kill()
        process.communicate()
