"""What mobile tweezers do to atoms that stand: the measured tables of the page on checked plans.

    python docs/make_landings.py [--atoms 10000]

The command replaces the parts of ``docs/explanation/checked-plans.md`` between ``<!-- measured: NAME -->``
and ``<!-- end -->``. Atoms move by Newton's law in the light of a static tweezer and of a mobile one, as in
the simulation of played samples (``labseq_virtual.flight``), but without the AOD's transit time.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from labseq_virtual.flight import Conditions, machine
from labseq_virtual.flight_kernels import fly_in_light
from labseq_virtual.formulas import KELVIN
from labseq_virtual.records import FATES, SITE, plane_of
from labseq_virtual.settings import SimulationSettings
from numpy.typing import NDArray

from labseq.model import MotionSpec, SiteGrid

Floats = NDArray[np.float64]

PAGE: Final = Path(__file__).parent / "explanation" / "checked-plans.md"
FRAME_S: Final = 0.5e-6
"""Time between two points of a path, in seconds."""
GROUP: Final = 100
"""Atoms followed together, each in a static tweezer of its own, far from the others."""
APART_M: Final = 30e-6
"""Distance of these tweezers, in metres."""
STATIC: Final = SimulationSettings()
MOBILE_K: Final = STATIC.mobile_light.depth
MOTION: Final = MotionSpec()
HALF_M: Final = SiteGrid().spacing_m / 2


@dataclass(frozen=True, slots=True, eq=False)
class TweezerPath:
    """The path of a mobile tweezer in frames, relative to the site of an atom.

    Attributes:
        along_m: float64 (n_frames,), from the site along the path.
        fraction: float64 (n_frames,), fraction of the full depth.
        beside_m: Distance of the path from the site.
        depth_k: Full depth, in kelvin.
        temperature_k: Temperature of the atom.
    """

    along_m: Floats
    fraction: Floats
    beside_m: float = 0.0
    depth_k: float = MOBILE_K
    temperature_k: float = STATIC.temperature


def follow(path: TweezerPath, rng: np.random.Generator) -> Floats:
    """Let a tweezer pass or land on each of a group of atoms; their temperatures then, nan for lost ones."""
    sites = np.zeros((1, GROUP), SITE)
    sites["atom"], sites["depth"], sites["heat"] = True, KELVIN * STATIC.static_depth, path.temperature_k
    down, right = np.array([0.0, 2 * HALF_M]), np.array([APART_M, 0.0])
    plane = plane_of(np.zeros(2), down, right)
    columns = np.tile(np.arange(float(GROUP))[:, None] + path.beside_m / APART_M, len(path.along_m))
    light = SimulationSettings().mobile_light.model_copy(update={"depth": path.depth_k})
    numbers = machine(
        STATIC.model_copy(update={"mobile_light": light, "transport_loss": 0.0}), Conditions(cooled=0.0)
    )
    fly_in_light(
        sites, path.along_m[None] / (2 * HALF_M), path.fraction[None].copy(), columns, np.ones_like(columns),
        0.0, FRAME_S, numbers, plane, rng, np.zeros(len(FATES), np.int64),
    )  # fmt: skip
    return np.where(sites["atom"][0], sites["heat"][0], np.nan)


def results(path: TweezerPath, n_atoms: int) -> list[str]:
    """The fraction of the atoms that are lost, and the heating of the others in uK."""
    rng = np.random.default_rng(1)
    after = np.hstack([follow(path, rng) for _ in range(math.ceil(n_atoms / GROUP))])
    lost = np.isnan(after)
    n, kept, loss = len(after), after[~lost], float(lost.mean())
    error = math.sqrt(max(loss * (1 - loss), 1 / n) / n)
    heating = "-" if len(kept) < n / 10 else f"{(kept.mean() - path.temperature_k) * 1e6:.1f}"
    return [f"{100 * loss:.2f}({100 * error:.2f}) %", heating]


def landing(
    speed_m_s: float,
    ramp_s: float = MOTION.drop_off_s,
    ends_at: int = 0,
    fades: bool = False,
    depth_k: float = MOBILE_K,
) -> TweezerPath:
    """A tweezer that comes from half a site away.

    Args:
        speed_m_s: Its speed.
        ramp_s: Ramp of the depth after it has arrived.
        ends_at: Where it stops: 0 at the site, 1 half a site before it, -1 half a site behind it.
        fades: Whether the depth goes down evenly on the way instead.
        depth_k: Full depth.
    """
    way = 1 - ends_at
    n = max(1, round(way * HALF_M / speed_m_s / FRAME_S))
    place = HALF_M * (1 - way * np.arange(n + 1) / n)
    depth = 1 - np.arange(n + 1) / n if fades else np.ones(n + 1)
    ramp = depth[-1] * np.linspace(1, 0, round(ramp_s / FRAME_S) + 1)[1:]
    return TweezerPath(
        np.append(place, np.full(len(ramp), place[-1])), np.append(depth, ramp), depth_k=depth_k
    )


LANDINGS: Final[dict[str, TweezerPath]] = {
    **{f"{v} µm/ms, then the ramp": landing(v * 1e-3) for v in (130, 4)},
    "13 µm/ms, then a ramp of 300 µs": landing(13e-3, ramp_s=300e-6),
    "130 µm/ms, ramped down on the way": landing(0.13, fades=True),
    "ramped down half a site before": landing(0.13, ends_at=1),
    "passes over the site at 130 µm/ms": landing(0.13, ends_at=-1),
    **{
        f"{mk} mK: {v} µm/ms, then the ramp": landing(v * 1e-3, depth_k=mk * 1e-3)
        for mk in (0.6, 0.3)
        for v in (130, 13)
    },
}

FAR_M: Final = 6e-6
"""Where a passing tweezer comes from and goes to, in metres from the nearest point."""


def passing(beside_m: float, wait_s: float, temperature_k: float, depth_k: float = MOBILE_K) -> TweezerPath:
    """A tweezer that passes an atom at the speed of transports, and waits at the nearest point."""
    n = round(FAR_M / MOTION.speed_m_s / FRAME_S)
    comes = FAR_M * (1 - np.arange(n + 1) / n)
    place = np.concatenate([comes, np.zeros(round(wait_s / FRAME_S)), -comes[:-1][::-1]])
    return TweezerPath(place, np.ones(len(place)), beside_m, depth_k, temperature_k)


def barrier_k(beside_m: float, depth_k: float = MOBILE_K) -> float:
    """Height of the barrier between an atom's site and a mobile tweezer, in kelvin."""
    x = np.linspace(0, beside_m, 2001)
    static = STATIC.static_depth * np.exp(-2 * (x / STATIC.static_waist) ** 2)
    well = -static - depth_k * np.exp(-2 * ((beside_m - x) / STATIC.mobile_light.waist) ** 2)
    slope = np.diff(well)
    bottom = int(np.argmax(slope > 0))  # a little towards the mobile tweezer
    return float(well[bottom + int(np.argmax(slope[bottom:] < 0))] - well[bottom])


