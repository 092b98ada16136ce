"""Jumps of phase and depth are found where they are; smooth motion has none."""

from __future__ import annotations

import math

import numpy as np
import pytest
from labseq_virtual.flight import RfTransport
from labseq_virtual.rf_analysis import PulseReceiver
from labseq_virtual.settings import SimulationSettings
from numpy.typing import NDArray

from labseq.model import ToneProgram
from labseq.testing.rf import GRID, START_S, PlayedRfSource, played, program_of, spec, with_phase_jump

MOVE = ([(5, 2), (5, 5)], [(5, 5), (5, 9)])
"""Segments: 0 pause, 1 pick-up, 2 and 3 transport (one arrives before the other), 4 drop-off."""


def jumps_of(program: ToneProgram) -> NDArray[np.void]:
    flight = RfTransport(GRID, spec(), SimulationSettings(transport_loss=0.0))
    occupied = np.zeros(GRID.shape, np.bool_)
    occupied[5, 2] = occupied[5, 5] = True
    for pulse in PulseReceiver(PlayedRfSource(played(program)), 60e-6).receive_until(START_S + 1.0):
        flight.carry(occupied, pulse, np.ones(GRID.shape), np.random.default_rng(1), 1.0)
    return flight.tables(START_S)["jumps"]


@pytest.mark.parametrize("speed_profile", ["constant", "minimum_jerk", "constant_jerk"])
def test_what_moves_smoothly_has_no_jumps(speed_profile: str) -> None:
    batches = [MOVE, ([(5, 5), (5, 9)], [(5, 4), (5, 7)]), ([(4, 4), (8, 4)], [(3, 4), (12, 4)])]
    assert len(jumps_of(program_of(*batches, speed_profile=speed_profile))) == 0


@pytest.mark.parametrize("segment", [2, 3, 4])
@pytest.mark.parametrize("size_rad", [-2.0, -1.0, 1.0, 2.0])
def test_a_phase_jump_is_found_with_its_size_and_place(segment: int, size_rad: float) -> None:
    smooth = program_of(MOVE)
    all_jumps = jumps_of(with_phase_jump(smooth, segment, size_rad))
    assert np.abs(all_jumps["t_s"] - smooth.joint_s[segment]).max() < 10e-6  # a large one dims the light, too
    jumps = all_jumps[all_jumps["kind"] == b"phase"]
    assert len(jumps) == 2
    for jump in jumps:
        assert jump["t_s"] == pytest.approx(smooth.joint_s[segment], abs=5e-6)
        assert jump["size"] == pytest.approx(size_rad, abs=0.3)
        assert math.isnan(jump["row"])
    columns = smooth.tones_at(float(smooth.joint_s[segment])).column.frequency_hz
    sites = np.interp(columns, GRID.column_frequency_hz, np.arange(20))
    assert np.sort(jumps["col"]) == pytest.approx(np.sort(sites), abs=0.3)


@pytest.mark.parametrize(("ramp", "size"), [("pick_up_s", 1.0), ("drop_off_s", -1.0)])
def test_a_ramp_of_no_length_is_a_jump_of_the_depth(ramp: str, size: float) -> None:
    jumps = jumps_of(program_of(MOVE, **{ramp: 1e-9}))
    assert len(jumps) == 2
    assert set(jumps["kind"].tolist()) == {b"depth"}
    assert jumps["size"] == pytest.approx([size, size], abs=0.1)
    assert jumps["row"] == pytest.approx([5, 5], abs=0.1)
    columns = [2, 5] if size > 0 else [5, 9]
    assert np.sort(jumps["col"]) == pytest.approx(columns, abs=0.4)
