"""Rearranges in real time in the mode ``sequence`` or ``replay``: the times to the light and to the end.

    python -m tests.benchmarks.sequence_load --programs 200 --load 2

From a frame in memory on it goes as in a run. The simulated card takes the time of the bus, in this process;
what it computes for that counts as well.
"""

from __future__ import annotations

import argparse
import gc
import multiprocessing
import os
import time

import numpy as np
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings
from labseq_spcm_sim import SimulatedCard, installed

from labseq.kernels.kernel import load_kernels
from labseq.motion import check_plan, tone_program, warm
from labseq.plugin import Context, Frame
from labseq.realtime import raise_priority, real_time, restore_priority

from .stream_load import GRID, MOTION, N_FIRST, Rearrangement, compute, take_frames

TIMES = ("frame to play()", "play() to the end", "longer than planned")


def rearrange(path: Rearrangement, frame: Frame, mode: str) -> list[float]:
    """Rearrange once; returns the times of TIMES in seconds."""
    tweezers, begun_s = path.tweezers, time.perf_counter()
    occupancy, *_ = path.detector.detect(frame)
    plan = path.planner.plan(occupancy, path.target)
    check_plan(plan, occupancy, path.target, path.dop, GRID, MOTION)
    n_first = plan.n_batches if mode == "replay" else min(N_FIRST, plan.n_batches)
    beginning = tone_program(plan.first(n_first), GRID, MOTION)
    (tweezers.prepare if mode == "replay" else tweezers.prepare_beginning)(beginning)
    tweezers.play()
    played_s, duration_s = time.perf_counter(), beginning.total_duration_s
    if n_first < plan.n_batches:
        rest = tone_program(plan.part(n_first, plan.n_batches), GRID, MOTION)
        tweezers.append(rest)
        duration_s += rest.total_duration_s
    restore_priority()
    tweezers.wait(duration_s + 1.0)
    took_s = time.perf_counter() - played_s
    return [played_s - begun_s, took_s, took_s - duration_s]


def measure(given: argparse.Namespace) -> tuple[list[list[float]], list[int]]:
    """The times of each program, and how many of its parts were late."""
    context = Context("mobile_tweezers", GRID, motion=MOTION)
    card, frames = SimulatedCard(context.clock, keep_history=False), take_frames()
    times_s, n_late = list[list[float]](), list[int]()
    with real_time(), installed(card) as name:
        settings = SpcmSettings(card=name, mode=given.mode, sample_rate=given.rate)
        tweezers = SpcmMobileTweezers(settings, context)
        tweezers.warm()
        warm()
        load_kernels()
        tweezers.open()
        tweezers.settle()
        path = Rearrangement(given.dop, tweezers, card)
        gc.collect()
        gc.freeze()
        gc.disable()
        try:
            for number in range(-5, given.programs):
                before = int(tweezers.describe().get("delayed_batches", 0))
                raise_priority()  # as a run does from the read-out on
                taken_s = rearrange(path, frames[number % len(frames)], given.mode)
                if number >= 0:
                    times_s.append(taken_s)
                    n_late.append(int(tweezers.describe().get("delayed_batches", 0)) - before)
                time.sleep(20e-3)
        finally:
            tweezers.close()
    return times_s, n_late


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--programs", type=int, default=200)
    parser.add_argument("--mode", choices=["sequence", "replay"], default="sequence")
    parser.add_argument("--load", type=int, default=0, help="processes that compute without end")
    parser.add_argument("--rate", type=float, default=624e6, help="samples per second")
    parser.add_argument("--dop", type=int, default=7, help="degree of parallelism")
    given = parser.parse_args()
    busy = [multiprocessing.Process(target=compute, daemon=True) for _ in range(given.load)]
    for process in busy:
        process.start()
    try:
        times_s, n_late = measure(given)
    finally:
        for process in busy:
            process.terminate()
    print(f"mode {given.mode}, {given.programs} programs, {given.load} busy, load {os.getloadavg()[0]:.1f}")
    for name, column_s in zip(TIMES, np.array(times_s).T, strict=True):
        median_ms, p99_ms, most_ms = 1e3 * np.quantile(column_s, (0.5, 0.99, 1.0))
        print(f"{name:20} median {median_ms:.2f}, 99 % {p99_ms:.2f}, most {most_ms:.2f} ms")
    print(f"late parts per program: {np.mean(n_late):.1f}")


if __name__ == "__main__":
    main()
