"""How often a tweezer that passes in a lane takes an atom that stands beside it: the table of its page.

    python docs/make_passes.py [--atoms 20000]

The command replaces the part of ``docs/explanation/grid-planner.md`` between ``<!-- measured: passes -->``
and ``<!-- end -->``. Atoms move by Newton's law in the light of a static tweezer and of a mobile one that
passes at constant speed along the lane, as in the simulation of played samples (``labseq_virtual.flight``).
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from itertools import product
from pathlib import Path
from typing import Final

import numpy as np
from labseq_grid.planner import WEAVE
from labseq_virtual.flight import Conditions, machine
from labseq_virtual.flight_kernels import fly_in_light
from labseq_virtual.formulas import KELVIN
from labseq_virtual.records import FATES, SITE, plane_of
from labseq_virtual.settings import SimulationSettings

from labseq.model import MotionSpec

PAGE: Final = Path(__file__).parent / "explanation" / "grid-planner.md"
FRAME_S: Final = 0.5e-6
"""Time between two points of a path, in seconds."""
GROUP: Final = 100
"""Atoms followed together, each in a static tweezer of its own, APART_M from the next."""
APART_M: Final = 30e-6
REACH_M: Final = 6e-6
"""How far from the atom the tweezer comes on and goes off, along its way."""
STATIC: Final = SimulationSettings()
SPACING_M: Final = 4.49e-6
LANES_M: Final = {
    "triangular, straight": (1.944e-6, 0.0),
    "triangular, weaving": (1.944e-6, WEAVE * 2 * 1.944e-6),
    "square": (2.245e-6, 0.0),
}
"""Half the distance of two rows of sites, and how far the lane swings, by lattice."""
DEPTHS_K: Final = (2.1e-3, 1.0e-3)
TEMPERATURES_K: Final = (30e-6, 15e-6)


def n_taken(
    lane_m: float, swing_m: float, depth_k: float, temperature_k: float, rng: np.random.Generator
) -> int:
    """Let a tweezer pass each of a group of atoms once; count those that their static tweezer loses."""
    sites = np.zeros((1, GROUP), SITE)
    sites["atom"], sites["depth"], sites["heat"] = True, KELVIN * STATIC.static_depth, temperature_k
    down, right = np.array([0.0, REACH_M]), np.array([APART_M, 0.0])
    plane = plane_of(np.zeros(2), down, right)
    n_frames = round(2 * REACH_M / MotionSpec().speed_m_s / FRAME_S)
    rows = np.linspace(1.0, -1.0, n_frames + 1)[None]
    swing = swing_m * np.cos(2 * math.pi * REACH_M / SPACING_M * rows)
    columns = np.arange(float(GROUP))[:, None] + (lane_m + swing) / APART_M
    light = SimulationSettings().mobile_light.model_copy(update={"depth": depth_k})
    numbers = machine(
        STATIC.model_copy(update={"mobile_light": light, "transport_loss": 0.0}), Conditions(cooled=0.0)
    )
    fly_in_light(
        sites, rows, np.ones_like(rows), columns, np.ones_like(columns), 0.0, FRAME_S, numbers,
        plane, rng, np.zeros(len(FATES), np.int64),
    )  # fmt: skip
    return GROUP - int(sites["atom"].sum())


def main() -> None:
    """Write the table into the page."""
    parser = argparse.ArgumentParser(description="Measure what passing tweezers take along.")
    parser.add_argument("--atoms", type=int, default=20_000, help="atoms for each row of the table")
    n_groups = math.ceil(parser.parse_args().atoms / GROUP)
    lines = ["| lane | atoms at | mobile tweezers | taken per pass |", "| --- | --- | --- | --- |"]
    for (lattice, lane), kelvin, depth_k in product(LANES_M.items(), TEMPERATURES_K, DEPTHS_K):
        rng = np.random.default_rng(1)
        n = n_groups * GROUP
        taken = sum(n_taken(*lane, depth_k, kelvin, rng) for _ in range(n_groups)) / n
        error = math.sqrt(max(taken * (1 - taken), 1 / n) / n)
        case = f"{lattice} | {1e6 * kelvin:g} µK | {1e3 * depth_k:g} mK"
        lines.append(f"| {case} | {100 * taken:.3f}({100 * error:.3f}) % |")
        sys.stdout.write(lines[-1] + "\n")
        sys.stdout.flush()
    text = PAGE.read_text(encoding="utf-8")
    part = re.compile(r"(?<=<!-- measured: passes -->\n).*?(?=<!-- end -->)", re.DOTALL)
    body = "\n".join(["", *lines, "", ""])
    PAGE.write_text(part.sub(lambda _: body, text), encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
