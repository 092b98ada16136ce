"""Make the tables ``responses.npz`` of the virtual lab from atoms moved by Newton's equations.

    python docs/make_response_tables.py [TABLE ...]

They are those of ``labseq_virtual/responses.py``.

Each stage of a move is simulated on its own, with the forces of ``flight_kernels.py``: atoms start from the
thermal distribution of the tweezer that they are in. The sound smooths amplitudes and positions in the AOD as
it does in ``rf_analysis.py``. To tell the heat of a stage from the change of the trap, the other tweezer is
faded in before, or out after it, slowly.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import product
from typing import Any, Final

import numpy as np
from labseq_virtual.flight import KELVIN, RfTransport, draw_atoms
from labseq_virtual.flight_kernels import GONE, HIGH, VECTOR, Beams, Site, Spot, energies, move
from labseq_virtual.responses import AXES, DEPTH_K, SITE_M, START_RAMPS_S, TABLES, TRANSIT_S, WAIST_M
from labseq_virtual.rf_analysis import HOPS, RfPulse
from labseq_virtual.settings import SimulationSettings
from numpy.typing import NDArray

from labseq.plugin import AxisTones, MotionSpec, Plan, SiteGrid, ToneProgram, kernel
from labseq.plugin.motion import FrequencyCourse, RfSpec, tone_program
from labseq.plugin.rendering import render
from labseq.plugin.simulation import RfSamples

Floats = NDArray[np.float64]

N_ATOMS: Final = 400
RATE_HZ: Final = 624e6
FRAME_S: Final = 1e-6
STEP_S: Final = 0.2e-6
FADE_S: Final = 80e-6
"""Time in which the other tweezer is faded: five periods in the shallow one."""
REST_S: Final = 20e-6
"""Time before and after the ramps and moves, for the sound to cross the beam."""
SOUND_S: Final = TRANSIT_S / 4
"""s.d. of the sound's weight across the beam, for a transit time of 10 us: its field and that of the beam."""
KEYED_S: Final = 2e-6
"""Time over which the tones of the other axis are switched, at the outer end of a ramp."""
LEAST_KEPT: Final = 0.02
"""Fraction of atoms kept below which two moves are not compared."""
SLOW_S: Final = 30e-6
"""Duration of a ramp that changes nothing about the start after it, or the stop before."""
LENGTHS: Final = (3, 4, 5, 6)
"""Lengths of the moves in sites: several, as the kicks at start and stop interfere."""


@dataclass(frozen=True, slots=True)
class Reference:
    """The tweezers that the tables belong to; lengths in metres, ``depth`` in kelvin."""

    depth: float = DEPTH_K
    waist: float = WAIST_M
    spacing: float = SITE_M
    static_wavelength: float = 808e-9
    mobile_wavelength: float = 852e-9

    @property
    def beams(self) -> Floats:
        """Waist and Rayleigh length of the static tweezers, then of the mobile ones, (4,)."""
        static, mobile = (
            math.pi * self.waist**2 / wavelength
            for wavelength in (self.static_wavelength, self.mobile_wavelength)
        )
        return np.array([self.waist, static, self.waist, mobile])


REFERENCE: Final = Reference()


@kernel(f"void(float64[:, ::1], {VECTOR}, {VECTOR}, {VECTOR}, float64, {VECTOR}, float64, int64, float64)")
def follow_in_row(
    state: Floats,
    static: Floats,
    mobile: Floats,
    place: Floats,
    spacing: float,
    beams: Floats,
    frame_s: float,
    n_steps: int,
    aside: float,
) -> None:
    """Follow atoms, each alone, in a row of static tweezers along x and one mobile tweezer that moves along.

    Args:
        state: The atoms, (n_atoms, 6); changed in place. Those that are far away stop.
        static: Depth of the static tweezers in each frame (n_frames,).
        mobile: Depth of the mobile tweezer, likewise.
        place: Its position, likewise.
        spacing: Distance of the static tweezers.
        beams: The beams.
        frame_s: Time from frame to frame.
        n_steps: Integration steps from frame to frame.
        aside: Distance of the mobile tweezer from the row, along y.
    """
    widths = Beams(beams[0], beams[1], beams[2], beams[3])
    for i in range(len(state)):
        for k in range(len(static) - 1):
            atom = state[i]
            site = Site(spacing * round(atom[0] / spacing), 0.0, 0.5 * (static[k] + static[k + 1]))
            way, brighter = place[k + 1] - place[k], mobile[k + 1] - mobile[k]
            spot = Spot(place[k], aside, way, 0.0, 1.0, 1.0, 0.0, mobile[k], brighter)
            move(atom, site, spot, widths, frame_s, n_steps)
            if abs(atom[2]) > 2.0 * HIGH * beams[1] or abs(atom[1]) > 4.0 * GONE * beams[0]:
                break