def landings(n_atoms: int) -> list[list[str]]:
    """The table of landings."""
    return [
        ["the last half site", "lost", "heating of the others, µK"],
        *([name, *results(path, n_atoms)] for name, path in LANDINGS.items()),
    ]


def passes(n_atoms: int) -> list[list[str]]:
    """The table of passes."""
    table = [
        ["distance, µm", "mobile, mK", "atom, µK", "barrier, µK", "lost in a pass", "with a stop of 60 µs"]
    ]
    for um, mk, uk in [(1.7, 2.1, 15), (1.944, 2.1, 15), (1.944, 2.1, 5), (2.245, 2.1, 15), (1.944, 0.6, 15)]:
        barrier = f"{1e6 * barrier_k(um * 1e-6, mk * 1e-3):.0f}"
        made = [passing(um * 1e-6, wait_s, uk * 1e-6, mk * 1e-3) for wait_s in (0.0, 60e-6)]
        table.append([str(um), str(mk), str(uk), barrier, *(results(path, n_atoms)[0] for path in made)])
    return table


TABLES: Final[dict[str, Callable[[int], list[list[str]]]]] = {"passes": passes, "landings": landings}


def main() -> None:
    """Write the tables into the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--atoms", type=int, default=10_000, help="atoms for each number")
    parser.add_argument("--tables", nargs="*", default=[*TABLES], choices=[*TABLES], help="only these")
    arguments = parser.parse_args()
    for name in arguments.tables:
        head, *rows = TABLES[name](arguments.atoms)
        lines = ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)]
        sys.stdout.write("\n".join([*lines, ""]))
        part = re.compile(rf"(?<=<!-- measured: {name} -->\n).*?(?=<!-- end -->)", re.DOTALL)
        new = "\n".join(["", *lines, "", ""])
        PAGE.write_text(
            part.sub(lambda _, new=new: new, PAGE.read_text(encoding="utf-8"), count=1), encoding="utf-8"
        )


if __name__ == "__main__":
    main()
