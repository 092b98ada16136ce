"""What a tweezer without an atom does to an atom on whose site it ends: the table of its page.

    python docs/make_landings.py [--atoms 10000]

The command replaces the part of ``docs/explanation/checked-plans.md`` between ``<!-- measured: landings -->``
and ``<!-- end -->``. Atoms move by Newton's law in the light of a static tweezer and of a mobile one that
comes from half a site away and is ramped down, as in the simulation of played samples
(``labseq_virtual.flight``), but without the AOD's transit time.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from labseq_virtual.flight import KELVIN, STEP_S, draw_atoms
from labseq_virtual.flight_kernels import N_COLUMNS, energies, follow_atoms
from labseq_virtual.settings import SimulationSettings
from numpy.typing import NDArray

from labseq.model import FrequencyCourse, MotionSpec, SiteGrid

Floats = NDArray[np.float64]

PAGE: Final = Path(__file__).parent / "explanation" / "checked-plans.md"
FRAME_S: Final = 0.5e-6
"""Time between two points of a path, in seconds."""
GROUP: Final = 100
"""Atoms followed together, each in a static tweezer of its own, far from the others."""
APART_M: Final = 30e-6
"""Distance of these tweezers, in metres."""
STATIC: Final = SimulationSettings()
MOTION: Final = MotionSpec()
HALF_M: Final = SiteGrid().spacing_m / 2


@dataclass(frozen=True, slots=True)
class Landing:
    """How a tweezer arrives.

    Attributes:
        name: For the table.
        speed_m_s: Mean speed on the last half site.
        course: Course of the speed.
        ramp_s: Ramp of the depth after it has arrived.
        ends_at: Where it stops: 0 at the site, 1 half a site before, -1 half a site behind it.
        fades: Whether the depth goes down evenly on the way instead.
        depth_k: Depth of the mobile tweezer, in kelvin.
    """

    name: str
    speed_m_s: float
    course: FrequencyCourse = FrequencyCourse.LINEAR
    ramp_s: float = MOTION.drop_off_s
    ends_at: int = 0
    fades: bool = False
    depth_k: float = STATIC.mobile_light.depth

    def path(self) -> tuple[Floats, Floats]:
        """Distance from the site, in metres, and fraction of the full depth, at each frame."""
        way = 1 - self.ends_at
        n = max(1, round(way * HALF_M / self.speed_m_s / FRAME_S))
        done = [self.course.fraction(i / n) for i in range(n + 1)]
        place = HALF_M * (1 - way * np.array(done))
        depth = 1 - np.arange(n + 1) / n if self.fades else np.ones(n + 1)
        ramp = depth[-1] * np.linspace(1, 0, round(self.ramp_s / FRAME_S) + 1)[1:]
        return np.append(place, np.full(len(ramp), place[-1])), np.append(depth, ramp)


CONSTANT, JERK = FrequencyCourse.LINEAR, FrequencyCourse.MINIMUM_JERK
LANDINGS: Final = (
    *(Landing(f"{v} µm/ms, then the ramp", v * 1e-3) for v in (260, 130, 65, 32.5, 13, 4)),
    *(Landing(f"minimum jerk, {v} µm/ms on average, then the ramp", v * 1e-3, JERK) for v in (130, 32.5, 13)),
    Landing("13 µm/ms, then a ramp of 300 µs", 13e-3, ramp_s=300e-6),
    *(Landing(f"{v} µm/ms, ramped down on the way", v * 1e-3, fades=True) for v in (130, 32.5, 13)),
    Landing("ramped down half a site before", 0.13, ends_at=1),
    Landing("passes over the site at 130 µm/ms", 0.13, ends_at=-1),
    *(
        Landing(f"{mk} mK: {v} µm/ms, then the ramp", v * 1e-3, depth_k=mk * 1e-3)
        for mk in (0.6, 0.3, 0.15)
        for v in (130, 13)
    ),
)


def land(landing: Landing, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Let a tweezer land on each of a group of atoms; their energies before and after, in kelvin.

    They are counted from the bottom of the static tweezer; inf for an atom that is lost.
    """
    waists = np.array([STATIC.static_waist, STATIC.mobile_light.waist])
    rayleigh = math.pi * waists**2 / [STATIC.static_wavelength, STATIC.mobile_light.wavelength]
    beams = np.array([waists[0], rayleigh[0], waists[1], rayleigh[1]])
    depth = np.full(GROUP, KELVIN * STATIC.static_depth)
    state = draw_atoms(depth, KELVIN * STATIC.temperature, beams[0], beams[1], rng)
    sites: Floats = np.zeros((GROUP, 2))
    sites[:, 0] = APART_M * np.arange(GROUP)
    state[:, :2] += sites
    before = energies(state, sites, depth, beams[0], beams[1])
    down, right = np.array([0.0, 2 * HALF_M]), np.array([APART_M, 0.0])
    plane = np.vstack([np.zeros(2), down, right, np.linalg.inv(np.stack([down, right], axis=1))])
    place, fraction = landing.path()
    columns = np.tile(np.arange(float(GROUP)), (len(place), 1))
    alive, record = np.ones(GROUP, np.bool_), np.full((GROUP, N_COLUMNS), np.nan)
    follow_atoms(
        state, alive, record,
        place[:, None] / (2 * HALF_M), fraction[:, None].copy(), columns, np.ones_like(columns),
        FRAME_S * np.arange(len(place), dtype=np.float64), depth[None], KELVIN * landing.depth_k,
        np.ascontiguousarray(plane), beams, math.ceil(FRAME_S / STEP_S),
    )  # fmt: skip
    after = energies(state, sites, depth, beams[0], beams[1])
    after[~alive | (after >= 0)] = np.inf
    return (before + depth[0]) / KELVIN, (after + depth[0]) / KELVIN


def row(landing: Landing, n_atoms: int) -> str:
    """A row of the table."""
    rng = np.random.default_rng(1)
    before, after = np.hstack([land(landing, rng) for _ in range(math.ceil(n_atoms / GROUP))])
    lost = np.isinf(after)
    n, kept = len(after), after[~lost]
    loss, error = lost.mean(), math.sqrt(max(lost.mean() * (1 - lost.mean()), 1 / n) / n)
    heat_uk = "-" if len(kept) < n / 10 else f"{(kept.mean() - before.mean()) / 3 * 1e6:.1f}"
    return f"| {landing.name} | {100 * loss:.2f}({100 * error:.2f}) % | {heat_uk} |"


def main() -> None:
    """Write the table into the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--atoms", type=int, default=10_000, help="atoms for each row of the table")
    arguments = parser.parse_args()
    lines = ["| the last half site | lost | heating of the others, µK |", "| --- | --- | --- |"]
    for landing in LANDINGS:
        lines.append(row(landing, arguments.atoms))
        sys.stdout.write(lines[-1] + "\n")
        sys.stdout.flush()
    text = PAGE.read_text(encoding="utf-8")
    part = re.compile(r"(?<=<!-- measured: landings -->\n).*?(?=<!-- end -->)", re.DOTALL)
    PAGE.write_text(part.sub(lambda _: "\n".join(["", *lines, "", ""]), text), encoding="utf-8")


if __name__ == "__main__":
    main()
