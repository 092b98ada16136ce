"""What moved atoms are lost by, and how often."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.transport import Transport
from numpy.typing import NDArray

from labseq import MotionSpec
from labseq.testing.rf import ON, TAPE_GRID as GRID, ToneProgramBuilder

FULL = np.ones(GRID.shape)


def atoms(*sites: tuple[int, int]) -> NDArray[np.bool_]:
    occupied = np.zeros(GRID.shape, np.bool_)
    for site in sites:
        occupied[site] = True
    return occupied


def remain(tape: ToneProgramBuilder, *sites: tuple[int, int], **physics: Any) -> set[tuple[int, int]]:
    """Where the atoms are after a program."""
    occupied = atoms(*sites)
    transport = Transport(GRID, MotionSpec(), SimulationSettings.model_validate(physics))
    transport.carry(occupied, tape.program(), len(tape.segments), FULL, np.random.default_rng(0), 1.0)
    return {(int(r), int(c)) for r, c in np.argwhere(occupied)}


def survivors(n_repeats: int, n_tones: int, loss_factor: float = 1.0, **physics: float) -> int:
    """How many of 5 atoms, carried ``n_repeats`` times with ``n_tones`` column tones, survive in all."""
    cols = [(0, 1), *((c, c) for c in range(2, n_tones + 1))]
    program = ToneProgramBuilder().move([(r, r) for r in range(5)], cols).program()
    transport = Transport(GRID, MotionSpec(), SimulationSettings.model_validate(physics))
    rng = np.random.default_rng(2)
    total = 0
    for _ in range(n_repeats):
        occupied = atoms(*((r, 0) for r in range(5)))
        transport.carry(occupied, program, 3, FULL, rng, loss_factor)
        total += int(occupied.sum())
    return total


def within_four_sigma(count: int, n: int, p: float) -> bool:
    return abs(count - n * p) < 4 * np.sqrt(n * p * (1 - p))


def test_moved_atoms_are_lost_with_the_transport_loss() -> None:
    assert within_four_sigma(survivors(1000, 1, transport_loss=0.2), 5000, 0.8)
    assert within_four_sigma(survivors(1000, 1, transport_loss=0.2, loss_factor=2.0), 5000, 0.6)
    assert survivors(20, 1, transport_loss=0.4, loss_factor=4.0) == 0


def test_each_further_tone_adds_to_the_loss() -> None:
    physics = {"transport_loss": 0.1, "transport_loss_per_tone": 0.05}
    further = 4 + 2  # five row tones and three column tones are on
    assert within_four_sigma(survivors(1000, 3, **physics), 5000, 1 - (0.1 + 0.05 * further))


def test_atoms_that_are_not_moved_are_not_lost() -> None:
    tape = ToneProgramBuilder().move([(0, 0)], [(0, 2)])
    assert remain(tape, (4, 4), (0, 5), transport_loss=1.0) == {(4, 4), (0, 5)}


def lost_by(
    tape: ToneProgramBuilder, *sites: tuple[int, int], depth: float = 1.0, **physics: Any
) -> dict[str, int]:
    """What the atoms of a program are lost by."""
    settings = SimulationSettings.model_validate({"transport_loss": 0.0, "temperature": 1e-6} | physics)
    transport = Transport(tape.grid, MotionSpec(), settings)
    static = np.full(tape.grid.shape, depth)
    occupied = atoms(*sites)
    n = len(tape.segments)
    lost = transport.carry(occupied, tape.program(), n, static, np.random.default_rng(0), 1.0)
    assert int(occupied.sum()) == len(sites) - sum(lost.values())
    return dict(lost)


def test_every_loss_has_its_cause() -> None:
    assert lost_by(ToneProgramBuilder().move([(0, 0)], [(0, 2)]), (0, 0), transport_loss=1.0) == {
        "hand_over": 1
    }
    assert lost_by(ToneProgramBuilder().move([(0, 0)], [(0, 2)]), (0, 0)) == {}
    assert lost_by(ToneProgramBuilder().move([(0, 0)], [(0, -1)]), (0, 0)) == {"ejected": 1}
    assert lost_by(ToneProgramBuilder().move([(0, 0)], [(0, 3)]), (0, 0), (0, 3)) == {"collision": 2}
    assert lost_by(ToneProgramBuilder().move([(0, 0)], [(0, 3)]), (0, 0), (0, 1)) == {"collision": 2}
    assert lost_by(ToneProgramBuilder().move([(0, 0)], [(0, 3), (3, 0)]), (0, 0), (0, 3)) == {"collision": 2}
    assert lost_by(ToneProgramBuilder().add([(0, 0, ON, ON)], [(0, 0, 0.0, ON)]), (0, 0)) == {"program": 1}
    held = ToneProgramBuilder().add([(0, 0, ON, ON)], [(0, 0, 0.0, ON)])
    assert lost_by(held.add([], []), (0, 0)) == {"program": 1}
    light = {"adiabatic_depth": 3e-3, "shallow_loss": 1.0}
    assert lost_by(ToneProgramBuilder().move([(0, 0)], [(0, 2)]), (0, 0), mobile_light=light) == {}
    slow = ToneProgramBuilder().move([(0, 0)], [(0, 2)])
    assert remain(slow, (0, 0), transport_loss=0.0, mobile_light=light) == {(0, 2)}  # 9 um/ms


def test_a_shallow_tweezer_at_full_speed_loses_its_atom_on_the_way() -> None:
    occupied = atoms((0, 0))
    light = {"adiabatic_depth": 3e-3, "shallow_loss": 1.0}
    settings = SimulationSettings.model_validate({"transport_loss": 0.0, "mobile_light": light})
    program = ToneProgramBuilder().move([(0, 0)], [(0, 2)]).program(segment_s=2 * GRID.spacing_m / 0.13)
    transport = Transport(GRID, MotionSpec(), settings)
    assert transport.carry(occupied, program, 3, FULL, np.random.default_rng(0), 1.0) == {"transport": 1}


def test_a_weak_tweezer_neither_takes_nor_throws_out_an_atom() -> None:
    weak = ON * 0.3  # 9 % of the depth, on the axis that is not ramped
    tape = (
        ToneProgramBuilder()
        .add([(0, 0, weak, weak)], [(0, 0, 0.0, ON)])
        .add([(0, 0, weak, weak)], [(0, 3, ON, ON)])
    )
    assert remain(tape, (0, 0), (0, 2)) == {(0, 0), (0, 2)}


@pytest.mark.parametrize(("offset_um", "kept"), [(0.0, 1.0), (0.9, 0.984), (1.2, 0.75), (2.0, 1.0)])
@pytest.mark.parametrize("axis", [0, 1])
def test_pick_up_and_drop_off_beside_the_site_keeps_what_the_energy_allows(
    offset_um: float, kept: float, axis: int
) -> None:
    off = offset_um * 1e-6 / GRID.spacing_m
    rows = [(r + off * axis, r + off * axis, ON, ON) for r in range(5)]
    cols = [c + off * (1 - axis) for c in range(6)]
    tape = (
        ToneProgramBuilder()
        .add(rows, [(c, c, 0.0, ON) for c in cols])
        .add(rows, [(c, c, ON, 0.0) for c in cols])
    )
    transport = Transport(GRID, MotionSpec(), SimulationSettings(transport_loss=0.0))
    rng, total = np.random.default_rng(3), 0
    for _ in range(60):
        occupied = np.ones(GRID.shape, np.bool_)
        transport.carry(occupied, tape.program(), 2, FULL, rng, 1.0)
        total += int(occupied.sum())
    n = 60 * 30
    assert abs(total - n * kept) <= 4 * np.sqrt(n * kept * (1 - kept)) + 0.01 * n


def test_a_tweezer_that_splits_keeps_one_atom() -> None:
    tape = ToneProgramBuilder().add([(0, 0, ON, ON)], [(2, 2, 0.0, ON)])
    tape.add([(0, 0, ON, ON)], [(1.75, 1.2, ON, ON), (2.25, 2.8, ON, ON)])
    tape.add([(0, 0, ON, ON)], [(1.2, 1.2, ON, 0.0), (2.8, 2.8, ON, 0.0)])
    assert remain(tape, (0, 2), transport_loss=0.0, temperature=1e-6) == {(0, 1)}


def test_two_tweezers_that_come_on_beside_one_atom_take_it_once() -> None:
    tape = ToneProgramBuilder().add([(0, 0, ON, ON)], [(1.7, 1.7, 0.0, ON), (2.3, 2.3, 0.0, ON)])
    tape.add([(0, 0, ON, ON)], [(1.7, 1.0, ON, ON), (2.3, 3.0, ON, ON)])
    tape.add([(0, 0, ON, ON)], [(1.0, 1.0, ON, 0.0), (3.0, 3.0, ON, 0.0)])
    assert remain(tape, (0, 2), transport_loss=0.0) == {(0, 1)}