def smoothed(course: Floats) -> Floats:
    """A course as the sound of the AOD shows it: averaged over the beam."""
    half = int(4 * SOUND_S / FRAME_S)
    weight = np.exp(-0.5 * (np.arange(-half, half + 1) * FRAME_S / SOUND_S) ** 2)
    averaged = np.convolve(np.pad(course, half, mode="edge"), weight / weight.sum(), mode="valid")
    return averaged.astype(np.float64)


def fly(state: Floats, static: Floats, mobile: Floats, place: Floats, at: Reference) -> None:
    """Move atoms in a row of static tweezers and a mobile one; depths in kelvin, for each frame."""
    steps = max(1, round(FRAME_S / STEP_S))
    follow_in_row(state, KELVIN * static, KELVIN * mobile, place, at.spacing, at.beams, FRAME_S, steps, 0.0)


def energy_k(state: Floats, depth: float, place: float, at: Reference, *, is_mobile: bool) -> Floats:
    """Energy of atoms above the bottom of a tweezer, in kelvin."""
    waist, rayleigh = at.beams[2:] if is_mobile else at.beams[:2]
    sites = np.tile([place, 0.0], (len(state), 1))
    total = energies(state, sites, np.full(len(state), KELVIN * depth), waist, rayleigh)
    return total / KELVIN + depth


def outcome(before: Floats, after: Floats, depth: float, squeeze: float) -> tuple[float, float]:
    """Loss, and the ratio of the temperatures after and before, adiabatic change left out."""
    kept = after < depth
    n = int(kept.sum())
    ratio = after[kept].mean() / before[kept].mean() / squeeze if n else np.nan
    return 1 - n / len(after), float(ratio)


def draw(depth: float, temperature: float, at: Reference, seed: int, *, is_mobile: bool) -> Floats:
    """Thermal atoms in a tweezer at the origin."""
    waist, rayleigh = at.beams[2:] if is_mobile else at.beams[:2]
    rng = np.random.default_rng(seed)
    return draw_atoms(np.full(N_ATOMS, KELVIN * depth), KELVIN * temperature, waist, rayleigh, rng)


def ramp(duration_s: float) -> tuple[Floats, int]:
    """Depth of a tweezer that is switched on, relative to the full one, and the frame at which it is on."""
    n = round((duration_s + 2 * REST_S) / FRAME_S)
    t_s = np.arange(n + 1) * FRAME_S - REST_S
    keyed_s = min(KEYED_S, duration_s / 2)
    ramped, keyed = (
        smoothed(np.sqrt(np.clip(t_s / max(each_s, 1e-9), 0.0, 1.0))) for each_s in (duration_s, keyed_s)
    )
    return (ramped * keyed) ** 2, n


def pick_up(
    ramp_s: float, away: float, ratio: float, temperature: float, at: Reference
) -> tuple[float, float]:
    """A mobile tweezer comes on beside the site; then the static one is faded out."""
    up, n = ramp(ramp_s)
    n_fade = round(FADE_S / FRAME_S)
    fade = np.linspace(1, 0, n_fade + 1)[1:]
    mobile = ratio * at.depth * np.concatenate([up, np.ones(n_fade)])
    static = at.depth * np.concatenate([np.ones(n + 1), fade])
    place = np.full(len(mobile), away * at.waist)
    state = draw(at.depth, temperature, at, 1, is_mobile=False)
    before = energy_k(state, at.depth, 0.0, at, is_mobile=False)
    fly(state, static, mobile, place, at)
    after = energy_k(state, ratio * at.depth, place[0], at, is_mobile=True)
    return outcome(before, after, ratio * at.depth, np.sqrt(ratio))


