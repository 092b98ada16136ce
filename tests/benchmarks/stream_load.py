"""Streams rearrangements in real time, beside processes that compute without end, and counts underruns.

    python -m tests.benchmarks.stream_load --programs 10000 --load 2 --rate 624e6 --picture light.png

The simulated card plays in real time, in compiled code that needs no lock of Python (``native_card.py``):
what the driver does not hand over in time is missing. From a frame in memory to the light it goes as in a
run: detector, planner, check, tones of the first batches, ``prepare_beginning``, ``play``; then the rest. The
light is when the card's clock reached the first sample of the program.
"""

from __future__ import annotations

import argparse
import gc
import math
import multiprocessing
import os
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from labseq_psca.planner import PscaPlanner, PscaSettings
from labseq_spcm import stream_kernels as words
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings
from labseq_spcm.stream import Stream
from labseq_spcm_sim import SimulatedCard, installed
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation
from numpy.typing import NDArray

from labseq.bench.latency import draw_times
from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq.kernels.kernel import kernel, load_kernels
from labseq.kernels.native import new_timer, now_ns, sleep_ns
from labseq.motion import check_plan, tone_program, warm
from labseq.motion.rendering import warm_rendering
from labseq.plugin import (
    Context,
    DepthRamp,
    Frame,
    MotionSpec,
    RandomStream,
    SiteGrid,
    TargetPattern,
    TransientError,
)
from labseq.realtime import raise_priority, real_time, restore_priority

from .native_card import native_stream

Words = NDArray[np.int64]

N_FIRST = 5
N_FRAMES = 50
STAGES = ("detect", "plan", "check", "tones", "prepare", "play", "silence")
GRID, MOTION = SiteGrid(), MotionSpec(overhead_per_batch_s=0.0)


@dataclass
class Counts:
    """What happened to the programs.

    Attributes:
        stages_s: Of each program, the times of the stages, in order.
        n_in_motion: Underruns while a program played.
        n_in_silence: Underruns between programs.
        least_ahead_s: Of each program, how far ahead of the card its rendering was, where it was closest.
        woken_ns: How long sleeps of 50 us took before.
    """

    stages_s: list[list[float]] = field(default_factory=list[list[float]])
    least_ahead_s: list[float] = field(default_factory=list[float])
    n_in_motion: int = 0
    n_in_silence: int = 0
    woken_ns: Words = field(default_factory=lambda: np.zeros(20_000, np.int64))


@kernel("void(int64[::1], int64[::1], int64)")
def time_sleeps(timer: Words, took_ns: Words, duration_ns: int) -> None:
    """How long each of some sleeps takes: a thread with priority, as that which feeds the card."""
    for i in range(len(took_ns)):
        start_ns = now_ns(timer)
        sleep_ns(timer, duration_ns)
        took_ns[i] = now_ns(timer) - start_ns


def compute() -> None:
    """Keep a core busy."""
    while True:
        sum(range(100_000))


def take_frames() -> list[Frame]:
    random = RandomStream(0)
    simulation = VirtualSimulation(SimulationSettings(), Context("simulation", GRID, random=random))
    simulation.open()
    simulation.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    frames = list[Frame]()
    for number in range(N_FRAMES):
        random.begin_shot(number, 0)
        simulation.begin_shot()
        simulation.load(0.0, 0.5)
        frames.append(simulation.expose(1.0, 45e-3))
    return frames


class Rearrangement:
    """Everything between a frame and the samples, as a run calls it."""

    def __init__(self, dop: int, tweezers: SpcmMobileTweezers, card: SimulatedCard) -> None:
        fill = np.zeros(GRID.shape, np.bool_)
        fill[2:17, 2:17] = True
        self.target = TargetPattern(fill, np.zeros_like(fill))
        self.dop = dop
        self.planner = PscaPlanner(PscaSettings(degree_of_parallelism=dop), Context(grid=GRID, motion=MOTION))
        self.detector = ThresholdDetector(ThresholdSettings(), Context("detector", GRID))
        self.tweezers = tweezers
        self.card = card

    @property
    def stream(self) -> Stream:
        mode = self.tweezers._mode
        assert isinstance(mode, Stream)
        return mode

    def run(self, frame: Frame) -> list[float]:
        """Play a program to its end; returns the times of its stages in seconds."""
        ticks = [time.perf_counter()]
        occupancy, *_ = self.detector.detect(frame)
        ticks.append(time.perf_counter())
        plan = self.planner.plan(occupancy, self.target)
        ticks.append(time.perf_counter())
        check_plan(plan, occupancy, self.target, self.dop, GRID, MOTION)
        ticks.append(time.perf_counter())
        beginning = tone_program(plan.first(N_FIRST), GRID, MOTION)
        ticks.append(time.perf_counter())
        duration_s = self.tweezers.prepare_beginning(beginning)
        ticks.append(time.perf_counter())
        self.tweezers.play()
        ticks.append(time.perf_counter())
        began = self.stream._alive[-1].words
        if plan.n_batches > N_FIRST:
            rest = tone_program(plan.part(N_FIRST, plan.n_batches), GRID, MOTION)
            self.tweezers.append(rest)
            duration_s += rest.total_duration_s
        restore_priority()
        self.tweezers.wait(duration_s + 1.0)
        fifo = self.card._machine.fifo
        if fifo is not None and math.isfinite(fifo.play_s):  # else it ran dry just now
            light_s = fifo.play_s + int(began[words.BEGAN]) / self.stream._rate_hz
            if light_s < time.perf_counter():  # else it ran dry after the program, and began again
                ticks.append(light_s)
        return np.diff(ticks).tolist()


