"""Draw what a simulated card and a simulated radio put out after the process that uses them was killed.

    python docs/make_off_picture.py

Twice: with labseq's watchdog and without. The simulated hardware plays in real time and outlives the killed
process; times differ a little between computers.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import matplotlib.pyplot as plt
import numpy as np
from labseq_soapy_sim import read_trace
from numpy.typing import NDArray

from tests.plugins.card_process_emergency import Connection

PICTURE: Final = Path(__file__).parent / "_static" / "off_after_kill.png"
BEFORE_S: Final = 0.02
AFTER_S: Final = 0.3
STEP_S: Final = 0.5e-3

LABSEQ: Final = """
import sys, threading
import numpy as np
from labseq.motion import tone_program
from labseq.plugin import Context, MotionSpec, Plan, SiteGrid
from labseq.plugin.motion import RfSpec
from labseq.watchdog import Watchdog
from labseq_soapy.settings import SoapySettings
from labseq_soapy.static_tweezers import SoapyStaticTweezers
from labseq_spcm import card, replay_fifo
from labseq_spcm.settings import SpcmSettings
from tests.plugins.card_process import TweezersOfProcess

card.TRANSFER_TIMEOUT_S = replay_fifo.TRANSFER_TIMEOUT_S = 60.0  # samples go through a pipe
folder = sys.argv[1]
hz, band = np.linspace(12e6, 18e6, 5), (10e6, 20e6)
grid = SiteGrid(5, 5, row_frequency_hz=hz, column_frequency_hz=hz)
motion = MotionSpec(speed_m_s=1e-5, rf=RfSpec(row_band_hz=band, column_band_hz=band))
settings = SpcmSettings(card=f"simulated@{folder}/card", mode="fifo", sample_rate=50e6, fill=0.5)
mobile = TweezersOfProcess(settings, Context("mobile_tweezers", grid, motion=motion))
comb = {"centre": 100e6, "step": 60e3}
device = f"simulated,speed=1,buffer=0.02,patience=0,record=100000000,folder={folder}"
radio = SoapySettings(device=device, sample_rate=1.2e6, row_frequency=comb, column_frequency=comb)
static = SoapyStaticTweezers(radio, Context("static_tweezers", SiteGrid(3, 4)))
mobile.open()
static.open()
plan = Plan.from_batches([([(0, 0), (0, 2)], [(0, 1), (0, 3)])] * 3)
mobile.prepare(tone_program(plan, grid, motion))
if sys.argv[2] == "watched":
    watchdog = Watchdog()
    for order, device in enumerate((mobile, static)):
        found = device.emergency()
        watchdog.add(str(order), order, found.script, dict(found.arguments))
static.start()
mobile.play()
threading.Thread(target=mobile.wait, args=(1e3,), daemon=True).start()
print(static.emergency().arguments["pid"], flush=True)
sys.stdin.read()
"""
Values = NDArray[np.float64]


@dataclass(frozen=True)
class Outputs:
    """What was put out, by time since the kill, in steps of ``STEP_S``.

    Attributes:
        card_mv: Rms voltage at output 0 of the card, across 50 Ohm, in mV.
        radio: Rms of the samples at output 0 of the radio, relative to full scale.
        transmits: Whether the radio's transmitters are on.
    """

    card_mv: Values
    radio: Values
    transmits: NDArray[np.bool_]


TIMES_S: Final = np.arange(-BEFORE_S, AFTER_S, STEP_S)


def record(folder: Path, *, is_watched: bool) -> Outputs:
    """Kill a process whose tweezers are on; without a watch its streaming process is killed, too."""
    how = "watched" if is_watched else "alone"
    command = [sys.executable, "-c", LABSEQ, str(folder), how]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as labseq:  # noqa: S603
        assert labseq.stdout is not None
        streaming = int(labseq.stdout.readline())
        time.sleep(2 * BEFORE_S)
        killed_s = time.monotonic()
        labseq.kill()
        if not is_watched:
            os.kill(streaming, signal.SIGKILL)
    time.sleep(max(0.0, killed_s + 2 * AFTER_S - time.monotonic()))
    card = Connection(str(folder / "card"))
    outputs = Outputs(_of_card(card, killed_s), *_of_radio(folder, killed_s))
    card("power_off")
    return outputs


def _of_card(card: Connection, killed_s: float) -> Values:
    square = np.zeros(len(TIMES_S))
    for span in card("played", 0):
        for index, start_s in enumerate(killed_s + TIMES_S):
            if span.start_s < start_s + STEP_S and span.end_s > start_s:
                values = span.between(start_s, start_s + STEP_S).values() * (span.amplitude_v / 32767)
                square[index] += np.sum(values**2) / (STEP_S * span.sample_rate_hz)
    return 1e3 * np.sqrt(square)


def _of_radio(folder: Path, killed_s: float) -> tuple[Values, NDArray[np.bool_]]:
    trace = read_trace(folder)
    _, _, start_s, rate_hz = [entry for entry in trace if entry[1] == "play"][-1]
    samples = np.fromfile(folder / "channel0", np.complex64)
    edges = np.rint((killed_s + np.append(TIMES_S, AFTER_S) - start_s) * rate_hz).astype(int)
    pieces = [samples[max(0, a) : max(0, b)] for a, b in pairwise(edges)]
    rms = [float(np.sqrt(np.mean(np.abs(piece) ** 2))) if len(piece) else 0.0 for piece in pieces]
    changes = [(time_s, name == "play") for time_s, name, *_ in trace if name in ("play", "stop", "close")]
    states = [[is_on for time_s, is_on in changes if time_s <= killed_s + at_s][-1:] for at_s in TIMES_S]
    return np.array(rms), np.array([state == [True] for state in states])


def draw(watched: Outputs, alone: Outputs, path: Path) -> None:
    """Draw both records, one below the other."""
    figure, (top, bottom) = plt.subplots(2, 1, sharex=True, figsize=(8, 5.2), layout="constrained")
    times_ms = 1e3 * TIMES_S
    left_alone = {"card_mv": "left alone", "radio": "left alone, its streaming process killed, too"}
    for axes, name in ((top, "card_mv"), (bottom, "radio")):
        axes.plot(times_ms, getattr(alone, name), color="#b00020", linestyle="--", label=left_alone[name])
        axes.plot(times_ms, getattr(watched, name), color="#00509d", label="with labseq's watchdog")
        axes.axvline(0, color="0.4", linewidth=0.8)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
        axes.legend(loc="center right" if axes is top else "upper right")
    dark = alone.transmits & (alone.radio == 0)
    top_of_band = 0.06 * bottom.get_ylim()[1]
    bottom.fill_between(times_ms, 0, top_of_band, where=dark, color="#b00020", alpha=0.35, linewidth=0)
    bottom.annotate("transmitters still on", (210, 1.2 * top_of_band), color="#b00020")
    top.set_title("Simulated AWG in the mode fifo, output 0")
    top.set_ylabel("rms voltage (mV)")
    bottom.set_title("Simulated radio, output 0")
    bottom.set_ylabel("rms (full scale = 1)")
    bottom.set_xlabel("time after kill -9 (ms)")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def make(path: Path = PICTURE) -> tuple[Outputs, Outputs]:
    """Record and draw; returns what was put out with the watchdog and without."""
    with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as other:
        watched, alone = record(Path(one), is_watched=True), record(Path(other), is_watched=False)
    draw(watched, alone, path)
    return watched, alone


if __name__ == "__main__":
    make()
