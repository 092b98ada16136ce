"""Test whether an amplifier that saturates makes the step of figure 4 at 13 tweezers; print its table.

    python docs/make_compression_table.py

Tones of a row of 20, 1.6 MHz apart, with random preassigned phases, are summed at 625 MS/s and pass an
amplifier whose output saturates as ``tanh``. With all 20 on, their amplitudes are adjusted until the
depths, squares of the amplitudes at the output, are equal to 2 %, as in the paper. Then each number n of
them is on, chosen at random, with the same amplitudes. The level is such that the mean depth falls by as
much from 1 to 12 tones as the fitted 3 % for each tone make.
"""

from __future__ import annotations

import sys
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
N_TONES: Final = 20
RATE_HZ, STEP_HZ, CENTRE_HZ = 625e6, 1.6e6, 100e6
N_SAMPLES: Final = 3125
"""Five microseconds: every tone and every product of tones has a whole number of periods."""
FREQUENCY_HZ: Final = CENTRE_HZ + STEP_HZ * (np.arange(N_TONES) - N_TONES // 2)
WAVES: Final = np.exp(2j * np.pi * np.outer(FREQUENCY_HZ, np.arange(N_SAMPLES) / RATE_HZ))
THRESHOLD: Final = 1.56 / 2.1
"""The depth of 12.5 tones, where the paper suspects a threshold, in depths of a single tone."""


def depths(drive: Floats, phase: Floats, level: float) -> Floats:
    """Depth of each tone at the amplifier's output; ``level`` is the input at which it saturates."""
    signal = np.real((drive * np.exp(1j * phase)) @ WAVES)
    output = level * np.tanh(signal / level)
    return np.abs(2.0 / N_SAMPLES * (WAVES.conj() @ output)) ** 2


def equalised(phase: Floats, level: float) -> Floats:
    """Amplitudes with which 20 tones are equally deep to 2 %."""
    drive = np.ones(N_TONES)
    for _ in range(200):
        depth = depths(drive, phase, level)
        if depth.std() < 0.02 * depth.mean():
            break
        drive *= (depth.mean() / depth) ** 0.25
    return drive


def measure(level: float, n_cases: int) -> Floats:
    """Mean depth, its relative s.d., and the share below the threshold, for each n from 1 to 15."""
    rng = np.random.default_rng(1)
    found: list[list[Floats]] = [[] for _ in range(15)]
    for _ in range(n_cases):
        phase = rng.uniform(0.0, 2 * np.pi, N_TONES)
        drive = equalised(phase, level)
        for n in range(1, 16):
            on = np.zeros(N_TONES)
            chosen = rng.choice(N_TONES, n, replace=False)
            on[chosen] = drive[chosen]
            found[n - 1].append(depths(on, phase, level)[chosen])
    alone = np.mean(found[0])
    rows = [np.concatenate(one) / alone for one in found]
    return np.array([(row.mean(), row.std() / row.mean(), (row < THRESHOLD).mean()) for row in rows])


def main() -> None:
    """Find the level, measure, and print the table."""
    low, high = 1.0, 100.0
    for _ in range(12):
        level = (low * high) ** 0.5
        if measure(level, 20)[11, 0] < 1 / (1 + 0.03 * 11):
            low = level
        else:
            high = level
    table = measure((low * high) ** 0.5, 300)
    columns = range(6, 16)
    lines = ["| tones | " + " | ".join(map(str, columns)) + " |", "| --- " * 11 + "|"]
    for name, column in zip(("mean depth", "scatter of depths", "below the threshold"), table.T, strict=True):
        lines.append(f"| {name} (%) | " + " | ".join(f"{100 * column[n - 1]:.1f}" for n in columns) + " |")
    sys.stdout.write("\n".join([*lines, ""]))


if __name__ == "__main__":
    main()
