"""Devices that outlive the process that drives them, and processes that end badly."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from labseq_soapy_sim import read_trace
from labseq_spcm_sim import registers as r

from .card_process_emergency import ADDRESS, Connection
from .labseq_serial_rig import Simulator

DRIVING = """
import ctypes, fcntl, os, resource, signal, sys, termios, threading, time
from pathlib import Path
import numpy as np
from labseq_serial.device import SerialDevice
from labseq_soapy.static_tweezers import SoapySettings, SoapyStaticTweezers
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm import card as driver_card, replay_fifo
from labseq_spcm.settings import SpcmSettings
from labseq_spcm.stream import Stream
from labseq_ttl.go_lines import ttl_lines
from labseq_ttl.settings import TtlSettings
from labseq.kernels.kernel import load_kernels
from labseq.motion import tone_program
from labseq.plugin import Context, MotionSpec, Plan, SiteGrid
from labseq.plugin.motion import RfSpec
from labseq.testing.contracts.instruments import SPECS
from labseq.testing.fakes import FakeClock
from labseq.watchdog import Watchdog
from tests.plugins.card_process import TweezersOfProcess
from tests.plugins.labseq_serial_rig import settings

CLOCK = FakeClock()
# samples go through a pipe, which may be slow
driver_card.TRANSFER_TIMEOUT_S = replay_fifo.TRANSFER_TIMEOUT_S = 60.0
Stream._check_bus = lambda self: None
TONES, BAND = np.linspace(12e6, 18e6, 5), (10e6, 20e6)
GRID = SiteGrid(5, 5, row_frequency_hz=TONES, column_frequency_hz=TONES)
RF = RfSpec(row_band_hz=BAND, column_band_hz=BAND)
MOTION = MotionSpec(speed_m_s=1.5e-5, rf=RF)
PLAN = Plan.from_batches([([(0, 0), (0, 2)], [(0, 1), (0, 3)])] * 50)

def shutter(folder, repeat):
    device = SerialDevice(settings(port=str(folder / "port")), Context("shutter", clock=CLOCK))
    return device, lambda: device.command("open")

def lines(folder, repeat):
    device = ttl_lines(TtlSettings(port=str(folder / "box")), Context("lines", clock=CLOCK, lines=SPECS))
    return device, lambda: device._opened().set_lines(4)

def radio(folder, repeat):
    comb = {"centre": 100e6, "step": 60e3}
    device = f"simulated,speed=1,buffer=0.02,patience=0,record=1000000,folder={folder}/radio{repeat}"
    (folder / f"radio{repeat}").mkdir()
    chosen = SoapySettings(device=device, sample_rate=1.2e6, row_frequency=comb, column_frequency=comb)
    device = SoapyStaticTweezers(chosen, Context("static_tweezers", SiteGrid(3, 4)))
    return device, device.start

def card(folder, repeat, mode):
    name = f"simulated@{folder}/{mode}{repeat}"
    chosen = SpcmSettings(card=name, mode=mode, sample_rate=50e6, trigger="software", fill=0.1)
    device = TweezersOfProcess(chosen, Context("mobile_tweezers", GRID, motion=MOTION))
    program = tone_program(PLAN, GRID, MOTION, 50 if mode in ("fifo", "stream") else 1)
    def play():
        device.play()
        if mode == "fifo":
            threading.Thread(target=device.wait, args=(1e3,), daemon=True).start()
    return device, play, lambda: device.prepare(program)

def drive(folder, names, repeat, cause):
    dog, made = Watchdog("the run", folder / "watchdog.jsonl"), []
    for order, name in enumerate(names):
        made.append(globals()[name](folder, repeat) if name in globals() else card(folder, repeat, name))
        device = made[-1][0]
        device.open()
        found = device.emergency()
        dog.add(name, order, found.script, dict(found.arguments))
    for _, _, *prepare in made:  # before any plays: replay is over in less than a second
        for act in prepare:
            act()
    for _, act, *_ in made:
        act()
    print("on", *dog.notes(), flush=True)
    sys.stdin.readline()
    print(time.monotonic(), flush=True)
    exec(cause)

def lose_terminal():
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    terminal, mine = os.openpty()
    os.setsid()
    fcntl.ioctl(mine, termios.TIOCSCTTY, 0)
    os.close(terminal)
    time.sleep(60)

def fill_memory():
    resource.setrlimit(resource.RLIMIT_AS, (64 << 20, 64 << 20))
    full = [bytearray(1 << 20) for _ in range(1 << 20)]

