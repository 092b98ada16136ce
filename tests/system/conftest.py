"""Runs of the command line on devices that note every call, in processes of their own or in this one."""

import json
import os
import subprocess
import sys
import threading
import time
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from labseq.cli import main

WATCHED = '''
"""The virtual devices, noting every call in a file as it is entered."""
import os
import pathlib
import threading

from labseq.plugin import Context, Settings, hookimpl
from labseq_virtual import camera, devices, settings, tweezers

LABSEQ_API = 1
LOG = pathlib.Path(os.environ["WATCHED_LOG"])


def watched(cls, role):
    def noting(method):
        def call(self, *args, **kwargs):
            if self.__dict__.get("inside"):  # a device that calls itself
                return getattr(cls, method)(self, *args, **kwargs)
            with LOG.open("a") as log:
                log.write(f"{role}.{method}\\n")
            if f"{role}.{method}" == os.environ.get("WATCHED_FAILS"):
                raise RuntimeError("rehearsed failure")
            if f"{role}.{method}" in os.environ.get("WATCHED_HANGS", "").split():
                threading.Event().wait()
            stopping, n, number, slow = os.environ.get("WATCHED_SIGNAL", ":::").split(":")
            if f"{role}.{method}" == stopping and LOG.read_text().split().count(stopping) == int(n):
                threading.Timer(0.05, os.kill, (os.getpid(), int(number))).start()
                if slow:
                    self._clock.sleep(3600.0)
            self.__dict__["inside"] = True
            try:
                return getattr(cls, method)(self, *args, **kwargs)
            finally:
                self.__dict__["inside"] = False
        call.__name__ = method
        return call

    names = [n for n in dir(cls) if not n.startswith("_") and callable(getattr(cls, n))]
    return type("Watched" + cls.__name__, (cls,), {n: noting(n) for n in names})


class Shutter(devices.VirtualDevice):
    def __init__(self, settings, context):
        super().__init__(settings, context)
        self._clock = context.clock


@hookimpl
def labseq_register(registry):
    mobile, static = tweezers.VirtualMobileTweezers, tweezers.VirtualStaticTweezers
    add = {"virtual_time": True}
    registry.camera("watched", watched(camera.VirtualCamera, "camera"), settings.CameraSettings, **add)
    static, mobile = watched(static, "static_tweezers"), watched(mobile, "mobile_tweezers")
    registry.static_tweezers("watched", static, settings.StaticTweezersSettings, **add)
    registry.mobile_tweezers("watched", mobile, settings.MobileTweezersSettings, **add)
    registry.device("watched", watched(Shutter, "shutter"), settings.DeviceSettings, **add)
'''

PROFILE = """
labseq: 1
name: watched
grid: {rows: 10, cols: 10, spacing: 4.49 um}
camera: {use: watched}
static_tweezers: {use: watched}
mobile_tweezers: {use: watched}
detector: {use: threshold, frame: [160, 240], centre_px: [79.5, 119.5]}
devices: {shutter: {use: watched, commands: [open, close]}}
simulation: {use: virtual, image: {frame: [160, 240], centre_px: [79.5, 119.5]}}
plugin_folders: [plugins]
timeouts: {call: 3 s, safe_state: 2 s, plan: 5 s}
"""

SEQUENCE = """
labseq: 1
name: watched run
profile: watched
shots: 4
seed: 7
target: {pattern: compact, rows: 6, cols: 6}
planner: {use: psca, degree_of_parallelism: 4}
shot:
"""

STEPS = """
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 2, window: 60 ms, exposure: 45 ms}
  - image: {exposure: 45 ms}
"""


class WatchedLab:
    """A folder with a sequence, a profile whose devices note their calls, and a place for data."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.data = folder / "data"
        self.log = folder / "calls.log"
        self.environment = {**os.environ, "LABSEQ_DATA": str(self.data), "WATCHED_LOG": str(self.log)}
        (folder / "plugins").mkdir()
        (folder / "plugins" / "watched.py").write_text(WATCHED, encoding="utf-8")
        (folder / "watched.yaml").write_text(PROFILE, encoding="utf-8")
        self.write_sequence(STEPS)

    def write_sequence(self, steps: str) -> None:
        (self.folder / "sequence.yaml").write_text(SEQUENCE + steps, encoding="utf-8")

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "labseq", *arguments],
            cwd=self.folder,
            env=self.environment,
            text=True,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )

    def run_apart(self, *arguments: str, timeout: float = 120.0) -> subprocess.CompletedProcess[str]:
        """To its end, in a process of its own."""
        process = self.start(*arguments)
        out, err = process.communicate(timeout=timeout)
        return subprocess.CompletedProcess(process.args, process.returncode, out, err)

    def run(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """To its end, in this process, where nothing must be imported first."""
        out, err = StringIO(), StringIO()
        with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
            for name, value in self.environment.items():
                patch.setenv(name, value)
            patch.chdir(self.folder)
            with pytest.raises(SystemExit) as ended:
                main(list(arguments))
        code = ended.value.code
        assert code is None or isinstance(code, int)
        return subprocess.CompletedProcess(arguments, code or 0, out.getvalue(), err.getvalue())

    def calls(self) -> list[str]:
        return self.log.read_text().split() if self.log.exists() else []

    def await_calls(self, process: subprocess.Popen[str], call: str, n: int = 1) -> None:
        """Wait until a device was called for the n-th time."""
        deadline = time.monotonic() + 120.0
        while self.calls().count(call) < n:
            if process.poll() is not None:
                raise AssertionError(f"the run ended before {call}: {process.communicate()}")
            if time.monotonic() > deadline:
                process.kill()
                raise AssertionError(f"{call} was not called; calls so far: {self.calls()}")
            threading.Event().wait(0.005)

    def run_dir(self) -> Path:
        (state,) = self.data.glob("*/*/STATE")
        return state.parent

    def index(self) -> list[dict[str, Any]]:
        text = (self.run_dir() / "index.jsonl").read_text(encoding="utf-8")
        return [json.loads(line) for line in text.splitlines()]

    def events(self, name: str) -> list[dict[str, Any]]:
        text = (self.run_dir() / "events.jsonl").read_text(encoding="utf-8")
        lines = [json.loads(line) for line in text.splitlines()]
        return [line for line in lines if line["event"] == name]


@pytest.fixture
def bench(tmp_path):
    return WatchedLab(tmp_path)