def drop_off(
    ramp_s: float, away: float, ratio: float, temperature: float, at: Reference
) -> tuple[float, float]:
    """The static tweezer is faded in beside a mobile one, which then goes off."""
    up, n = ramp(ramp_s)
    n_fade = round(FADE_S / FRAME_S)
    fade = np.linspace(0, 1, n_fade + 1)[:-1]
    mobile = ratio * at.depth * np.concatenate([np.ones(n_fade), up[::-1]])
    static = at.depth * np.concatenate([fade, np.ones(n + 1)])
    place = np.full(len(mobile), away * at.waist)
    state = draw(ratio * at.depth, temperature * np.sqrt(ratio), at, 2, is_mobile=True)
    before = energy_k(state, ratio * at.depth, 0.0, at, is_mobile=True)
    state[:, 0] += place[0]
    fly(state, static, mobile, place, at)
    after = energy_k(state, at.depth, 0.0, at, is_mobile=False)
    return outcome(before, after, at.depth, 1 / np.sqrt(ratio))


def find_light(program: ToneProgram) -> list[tuple[Floats, Floats, Floats]]:
    """The tweezer of a program with one row tone and one column tone, as found in its played samples.

    Returns:
        Its column, its depth relative to the full one, and the time from the start of the program, for frames
        of a transit time over ``HOPS`` each (n_frames,); in parts, if the light goes out on the way.
    """
    full_v = 0.2
    samples = render(program, RATE_HZ).samples
    spans = [(RfSamples(1.0, RATE_HZ, one, full_v / 32767),) for one in samples]
    pulse = RfPulse(1.0, spans[0][0].end_s, *spans, continued=False)
    flight = RfTransport(SiteGrid(), MotionSpec(rf=RfSpec(full_scale_v=full_v)), SimulationSettings())
    parts = list[tuple[Floats, Floats, Floats]]()
    for (_, row_depth, place, depth), t_s in flight.find_tones(pulse):
        strongest = np.nan_to_num(depth).argmax(axis=1)
        frames = np.arange(len(strongest))
        sites = place[frames, strongest]
        light = np.nan_to_num(depth[frames, strongest] * np.nan_to_num(row_depth).max(axis=1))
        on = np.isfinite(sites)
        parts.append((np.interp(frames, frames[on], sites[on]), light, t_s - 1.0))
    return parts


@lru_cache(maxsize=512)
def played_move(course: int, speed: float, length: int) -> tuple[Floats, Floats] | None:
    """Position (in sites from its start) and depth of a tweezer that moves, as found in played samples.

    The light of a chirped tone depends on the chirp too: it dims where a move starts and stops.

    Returns:
        Both for frames of a transit time over ``HOPS``, (n_frames,); the depth is relative to that at rest.
        None if the light goes out on the way.
    """
    rest_s, moving_s = 4 * REST_S, length * REFERENCE.spacing / speed
    grid = SiteGrid()
    at = grid.column_frequency_hz[[5, 5, 5 + length, 5 + length]]
    row_hz, duration_s = np.full(4, grid.row_frequency_hz[5]), np.array([rest_s, moving_s, rest_s])
    offsets, level = np.arange(4, dtype=np.int32), np.full(3, 1 / 20)
    rows, columns = (
        AxisTones(
            offsets,
            hz[:-1],
            hz[1:],
            level,
            level,
            2 * np.pi * (np.cumsum(np.append(0.0, (hz[:-1] + hz[1:]) / 2 * duration_s))[:-1] % 1.0),
        )
        for hz in (row_hz, at)
    )
    kinds = np.array([0, course, 0], np.int8)
    program = ToneProgram(rows, columns, duration_s, np.full(3, 2, np.int8), np.zeros(3, np.int32), kinds)
    parts = find_light(program)
    if len(parts) != 1:
        return None
    sites, light, t_s = parts[0]
    inner = (t_s > 2 * REST_S) & (t_s < t_s[-1] - 3 * REST_S)
    return sites[inner] - sites[inner][0], light[inner]


@lru_cache(maxsize=512)
def played_batch(
    speed: float, length: int, pick_up_s: float, drop_off_s: float
) -> tuple[Floats, Floats] | None:
    """Position and depth of a tweezer that is ramped up, moves at once, and is ramped down at once.

    They are as in :func:`played_move`.
    """
    motion = MotionSpec(speed_m_s=speed, pick_up_s=pick_up_s, drop_off_s=drop_off_s)
    program = tone_program(Plan.from_batches([([(5, 5)], [(5, 5 + length)])]), SiteGrid(), motion)
    parts = find_light(program)
    if not parts:
        return None
    rest = round(REST_S / (TRANSIT_S / HOPS))
    sites, light = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    return np.pad(sites - 5, rest, mode="edge"), np.pad(light, rest)


