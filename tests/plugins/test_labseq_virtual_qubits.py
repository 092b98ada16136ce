"""The two levels of the virtual atoms against formulas that are exact, and the light that removes atoms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from labseq_virtual.atoms import Atoms
from labseq_virtual.qubits import Qubits
from labseq_virtual.settings import QubitSettings

from labseq.builtin.pulses import PulseSettings, PulseStep
from labseq.model import LineProgram, LineSpec
from labseq.sequencer.lines import line_program

LINES = tuple(LineSpec(name, n) for n, name in enumerate(("microwave", "quadrature", "push_out")))
SHAPE = (30, 30)
FOREVER = {"relaxation_time": "1 h", "coherence_time": "1 h", "preparation": 1.0}
HALF_PI = {"lines": ["microwave"], "duration": "12.5 us"}
PI_ABOUT_Y = {"lines": ["microwave", "quadrature"], "duration": "25 us"}


def program_of(*parts: dict[str, Any], repeat: int = 1) -> LineProgram:
    settings = {"parts": {f"p{n}": part for n, part in enumerate(parts)}, "repeat": repeat}
    step = PulseStep(PulseSettings.model_validate(settings))
    return line_program(LINES, "pulse", step.duration_s, step.pulses)


def played(*parts: dict[str, Any], detuning_hz: float = 0.0, repeat: int = 1, **physics: Any) -> Qubits:
    settings = QubitSettings.model_validate(FOREVER | physics)
    qubits = Qubits(settings, SHAPE, 0.0, np.random.default_rng(1))
    source = {"frequency": settings.transition + detuning_hz, "phase": 0.0, "shift": math.pi / 2}
    qubits.play(program_of(*parts, repeat=repeat), 0.0, source, Atoms(np.ones(SHAPE, bool), 15e-6))
    return qubits


@pytest.mark.parametrize("detuning_hz", [0.0, 12e3])
@pytest.mark.parametrize("duration_us", [5.0, 40.0, 200.0])
def test_a_driven_atom_follows_rabis_formula(detuning_hz: float, duration_us: float) -> None:
    qubits = played({**HALF_PI, "duration": f"{duration_us} us"}, detuning_hz=detuning_hz)
    generalised_hz = math.hypot(20e3, detuning_hz)
    expected = (20e3 / generalised_hz * math.sin(math.pi * generalised_hz * duration_us * 1e-6)) ** 2
    assert np.allclose(qubits.upper, expected, atol=1e-6)


def test_both_decays_damp_a_resonant_oscillation() -> None:
    """Its envelope decays with the mean of both rates, and its frequency falls by their difference."""
    t1_s, t2_s, time_s = 2e-3, 0.5e-3, 300e-6
    decay: dict[str, Any] = {"relaxation_time": f"{t1_s} s", "coherence_time": f"{t2_s} s"}
    qubits = played({**HALF_PI, "duration": "300 us"}, preparation=0.9, **decay)
    rate, difference = (1 / t1_s + 1 / t2_s) / 2, (1 / t2_s - 1 / t1_s) / 2
    angular = math.sqrt((2 * math.pi * 20e3) ** 2 - difference**2)
    swing = math.cos(angular * time_s) + difference / angular * math.sin(angular * time_s)
    assert np.allclose(qubits.upper, 0.5 - 0.8 / 2 * math.exp(-rate * time_s) * swing, atol=1e-9)


def test_a_spread_of_the_detuning_ends_fringes_and_an_echo_brings_them_back() -> None:
    dark = {"duration": "200 us"}
    fringes = played(HALF_PI, dark, HALF_PI, detuning_spread="3 kHz")
    assert fringes.upper.mean() == pytest.approx(0.5, abs=0.05)
    assert fringes.upper.std() > 0.3
    # a flip about the atoms' own direction undoes the detuning, as long as pulses are short; so do eight
    short: dict[str, Any] = {"rabi_frequency": "2 MHz", "detuning_spread": "3 kHz"}
    half_pi, pi = {**HALF_PI, "duration": "0.125 us"}, {**PI_ABOUT_Y, "duration": "0.25 us"}
    half = {"duration": "100 us"}
    assert played(half_pi, half, pi, half, half_pi, **short).upper.min() > 0.98
    block: dict[str, Any] = {"repeat": 8, "parts": {"before": half, "flip": pi, "after": half}}
    assert played(half_pi, block, half_pi, **short).upper.min() > 0.98


def test_push_out_light_removes_atoms_in_the_upper_level_and_leaves_no_superposition() -> None:
    settings = QubitSettings.model_validate(
        {**FOREVER, "push_out_time": "5 us", "push_out_time_other": "1 ms"}
    )
    atoms, qubits = Atoms(np.ones(SHAPE, bool), 15e-6), Qubits(settings, SHAPE, 0.0, np.random.default_rng(1))
    source = {"frequency": settings.transition, "phase": 0.0, "shift": 0.0}
    push = {"lines": ["push_out"], "duration": "50 us"}
    n_lost = qubits.play(program_of(HALF_PI, push), 0.0, source, atoms)
    stay = 0.5 * math.exp(-10) + 0.5 * math.exp(-0.05)
    sigma = math.sqrt(stay * (1 - stay) * atoms.occupied.size)
    assert abs(atoms.occupied.sum() - stay * atoms.occupied.size) < 4 * sigma
    assert n_lost == atoms.occupied.size - atoms.occupied.sum()
    assert np.allclose(qubits.upper, 0.5 * math.exp(-10) / stay)
    qubits.play(program_of(HALF_PI), 75e-6, source, atoms)  # from the lower level: to a half
    assert np.allclose(qubits.upper, 0.5, atol=1e-4)
