from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from labseq.errors import LimitError
from labseq.model import Batch, MotionSpec, Plan, RfSpec, SegmentKind, SiteGrid, ToneProgram
from labseq.motion import tone_program
from labseq.motion.hold import cross_offsets_m, hold_program, hold_time_s

GRID = SiteGrid(5, 6)
HOLD_S = 0.2e-3
IDLE, PICK_UP, TRANSPORT, DROP_OFF = SegmentKind
ALL = np.ones(GRID.shape, np.bool_)

offsets = st.tuples(*[st.floats(-1.4e-6, 1.4e-6)] * 2)


def spec(**changes: Any) -> MotionSpec:
    return replace(MotionSpec(overhead_per_batch_s=0.5e-3), **changes)


def places(program: ToneProgram, grid: SiteGrid, segment: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Where the tones of rows and columns are in a segment, in sites."""
    found: list[NDArray[Any]] = []
    for axis, hz in ((program.row, grid.row_frequency_hz), (program.column, grid.column_frequency_hz)):
        tones = slice(axis.offsets[segment], axis.offsets[segment + 1])
        assert (axis.start_hz[tones] == axis.end_hz[tones]).all()
        found.append((axis.start_hz[tones] - hz[0]) / 1.6e6)
    return found[0], found[1]


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 2**30 - 1).map(lambda bits: np.array([bits >> i & 1 for i in range(30)], np.bool_)),
    offsets,
    st.integers(1, 7),
    st.booleans(),
)
def test_every_site_is_held_once_beside_its_place_and_no_other(
    bits: NDArray[np.bool_], offset_m: tuple[float, float], most: int, is_cross: bool
) -> None:
    sites = bits.reshape(GRID.shape)
    each_m = cross_offsets_m(GRID.shape, offset_m) if is_cross else np.broadcast_to(offset_m, (5, 6, 2))
    program = hold_program(GRID, spec(max_tweezers=most), sites, each_m, HOLD_S)
    held = np.zeros(GRID.shape, int)
    for segment in np.flatnonzero(program.kind == TRANSPORT):
        rows, cols = places(program, GRID, int(segment))
        assert len(rows) == 1
        assert 1 <= len(cols) <= most
        for col in cols:
            site = round(rows[0]), round(col)
            held[site] += 1
            beside = (np.array([col, rows[0]]) - site[::-1]) * GRID.spacing_m
            assert beside == pytest.approx(each_m[site], abs=1e-12)
    assert (held == sites).all()


def test_a_batch_is_a_pause_a_pick_up_a_hold_and_a_drop_off() -> None:
    program = hold_program(GRID, spec(), ALL, (0.3e-6, 0.0), HOLD_S, 5e-6)
    assert program.kind.tolist() == [IDLE, PICK_UP, PICK_UP, TRANSPORT, DROP_OFF, DROP_OFF] * 5
    assert program.batch.tolist() == np.repeat(range(5), 6).tolist()
    assert program.duration_s[:6] == pytest.approx([0.5e-3, 2e-6, 58e-6, HOLD_S, 3e-6, 2e-6])
    assert np.diff(program.row.offsets)[:6].tolist() == [0, 1, 1, 1, 1, 1]
    assert np.diff(program.column.offsets)[:6].tolist() == [0, 6, 6, 6, 6, 6]


def test_without_a_time_to_hold_or_a_pause_there_is_no_segment_for_it() -> None:
    program = hold_program(GRID, spec(overhead_per_batch_s=0.0), ALL, (0.0, 0.0), 0.0)
    assert program.kind.tolist() == [PICK_UP, PICK_UP, DROP_OFF, DROP_OFF] * 5
    assert (program.duration_s > 0).all()


@pytest.mark.parametrize("phases", ["random", "low_crest"])
def test_ramps_amplitudes_and_first_phases_are_those_of_a_move(phases: Any) -> None:
    rows, cols = (0.04, 0.05, 0.03, 0.05, 0.05), (0.1, 0.15, 0.12, 0.1, 0.1, 0.1)
    motion = spec(rf=RfSpec(row_amplitudes=rows, column_amplitudes=cols, phases=phases))
    sites = np.zeros(GRID.shape, np.bool_)
    sites[2, [0, 2]] = True
    held = hold_program(GRID, motion, sites, (0.0, 0.0), HOLD_S)
    move = np.array([[2, 0, 2, 1], [2, 2, 2, 3]], np.int16)
    moved = tone_program(Plan.from_batches([Batch(move[:, :2], move[:, 2:])]), GRID, motion)
    for mine, theirs in ((held.row, moved.row), (held.column, moved.column)):
        first = slice(mine.offsets[1], mine.offsets[3])
        for name in ("start_hz", "end_hz", "start_amplitude", "end_amplitude", "phase_rad"):
            assert getattr(mine, name)[first] == pytest.approx(getattr(theirs, name)[first])
    last = slice(*held.column.offsets[4:7:2])
    level = np.sqrt(2 / 60)
    assert held.column.start_amplitude[last] == pytest.approx([0.1, 0.12, 0.1 * level, 0.12 * level])
    assert held.column.end_amplitude[last] == pytest.approx([0.1 * level, 0.12 * level, 0.0, 0.0])
    assert held.row.start_amplitude[-1] == 0.03


@settings(max_examples=15, deadline=None)
@given(offsets)
def test_phases_are_continuous_within_a_batch(offset_m: tuple[float, float]) -> None:
    program = hold_program(GRID, spec(), ALL, offset_m, HOLD_S)
    for joint in (2, 3):
        t_s = float(program.joint_s[joint])
        before, after = program.tones_at(t_s - 1e-15), program.tones_at(t_s)
        for old, new in ((before.row, after.row), (before.column, after.column)):
            assert np.exp(1j * old.phase_rad) == pytest.approx(np.exp(1j * new.phase_rad), abs=1e-5)


@settings(max_examples=20, deadline=None)
@given(offsets, st.integers(1, 7), st.booleans())
def test_the_time_for_all_sites_is_that_of_the_program(
    offset_m: tuple[float, float], most: int, is_cross: bool
) -> None:
    each_m = cross_offsets_m(GRID.shape, offset_m) if is_cross else offset_m
    motion = spec(max_tweezers=most)
    program = hold_program(GRID, motion, ALL, each_m, HOLD_S)
    assert hold_time_s(GRID, motion, each_m, HOLD_S) == pytest.approx(program.total_duration_s)


@pytest.mark.parametrize(
    ("offset_m", "message"),
    [
        ((0.0, 50e-6), r"row 1 at an offset of 50 um is 116.* MHz; .* 82 to"),
        ((-50e-6, 0.0), r"column 0 at .* -50 um is 78.* MHz"),
    ],
)
def test_an_offset_that_leaves_the_band_is_refused(offset_m: tuple[float, float], message: str) -> None:
    motion = spec(rf=RfSpec(row_band_hz=(82e6, 116e6)))
    for refuse in (
        lambda: hold_program(GRID, motion, ALL, offset_m, HOLD_S),
        lambda: hold_time_s(GRID, motion, offset_m, HOLD_S),
    ):
        with pytest.raises(LimitError, match=message):
            refuse()


def test_tweezers_that_come_too_near_are_refused() -> None:
    opposite = np.zeros((*GRID.shape, 2))
    opposite[..., 0] = 1.9e-6 * (1 - 2 * (np.arange(6) % 2))
    each = hold_program(GRID, spec(), ALL, opposite, HOLD_S)
    assert each.n_segments == 2 * 30  # those with another offset come in another batch
    with pytest.raises(LimitError, match="the distance of column tones"):
        hold_program(GRID, spec(rf=RfSpec(min_spacing_hz=2e6)), ALL, (0.0, 0.0), HOLD_S)


@pytest.mark.parametrize(
    ("sites", "offset_m", "hold_s"),
    [
        (np.ones((6, 5), np.bool_), (0.0, 0.0), HOLD_S),
        (ALL, (np.nan, 0.0), HOLD_S),
        (ALL, np.zeros((6, 5, 2)), HOLD_S),
        (ALL, (0.0, 0.0), np.nan),
    ],
)
def test_what_is_no_hold_is_refused(sites: Any, offset_m: Any, hold_s: float) -> None:
    with pytest.raises(ValueError, match=r"expected|not a number|broadcast"):
        hold_program(GRID, spec(), sites, offset_m, hold_s)