for mode in {"replay", "sequence", "fifo", "stream"} & set(sys.argv[2:]):  # here, not again in every child
    settings_here = SpcmSettings(card="simulated", mode=mode, sample_rate=50e6, fill=0.1)
    warmed = SpcmMobileTweezers(settings_here, Context("mobile_tweezers", GRID, motion=MOTION))
    warmed.warm()
    load_kernels()
    warmed.open()
    warmed.prepare(tone_program(PLAN, GRID, MOTION, 1))
    warmed.close()
for repeat, cause in enumerate(sys.stdin):
    if child := os.fork():
        os.waitpid(child, 0)
    else:
        drive(Path(sys.argv[1]), sys.argv[2:], repeat, cause)
"""
CAUSES: Final = {
    "kill -9": "os.kill(os.getpid(), signal.SIGKILL)",
    "os._exit": "os._exit(1)",
    "hang-up": "lose_terminal()",
    "no memory": "fill_memory()",
    "SIGSTOP": "os.kill(os.getpid(), signal.SIGSTOP)",
    "C call": "ctypes.PyDLL(None).sleep(60)",
}
"""What ends or stops the process."""
CARDS: Final = ("fifo", "stream", "sequence", "replay")
"""Simulated cards, by mode; replay comes last, because it plays for less than a second."""


class TtlSimulator(Simulator):
    """A timing box on a pty, in a process of its own."""

    def __init__(self, folder: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("labseq_ttl_simulator.py")), str(folder / "box")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.order("state")


class Outputs:
    """Devices, and a process that has a child drive them."""

    def __init__(
        self, folder: Path, shutter: Simulator, lines: Simulator, names: Sequence[str], *, driven: bool
    ) -> None:
        self._folder, self._shutter, self._lines, self._names = folder, shutter, lines, names
        self._repeat = -1
        root = str(Path(__file__).parents[2])
        self._process: subprocess.Popen[str] | None = None
        if driven:
            self._process = subprocess.Popen(
                [sys.executable, "-c", DRIVING, str(folder), *names],
                cwd=root,
                text=True,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": root},
            )

    def _ask(self, line: str) -> str:
        assert self._process is not None
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        return self._process.stdout.readline()

    def close(self) -> None:
        """End the process, and that of the cards."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
        if (self._folder / ADDRESS).exists():
            Connection(str(self._folder / "last"))("power_off")

    def off_since(self) -> dict[str, float | None]:
        """Device -> None while it is on, else when it went off."""
        return {name: self._off_since(name) for name in self._names}

    def _off_since(self, name: str) -> float | None:
        if name == "shutter":
            values, since_s = self._shutter.order("state")
            return None if values["open"] == "1" else since_s
        if name == "lines":
            on, since_s = self._lines.order("state")
            return None if on else since_s
        if name == "radio":
            trace = read_trace(self._folder / f"radio{self._repeat}")
            time_s, state, *_ = [entry for entry in trace if entry[1] in ("play", "stop", "close")][-1]
            return None if state == "play" else time_s
        card = Connection(str(self._folder / f"{name}{self._repeat}"))
        try:
            is_on = card("state") != (False, (False, False))
            relays = [one for one in card("log") if (one.register, one.value) == OPEN_RELAYS]
            return None if is_on else relays[-1].time_s
        finally:
            card.close()

    def times_to_off(self, cause: str) -> dict[str, float]:
        """Have a process turn all on and end or hang; how long each stays on, in seconds."""
        (self._folder / "watchdog.jsonl").unlink(missing_ok=True)
        self._repeat += 1
        assert self._ask(CAUSES[cause]) == "on\n"
        assert set((states := self.off_since()).values()) == {None}, states
        begun_s = float(self._ask(""))
        deadline_s = time.monotonic() + 20.0
        while len(log_rows(self._folder)) < len(self._names) and time.monotonic() < deadline_s:
            time.sleep(5e-3)
        return {name: since_s - begun_s for name, since_s in self.off_since().items() if since_s is not None}


OPEN_RELAYS: Final = (r.SPC_M2CMD, r.M2CMD_CARD_WRITESETUP)


@contextmanager
def outputs(
    folder: Path, names: Sequence[str] = ("shutter", "lines"), *, driven: bool = True
) -> Generator[Outputs]:
    """Devices, driven by a process unless somebody else does."""
    with Simulator(folder) as shutter, TtlSimulator(folder) as lines:
        devices = Outputs(folder, shutter, lines, names, driven=driven)
        try:
            yield devices
        finally:
            devices.close()


def log_rows(folder: Path) -> list[dict[str, object]]:
    """What the watchdog wrote down."""
    file = folder / "watchdog.jsonl"
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