def transport(
    course: int, speed: float, ratio: float, temperature: float, at: Reference
) -> tuple[float, float]:
    """An atom is carried from site to site over empty ones; curved courses over four sites."""
    lengths = LENGTHS if course == FrequencyCourse.LINEAR else (4,)
    before, after = list[Floats](), list[Floats]()
    whole = (1 + ratio) * at.depth
    frame_s = TRANSIT_S / HOPS
    for length in lengths:
        move = played_move(course, speed, length)
        if move is None:
            return 1.0, np.nan
        sites, light = move
        state = draw(whole, temperature * np.sqrt(1 + ratio), at, length, is_mobile=True)
        state = state[: N_ATOMS // len(lengths)]
        before.append(_both(state, 0.0, ratio, at))
        static = np.full(len(sites), KELVIN * at.depth)
        mobile = KELVIN * ratio * at.depth * light
        steps = round(frame_s / STEP_S)
        follow_in_row(state, static, mobile, sites * at.spacing, at.spacing, at.beams, frame_s, steps, 0.0)
        after.append(_both(state, length * at.spacing, ratio, at))
    return outcome(np.concatenate(before), np.concatenate(after), whole, 1.0)


@lru_cache(maxsize=4)
def sudden(
    ramps_s: tuple[float, float], speed: float, ratio: float, temperature: float, at: Reference
) -> tuple[float, float]:
    """An atom is carried over several sites, with ramps directly before and after the move."""
    before, after = list[Floats](), list[Floats]()
    frame_s = TRANSIT_S / HOPS
    for length in LENGTHS:
        batch = played_batch(speed, length, *ramps_s)
        if batch is None:
            return 1.0, np.nan
        sites, light = batch
        state = draw(at.depth, temperature, at, length, is_mobile=False)[: N_ATOMS // len(LENGTHS)]
        before.append(energy_k(state, at.depth, 0.0, at, is_mobile=False))
        static, mobile = np.full(len(sites), KELVIN * at.depth), KELVIN * ratio * at.depth * light
        steps = round(frame_s / STEP_S)
        follow_in_row(state, static, mobile, sites * at.spacing, at.spacing, at.beams, frame_s, steps, 0.0)
        after.append(energy_k(state, at.depth, length * at.spacing, at, is_mobile=False))
    return outcome(np.concatenate(before), np.concatenate(after), at.depth, 1.0)


@lru_cache(maxsize=512)
def _centred(
    stage: Any, ramp_s: float, ratio: float, temperature: float, at: Reference
) -> tuple[float, float]:
    return stage(ramp_s, 0.0, ratio, temperature, at)


def at_once(
    is_stop: bool, ramp_s: float, speed: float, ratio: float, temperature: float, at: Reference
) -> tuple[float, float]:
    """What a ramp does to a start that follows at once, or to a stop, beyond what both do on their own.

    That is what a batch with this ramp does compared with one whose ramp is as long as the sound takes across
    the beam, less the difference of both ramps on their own. The ramp at the other end is a slow one.
    """
    longest_s = START_RAMPS_S[-1]
    if speed == 0.0 or ramp_s == longest_s:
        return 0.0, 1.0
    kept, warmer = list[float](), list[float]()
    for each_s in (ramp_s, longest_s):
        ramps_s = (SLOW_S, each_s) if is_stop else (each_s, SLOW_S)
        joint = sudden(ramps_s, speed, ratio, temperature, at)
        alone = _centred(drop_off if is_stop else pick_up, each_s, ratio, temperature, at)
        kept.append((1 - joint[0]) / max(1 - alone[0], 1e-9))
        warmer.append(joint[1] / alone[1])
    if kept[1] < LEAST_KEPT:  # nothing is left to compare
        return 0.0, 1.0
    return float(np.clip(1 - kept[0] / kept[1], 0.0, 1.0)), warmer[0] / warmer[1]


def landing(
    speed: float, ramp_s: float, ratio: float, temperature: float, at: Reference
) -> tuple[float, float]:
    """An empty mobile tweezer comes from an empty neighbouring site and goes off on an atom."""
    up, n = ramp(ramp_s)
    n_way = math.ceil(at.spacing / speed / FRAME_S)
    place = smoothed(np.concatenate([np.linspace(-at.spacing, 0.0, n_way + 1), np.zeros(n)]))
    mobile = ratio * at.depth * np.concatenate([np.ones(n_way), up[::-1]])
    state = draw(at.depth, temperature, at, 4, is_mobile=False)
    before = energy_k(state, at.depth, 0.0, at, is_mobile=False)
    fly(state, np.full(len(place), at.depth), mobile, place, at)
    return outcome(before, energy_k(state, at.depth, 0.0, at, is_mobile=False), at.depth, 1.0)


def passing(
    speed: float, beside: float, ratio: float, temperature: float, at: Reference
) -> tuple[float, float]:
    """A mobile tweezer passes beside an atom, from four waists before it to four behind."""
    far = 4 * at.waist
    n = math.ceil(2 * far / speed / FRAME_S)
    state = np.concatenate([draw(at.depth, temperature, at, seed, is_mobile=False) for seed in range(5)])
    before = energy_k(state, at.depth, 0.0, at, is_mobile=False)
    static, mobile = np.full(n + 1, KELVIN * at.depth), np.full(n + 1, KELVIN * ratio * at.depth)
    place, steps = np.linspace(-far, far, n + 1), round(FRAME_S / STEP_S)
    follow_in_row(state, static, mobile, place, 1.0, at.beams, FRAME_S, steps, beside * at.waist)
    return outcome(before, energy_k(state, at.depth, 0.0, at, is_mobile=False), at.depth, 1.0)


def _both(state: Floats, place: float, ratio: float, at: Reference) -> Floats:
    return energy_k(state, at.depth, place, at, is_mobile=False) + (
        energy_k(state, ratio * at.depth, place, at, is_mobile=True)
        - 0.5 * (state[:, 3:] ** 2).sum(axis=1) / KELVIN
    )


def lowering(fraction: float, duration_s: float, temperature: float, at: Reference) -> tuple[float, float]:
    """The static tweezer is ramped down, evenly in depth."""
    n = max(1, round(duration_s / FRAME_S))
    static = at.depth * np.linspace(1, fraction, n + 1)
    state = draw(at.depth, temperature, at, 3, is_mobile=False)
    before = energy_k(state, at.depth, 0.0, at, is_mobile=False)
    fly(state, static, np.zeros(n + 1), np.zeros(n + 1), replace(at, spacing=1.0))
    after = energy_k(state, fraction * at.depth, 0.0, at, is_mobile=False)
    return outcome(before, after, fraction * at.depth, np.sqrt(fraction))


STAGES: Final[dict[str, Any]] = {
    "pick_up": pick_up,
    "drop_off": drop_off,
    "transport": transport,
    "landing": landing,
    "passing": passing,
    "start": partial(at_once, False),
    "stop": partial(at_once, True),
    "lowering": lowering,
}


def _point(name: str, values: tuple[float, ...]) -> tuple[float, float]:
    return STAGES[name](*values, REFERENCE)


def make_table(name: str, processes: int = 2) -> NDArray[np.float32]:
    """Simulate all points of a table: float32 (2, ...), loss and ratio of temperatures on its axes."""
    axes = AXES[name][::-1]
    points = [point[::-1] for point in product(*axes)]  # neighbours share what a process keeps
    with ProcessPoolExecutor(processes) as pool:
        found = np.array(list(pool.map(partial(_point, name), points, chunksize=30)))
    table = found.reshape(*map(len, axes), 2).T
    table[1] = np.where(np.isfinite(table[1]), table[1], 1.0)
    return table.astype(np.float32)


def main(names: Sequence[str]) -> None:
    """Make tables, by default all, and keep each as soon as it is done."""
    for name in names or STAGES:
        start_s = time.monotonic()
        kept: dict[str, Any] = dict(np.load(TABLES)) if TABLES.exists() else {}
        np.savez_compressed(TABLES, **(kept | {name: make_table(name)}))  # pyright: ignore[reportArgumentType]
        sys.stdout.write(f"{name} in {time.monotonic() - start_s:.0f} s\n")
    sys.stdout.write(f"{TABLES}: {TABLES.stat().st_size} bytes\n")


if __name__ == "__main__":
    main(sys.argv[1:])
