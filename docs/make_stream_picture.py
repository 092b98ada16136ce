"""Draw what the driver of the AWG writes while it streams a rearrangement, and how full the buffers are.

    python docs/make_stream_picture.py

The card is simulated and time is virtual: the picture is the same on every computer.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import matplotlib.pyplot as plt
import numpy as np
from labseq_psca.planner import PscaPlanner, PscaSettings
from labseq_spcm import stream_kernels as k
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings
from labseq_spcm.stream import Stream
from labseq_spcm_sim import SimulatedCard, installed, registers
from numpy.typing import NDArray

import labseq
from labseq.plugin import Context, SiteGrid, TargetPattern
from labseq.testing.fakes import FakeClock

PICTURE: Final = Path(__file__).parent / "_static" / "stream_levels.png"
STEP_S: Final = 10e-6
RATE_HZ: Final = 624e6
BYTES_PER_S: Final = 4 * RATE_HZ
BEGINNING_S: Final = 1e-3


def record() -> tuple[NDArray[np.float64], list[float], list[float]]:
    """Play one rearrangement of 20 x 20 sites into a block of 15 x 15, its first batches first.

    Returns:
        The time, and the playing time of the program that waits in the computer, and of what is on the card,
        float64 (n, 3); the times at which samples were handed over; those of ``play`` and ``append``, and of
        the end. All in seconds.
    """
    grid, clock = SiteGrid(), FakeClock()
    context = Context("mobile_tweezers", grid, clock=clock)
    occupancy = np.random.default_rng(1).random(grid.shape) < 0.75
    fill = np.zeros(grid.shape, np.bool_)
    fill[2:17, 2:17] = True
    plan = PscaPlanner(PscaSettings(), context).plan(occupancy, TargetPattern(fill, np.zeros_like(fill)))
    n_first = 5
    parts = [
        labseq.tone_program(part, grid) for part in (plan.first(n_first), plan.part(n_first, plan.n_batches))
    ]
    card, levels, marks = SimulatedCard(clock), list[tuple[float, float, float]](), list[float]()
    with installed(card) as name:
        settings = SpcmSettings(card=name, mode="stream", sample_rate=RATE_HZ)
        tweezers = SpcmMobileTweezers(settings, context)
        tweezers.open()
        tweezers.settle()
        # what it has written is known to it alone
        stream = tweezers._mode  # noqa: SLF001 # pyright: ignore[reportPrivateUsage]
        assert isinstance(stream, Stream)
        box = stream._box  # noqa: SLF001 # pyright: ignore[reportPrivateUsage]

        def watch(duration_s: float) -> None:
            for _ in range(math.ceil(duration_s / STEP_S)):
                on_card = card.levels[1]
                waiting = max(0, box[k.MADE] - box[k.FETCHED])
                levels.append((clock.now(), waiting / RATE_HZ, on_card / BYTES_PER_S))
                clock.sleep(STEP_S)

        clock.sleep(5e-3)
        watch(BEGINNING_S)
        tweezers.prepare_beginning(parts[0])
        marks.append(clock.now())
        tweezers.play()
        watch(0.4e-3)
        marks.append(clock.now())
        tweezers.append(parts[1])
        watch(sum(part.total_duration_s for part in parts))
        tweezers.wait(1.0)
        marks.append(clock.now())
        watch(BEGINNING_S)
        handed = [one.time_s for one in card.log if one.register == registers.SPC_DATA_AVAIL_CARD_LEN]
        tweezers.close()
    return np.array(levels), handed, marks


def draw(path: Path = PICTURE) -> None:
    """Draw the picture."""
    levels, handed, marks = record()
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(7.4, 4.2), sharex=True, height_ratios=(5, 1), layout="constrained"
    )
    times_ms, waiting_ms, on_card_ms = 1e3 * levels.T - [[1e3 * marks[0]], [0.0], [0.0]]
    colors = "#3b6ea5", "#a9c4de"
    above.stackplot(
        times_ms,
        on_card_ms,
        waiting_ms,
        labels=("on the card", "of the program, waiting"),
        colors=colors,
    )
    above.set_yscale("symlog", linthresh=0.1)
    above.set(ylabel="ahead of the outputs (ms)", ylim=(0, 12))
    above.set_yticks([0, 0.1, 0.25, 1, 10], ["0", "0.1", "0.25", "1", "10"])
    above.legend(loc="upper center", fontsize=8)
    for mark_s, name, side in zip(marks, ("play", "append", "end"), ("right", "left", "left"), strict=True):
        at_ms = 1e3 * (mark_s - marks[0])
        for axes in (above, below):
            axes.axvline(at_ms, color="#c44e52", linewidth=0.8)
        above.text(at_ms, 11, f" {name} ", fontsize=8, va="top", ha=side, color="#c44e52")
    shown_ms = [1e3 * (time_s - marks[0]) for time_s in handed if time_s >= levels[0, 0]]
    below.eventplot(shown_ms, linewidths=0.5, colors="#333333")
    below.set(xlabel="time after play() (ms)", xlim=(times_ms[0], times_ms[-1]))
    below.set_yticks([1.0], ["samples handed over"], fontsize=8)
    for axes in (above, below):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    draw()
