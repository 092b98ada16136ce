"""Waveforms broken on purpose: the loss is what a model of another make predicts from what was meant.

The prediction never sees a sample. It takes the tone program's formulas, smooths them over the beam by
sums over time, and moves an ensemble of atoms in numpy. The world demodulates the samples, links tones, and
moves each atom by its kernels.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from labseq_virtual.flight import KELVIN, RfTransport
from labseq_virtual.rf_analysis import PulseReceiver, RfPulse
from labseq_virtual.settings import MobileLightSettings, SimulationSettings
from numpy.typing import NDArray

from labseq.model import ToneProgram, TonesNow
from labseq.testing.rf import GRID, START_S, PlayedRfSource, played, program_of, spec, with_phase_jump

Floats = NDArray[np.float64]

N_ATOMS = int(os.environ.get("LABSEQ_ATOMS", "400"))
WAY, ROW = 4, 5
TRANSIT_S, STEP_S = 10e-6, 0.2e-6
HOT_K = 25e-6
"""Hot enough that even what is right loses some."""


@dataclass(frozen=True)
class Broken:
    """Something that is wrong with a waveform or with the light."""

    name: str
    offset_m: float = 0.0
    depth_k: float = 2.1e-3
    motion: dict[str, float] = field(default_factory=dict[str, float])
    change: Callable[[ToneProgram], ToneProgram] = lambda program: program
    columns: tuple[int, ...] = (0, 5, 10, 15)
    """Apart, so that an atom that is left behind is in nobody's way."""

    @property
    def program(self) -> ToneProgram:
        """All atoms of the row move on together."""
        sources = [(ROW, c) for c in self.columns]
        return self.change(program_of((sources, [(r, c + WAY) for r, c in sources]), **self.motion))


CASES = [
    Broken("nothing"),
    Broken("150 nm beside the sites", offset_m=150e-9),
    Broken("900 nm beside the sites", offset_m=900e-9),
    Broken("10 % less depth", depth_k=0.9 * 2.1e-3),
    Broken("65 % less depth", depth_k=0.35 * 2.1e-3),
    Broken("a phase jump of 1 rad at the start", change=lambda p: with_phase_jump(p, 2, 1.0)),
    Broken("a phase jump of 2 rad at the start", change=lambda p: with_phase_jump(p, 2, 2.0)),
    Broken("a pick-up of no length", motion={"pick_up_s": 1e-9}),
    Broken("a drop-off of no length", motion={"drop_off_s": 1e-9}),
    Broken("twice the speed", motion={"speed_m_s": 0.26}),
]


