"""Streams rearrangements in real time, beside processes that compute without end, and counts underruns.

    python -m tests.benchmarks.stream_load --programs 10000 --load 2

The simulated card plays in real time: what the computer does not hand over in time is missing. From a plan to
the light it goes as in a run: the tones of the first batches, ``prepare_beginning``, ``play``, then the rest.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from dataclasses import dataclass

import numpy as np
from labseq_psca.planner import PscaPlanner, PscaSettings
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings
from labseq_spcm_sim import SimulatedCard, installed

from labseq.motion import tone_program, warm_rendering
from labseq.plugin import Context, Plan, SiteGrid, TargetPattern, TransientError
from labseq.realtime import prepare_process, raise_priority, restore_priority

N_FIRST = 5
PAUSE_S = 2e-3


@dataclass
class Counts:
    """What happened to the programs."""

    to_light_s: list[float]
    n_in_motion: int = 0
    n_in_silence: int = 0


def compute() -> None:
    """Keep a core busy."""
    while True:
        sum(range(100_000))


def plans(n: int) -> list[Plan]:
    grid = SiteGrid()
    fill = np.zeros(grid.shape, np.bool_)
    fill[2:17, 2:17] = True
    target = TargetPattern(fill, np.zeros_like(fill))
    planner, random = PscaPlanner(PscaSettings(), Context(grid=grid)), np.random.default_rng(1)
    return [planner.plan(random.random(grid.shape) < 0.75, target) for _ in range(n)]


def stream(n_programs: int, rate_hz: float, look_ahead_s: float, *, has_priority: bool) -> Counts:
    """Play programs one after another."""
    context = Context("mobile_tweezers", SiteGrid())
    card, counts, known = SimulatedCard(context.clock), Counts([]), plans(50)
    warm_rendering()
    prepare_process()
    with installed(card) as name:
        settings = SpcmSettings(card=name, mode="stream", sample_rate=rate_hz, look_ahead=look_ahead_s)
        tweezers = SpcmMobileTweezers(settings, context)
        tweezers.warm()
        tweezers.open()
        tweezers.settle()
        try:
            for number in range(n_programs):
                plan = known[number % len(known)]
                if has_priority:
                    raise_priority()
                start_s = time.perf_counter()
                try:
                    duration_s = tweezers.prepare_beginning(tone_program(plan.first(N_FIRST), context.grid))
                    tweezers.play()
                    counts.to_light_s.append(time.perf_counter() - start_s + tweezers.start_delay_s)
                    rest = tone_program(plan.part(N_FIRST, plan.n_batches), context.grid)
                    tweezers.append(rest)
                    restore_priority()
                    tweezers.wait(duration_s + rest.total_duration_s + 1.0)
                except TransientError as error:
                    print(error) if counts.n_in_motion < 3 else None
                    counts.n_in_motion += 1
                    tweezers.safe_state()  # as a run does
                restore_priority()
                card.forget(context.clock.now())
                time.sleep(PAUSE_S)
            counts.n_in_silence = int(tweezers.describe()["silent_underruns"])
        finally:
            tweezers.close()
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--programs", type=int, default=1000)
    parser.add_argument("--load", type=int, default=2, help="processes that compute without end")
    parser.add_argument("--rate", type=float, default=250e6, help="samples per second")
    parser.add_argument("--look-ahead", type=float, default=0.4e-3, help="silence ahead of the outputs, s")
    parser.add_argument("--no-priority", action="store_true", help="as a user without rtprio")
    given = parser.parse_args()
    busy = [multiprocessing.Process(target=compute, daemon=True) for _ in range(given.load)]
    for process in busy:
        process.start()
    try:
        counts = stream(given.programs, given.rate, given.look_ahead, has_priority=not given.no_priority)
    finally:
        for process in busy:
            process.terminate()
    median, p99, worst = 1e3 * np.quantile(counts.to_light_s or [np.nan], (0.5, 0.99, 1.0))
    print(f"{given.programs} programs, {given.load} busy processes, load {os.getloadavg()[0]:.1f}")
    print(f"plan to light: median {median:.2f} ms, 99 % {p99:.2f} ms, at most {worst:.2f} ms")
    print(f"underruns: {counts.n_in_motion} in motion, {counts.n_in_silence} in silence")


if __name__ == "__main__":
    main()