def stream(given: argparse.Namespace) -> Counts:
    """Play programs one after another."""
    context = Context("mobile_tweezers", GRID, motion=MOTION)
    card, counts, frames = SimulatedCard(context.clock, keep_history=False), Counts(), take_frames()
    with ExitStack() as context_of_card, real_time(), installed(card) as name:
        settings = SpcmSettings(
            card=name,
            mode="stream",
            sample_rate=given.rate,
            look_ahead=given.look_ahead,
            notify_size=given.notify,
            card_buffer=given.card_buffer,
        )
        tweezers = SpcmMobileTweezers(settings, context)
        context_of_card.enter_context(native_stream(tweezers, name, context.clock))
        tweezers.warm()
        warm()
        warm_rendering()
        load_kernels()
        raise_priority()
        time_sleeps(new_timer(), counts.woken_ns, 50_000)
        tweezers.open()
        tweezers.settle()
        path = Rearrangement(given.dop, tweezers, card)
        gc.collect()
        gc.freeze()
        gc.disable()
        try:
            for number in range(-5, given.programs):
                if not given.no_priority:
                    raise_priority()  # as a run does from the read-out on
                try:
                    stages_s = path.run(frames[number % len(frames)])
                    if number >= 0 and len(stages_s) == len(STAGES):
                        counts.stages_s.append(stages_s)
                        counts.least_ahead_s.append(path.stream.least_ahead_s)
                except TransientError as error:
                    print(error) if counts.n_in_motion < 3 else None
                    counts.n_in_motion += 1
                    tweezers.safe_state()  # as a run does
                restore_priority()
                time.sleep(given.pause)
            counts.n_in_silence = int(tweezers.describe()["silent_underruns"])
        finally:
            tweezers.close()
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--programs", type=int, default=1000)
    parser.add_argument("--load", type=int, default=2, help="processes that compute without end")
    parser.add_argument("--rate", type=float, default=624e6, help="samples per second")
    parser.add_argument("--dop", type=int, default=7, help="degree of parallelism")
    parser.add_argument("--look-ahead", type=float, default=None, help="silence ahead of the outputs, s")
    parser.add_argument("--notify", type=int, default=SpcmSettings().notify_size, help="notify_size")
    parser.add_argument("--card-buffer", type=int, default=SpcmSettings().card_buffer, help="card_buffer")
    parser.add_argument("--pause", type=float, default=20e-3, help="between programs, s")
    parser.add_argument("--no-priority", action="store_true", help="as a user without rtprio")
    parser.add_argument("--picture", type=Path, help="histogram of the times to the light")
    given = parser.parse_args()
    busy = [multiprocessing.Process(target=compute, daemon=True) for _ in range(given.load)]
    for process in busy:
        process.start()
    try:
        counts = stream(given)
    finally:
        for process in busy:
            process.terminate()
    late_us = 1e-3 * np.quantile(counts.woken_ns, (0.5, 0.99, 0.999, 1.0))
    print(
        "a sleep of 50 us takes, us: median {:.0f}, 99 % {:.0f}, 99.9 % {:.0f}, most {:.0f}".format(*late_us)
    )
    print(f"{given.programs} programs, {given.load} busy processes, load {os.getloadavg()[0]:.1f}")
    times_us = 1e6 * np.array(counts.stages_s).reshape(-1, len(STAGES))
    rows = [*zip(STAGES, times_us.T, strict=True), ("frame to light", times_us.sum(axis=1))]
    print(f"{'us':16} {'median':>8} {'99 %':>8} {'99.9 %':>8} {'most':>8}")
    for name, stage_us in rows:
        numbers = np.quantile(stage_us, (0.5, 0.99, 0.999, 1.0))
        print(f"{name:16}", *(f"{number:8.0f}" for number in numbers))
    ahead_us = 1e6 * np.quantile(counts.least_ahead_s, (0.5, 0.01, 0.001, 0.0))
    print(
        "rendered ahead, where it is least, us: median {:.0f}, 1 % {:.0f}, 0.1 % {:.0f}, least {:.0f}".format(
            *ahead_us
        )
    )
    print(f"underruns: {counts.n_in_motion} in motion, {counts.n_in_silence} in silence")
    if given.picture:
        title = f"mode stream, {len(times_us)} programs, {given.load} busy processes"
        draw_times((1e-6 * times_us.sum(axis=1)).tolist(), title, given.picture)


if __name__ == "__main__":
    main()