class OnceHeard(RfTransport):
    """A flight that demodulates each episode once: what was played does not depend on the atoms."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.heard: dict[int, Any] = {}

    def _find_tones(self, pulse: RfPulse) -> Any:
        if id(pulse) not in self.heard:
            self.heard[id(pulse)] = super()._find_tones(pulse)
        return self.heard[id(pulse)]


def world_loss(case: Broken) -> tuple[int, NDArray[Any], NDArray[Any]]:
    """How many of :data:`N_ATOMS` the world loses, with its tables."""
    light = MobileLightSettings(offset=(case.offset_m, 0.0), depth=case.depth_k, transit_time=TRANSIT_S)
    flight = OnceHeard(
        GRID, spec(), SimulationSettings(transport_loss=0.0, temperature=HOT_K, mobile_light=light)
    )
    outputs, rng = played(case.program), np.random.default_rng(7)
    episodes = [*PulseReceiver(PlayedRfSource(outputs), 60e-6).receive_until(START_S + 10.0)]
    columns = np.array(case.columns)
    n_kept, n_rows = 0, N_ATOMS // len(columns)
    for _ in range(n_rows):
        occupied = np.zeros(GRID.shape, np.bool_)
        occupied[ROW, columns] = True
        for pulse in episodes:
            flight.carry(occupied, pulse, np.ones(GRID.shape), rng, 1.0)
        n_kept += int(np.count_nonzero(occupied[ROW, columns + WAY]))
    tables = flight.tables(START_S)
    return n_rows * len(columns) - n_kept, tables["flights"], tables["jumps"]


def predicted_loss(case: Broken, n_atoms: int) -> float:
    """The fraction that an ensemble loses on the way of the first tone."""
    t_s, place, depth = smoothed(case.program)
    place += case.offset_m / GRID.spacing_m
    rng = np.random.default_rng(11)
    waist = 0.98e-6
    rayleigh = [math.pi * waist**2 / wavelength for wavelength in (808e-9, 852e-9)]
    static, mobile = KELVIN * 300e-6, KELVIN * case.depth_k
    box = np.array([1.5 * waist, 1.5 * waist, 4 * rayleigh[0]])
    x, v = np.empty((0, 3)), np.empty((0, 3))
    while len(x) < n_atoms:  # Boltzmann's law, by rejection from a box
        more_x = box * rng.uniform(-1, 1, (100_000, 3))
        energy = potential(more_x, static, waist, rayleigh[0])
        more_x = more_x[rng.random(len(energy)) < np.exp(-(energy + static) / (KELVIN * HOT_K))]
        more_v = math.sqrt(KELVIN * HOT_K) * rng.standard_normal(more_x.shape)
        energy = 0.5 * (more_v**2).sum(axis=1) + potential(more_x, static, waist, rayleigh[0])
        x, v = np.vstack([x, more_x[energy < 0]]), np.vstack([v, more_v[energy < 0]])
    for k in range(len(t_s)):
        x += 0.5 * STEP_S * v
        site = np.zeros_like(x)
        site[:, 0] = np.rint(x[:, 0] / GRID.spacing_m) * GRID.spacing_m
        v += STEP_S * force(x - site, static, waist, rayleigh[0])
        tweezer = np.array([place[k] * GRID.spacing_m, 0.0, 0.0])
        v += STEP_S * force(x - tweezer, mobile * depth[k], waist, rayleigh[1])
        x += 0.5 * STEP_S * v
    goal = x - np.array([WAY * GRID.spacing_m, 0.0, 0.0])
    energy = 0.5 * (v**2).sum(axis=1) + potential(goal, static, waist, rayleigh[0])
    return float(np.mean(energy >= 0))


def smoothed(program: ToneProgram) -> tuple[Floats, Floats, Floats]:
    """Times, place of the first column tone (in sites from its first) and depth, as the beams see them."""
    start_s, end_s = program.joint_s[1] - 30e-6, program.joint_s[-1] + 30e-6
    t_s = np.arange(start_s, end_s, STEP_S)
    u_s = np.arange(-12.5e-6, 12.5e-6, STEP_S)
    weight = np.exp(-2 * (2 * u_s / TRANSIT_S) ** 2)
    weight /= weight.sum()
    shapes: list[tuple[Floats, Floats]] = []
    for axis in ("row", "column"):
        hz, amplitude, phase = np.zeros(len(t_s)), np.zeros(len(t_s)), np.zeros(len(t_s))
        for k, time_s in enumerate(t_s):
            tones: TonesNow = getattr(program.tones_at(float(time_s)), axis)
            if len(tones.frequency_hz):
                hz[k], amplitude[k], phase[k] = (
                    tones.frequency_hz[0], tones.amplitude[0] * 20, tones.phase_rad[0],
                )  # fmt: skip
        power = np.convolve(amplitude**2, weight, "same")
        mean_hz = np.convolve(amplitude**2 * hz, weight, "same") / np.where(power > 1e-9, power, np.inf)
        chirp = np.gradient(mean_hz, STEP_S)
        wave = amplitude * np.exp(1j * phase)
        n = len(u_s)
        padded = np.pad(wave, (n // 2, n - n // 2 - 1))
        windows = padded[np.arange(len(t_s))[:, None] + np.arange(n)]
        bend = np.exp(-1j * np.pi * chirp[:, None] * u_s**2)
        turn = np.exp(-2j * np.pi * (mean_hz[:, None] * u_s))
        overlap = np.abs((windows * turn * bend * weight).sum(axis=1))
        shapes.append((np.asarray(mean_hz, np.float64), np.asarray(overlap, np.float64)))
    step_hz = float(np.diff(GRID.column_frequency_hz[:2])[0])
    place = np.where(shapes[1][0] > 0, (shapes[1][0] - GRID.column_frequency_hz[0]) / step_hz, 0.0)
    return t_s, place, (shapes[0][1] * shapes[1][1]) ** 2


def potential(x: Floats, depth: float, waist: float, rayleigh: float) -> Floats:
    s = 1 + (x[:, 2] / rayleigh) ** 2
    return -depth / s * np.exp(-2 * (x[:, 0] ** 2 + x[:, 1] ** 2) / (waist**2 * s))


def force(x: Floats, depth: float, waist: float, rayleigh: float) -> Floats:
    s = 1 + (x[:, 2] / rayleigh) ** 2
    q = 2 * (x[:, 0] ** 2 + x[:, 1] ** 2) / (waist**2 * s)
    bottom = depth / s * np.exp(-q)
    radial = -4 * bottom / (waist**2 * s)
    axial = -2 * bottom * (1 - q) / (s * rayleigh**2)
    return np.stack([radial * x[:, 0], radial * x[:, 1], axial * x[:, 2]], axis=1)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_loss_is_the_predicted_one(case: Broken) -> None:
    n_lost, flights, jumps = world_loss(case)
    n_predicted = max(1000, N_ATOMS)
    expected = predicted_loss(case, n_predicted)
    variance = N_ATOMS * expected * (1 - expected) * (1 + N_ATOMS / n_predicted) + 1.0
    print(f"{case.name}: lost {n_lost} of {N_ATOMS}, predicted {expected:.2%}")
    assert abs(n_lost - N_ATOMS * expected) < 4 * math.sqrt(variance)
    held = flights[~np.isnan(flights["held_s"])]
    if "pick_up_s" not in case.motion:  # else it moves before it is seen
        assert float(np.median(held["offset_m"])) == pytest.approx(case.offset_m, abs=5e-9)
    if case.name.startswith("a phase jump of 1 rad"):
        assert np.unique(jumps["kind"]).tolist() == [b"phase"]
    if {"pick_up_s", "drop_off_s"} & {*case.motion}:
        assert np.unique(jumps["kind"]).tolist() == [b"depth"]
    if case.name in ("nothing", "150 nm beside the sites", "10 % less depth", "twice the speed"):
        assert len(jumps) == 0
