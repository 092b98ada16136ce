"""For the tests of the SoapySDR plugin: the driver, open, on a simulated radio; or in a labseq of its own."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from labseq_soapy.settings import SoapySettings
from labseq_soapy.static_tweezers import SoapyStaticTweezers
from labseq_soapy_sim import Ring
from labseq_soapy_sim.radio import SimulatedRadio
from numpy.typing import NDArray

from labseq.plugin import Clock, Context, Simulation, SiteGrid, wait_for
from labseq.roles import NeverStopped
from labseq.testing.fakes import FakeClock

GRID = SiteGrid(3, 4)
COMB = {"centre": 100e6, "step": 60e3}
SMALL: dict[str, Any] = {
    "device": "simulated,speed=1,buffer=0.02",
    "sample_rate": 1.2e6,
    "row_frequency": COMB,
    "column_frequency": COMB,
}
"""Few tones at a low rate, in real time: little work."""
WAIT_S = 20.0
"""Longer than anything takes that comes at all."""


@dataclass
class Rig:
    """The driver and what it works with."""

    tweezers: SoapyStaticTweezers
    clock: FakeClock

    @property
    def ring(self) -> Ring:
        radio = self.tweezers.radio
        assert isinstance(radio, SimulatedRadio)
        return radio.ring

    def described(self, name: str) -> Any:
        return self.tweezers.describe()[name]


def made(
    grid: SiteGrid = GRID,
    simulation: Simulation | None = None,
    clock: FakeClock | None = None,
    arguments: str = "",
    **settings: Any,
) -> Rig:
    """The driver, closed."""
    clock = clock or FakeClock()
    chosen = {**SMALL, **settings}
    chosen["device"] += f",{arguments}" if arguments else ""
    context = Context("static_tweezers", grid, clock=clock, simulation=simulation)
    return Rig(SoapyStaticTweezers(SoapySettings.model_validate(chosen), context), clock)


@contextmanager
def opened(*args: Any, **settings: Any) -> Generator[Rig]:
    """The driver, open; see :func:`made`."""
    rig = made(*args, **settings)
    rig.tweezers.open()
    try:
        yield rig
    finally:
        rig.tweezers.close()


def until(condition: Callable[[], bool], longest_s: float = WAIT_S) -> None:
    """Wait until something has come about."""
    pause = threading.Event()
    clock: Clock = NeverStopped()

    def poll(longest_s: float) -> bool | None:
        if condition():
            return True
        pause.wait(longest_s)
        return None

    assert wait_for(poll, longest_s, clock), "it did not come about"


def recorded(folder: Path, channel: int = 0) -> NDArray[np.complex64]:
    """All that a channel was sent, with ``record=n`` among the simulated radio's arguments."""
    return np.fromfile(folder / f"channel{channel}", np.complex64)


def depth(samples: NDArray[np.complex64], n_loop: int, full: slice) -> NDArray[np.float64]:
    """Depth at each sample, by the loop that is found in a stretch at full depth.

    Where the samples are not the loop times a real factor, as after a jump of a phase, it is nan.
    """
    start = full.start - full.start % n_loop + n_loop
    loop = samples[start : start + n_loop].astype(np.complex128)
    course = samples / np.resize(loop, len(samples))
    factor = np.where(np.abs(course.imag) < 1e-3, np.abs(course.real), np.nan)
    return np.where(np.abs(np.resize(loop, len(samples))) > 0.05 * np.abs(loop).max(), factor, 0.0) ** 4


def assert_ramped_down(folder: Path) -> None:
    """What both outputs were sent goes to nothing in a linear ramp of 10 ms."""
    for channel in (0, 1):
        samples = recorded(folder, channel)
        assert not samples[-1000:].any()
        lit = np.flatnonzero(samples)
        full = slice(int(lit[0]) + 20_000, int(lit[-1]) - 20_000)
        falling = depth(samples, 80, full)[full.stop :]
        assert not np.isnan(falling).any(), "a phase jumped"
        known = falling[np.abs(samples[full.stop :]) > 0.02]
        assert np.abs(np.diff(known)).max() < 20 / (0.01 * 1.2e6)


LABSEQ = """
import json, os, sys
from labseq.plugin import Context, SiteGrid
from labseq_soapy.settings import SoapySettings
from labseq_soapy.static_tweezers import SoapyStaticTweezers
context = Context("static_tweezers", SiteGrid(3, 4))
tweezers = SoapyStaticTweezers(SoapySettings.model_validate_json(sys.argv[1]), context)
tweezers.open()
tweezers.start()
child = os.fork() if sys.argv[2:] else None
if child == 0:
    sys.stdin.read()  # until the test ends: it has a copy of the pipe to the streaming process
    os._exit(0)
found = tweezers.emergency()
print(json.dumps(found and [str(found.script), dict(found.arguments)]), flush=True)
sys.stdin.read()
tweezers.close()
"""


@contextmanager
def another_labseq(
    folder: Path, *, forks: bool = False, **settings: Any
) -> Generator[tuple[subprocess.Popen[str], Any]]:
    """A process that has the array on, and its emergency script with arguments; it ends with its input."""
    device = f"{SMALL['device']},folder={folder},record=10000000"
    chosen = SoapySettings.model_validate({**SMALL, "device": device, **settings})
    process = subprocess.Popen(
        [sys.executable, "-c", LABSEQ, chosen.model_dump_json(), *(["forks"] if forks else [])],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    try:
        yield process, json.loads(process.stdout.readline())
    finally:
        process.kill()
        process.communicate()
