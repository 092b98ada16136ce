"""Tones of the axes: calibrations, combs, offsets, limits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.typing import NDArray
from scipy.interpolate import InterpolatedUnivariateSpline

from labseq.errors import LimitError
from labseq.model import MotionSpec, Plan, RfSpec, SiteGrid, ToneProgram
from labseq.model.grid import axis_positions_m, centred_comb
from labseq.motion import correct_overlay, drive, fit_comb, tone_program
from labseq.motion.hold import hold_program

SPACING_M = 4.49e-6
SLOPE = 1.6e6 / SPACING_M
SITES_M = axis_positions_m(20, SPACING_M)
COMB_HZ = centred_comb(20)


def bent(worst_m: float) -> NDArray[np.float64]:
    """Frequencies that are off the comb, the outermost and the middle ones most."""
    sites = np.linspace(-1.0, 1.0, 20)
    off = sites**2 - (sites**2).mean()
    return COMB_HZ + SLOPE * worst_m * off / np.abs(off).max()


def test_tones_on_a_comb_are_left_as_they_are() -> None:
    assert fit_comb(COMB_HZ, SPACING_M).frequency_hz is COMB_HZ
    assert fit_comb(COMB_HZ, SPACING_M).worst_m == 0.0
    assert fit_comb(np.array([1e8, 1.1e8]), SPACING_M).worst_m == 0.0


@pytest.mark.parametrize("direction", [1, -1])
@given(worst_m=st.floats(1e-12, 1e-6))
def test_the_error_of_a_comb_is_where_it_puts_the_tweezers(direction: int, worst_m: float) -> None:
    hz = bent(worst_m)[::direction]
    fit = fit_comb(hz, SPACING_M)
    assert np.diff(fit.frequency_hz, n=2) == pytest.approx(0.0, abs=1e-6)
    assert fit.error_m == pytest.approx((fit.frequency_hz - hz) / (direction * SLOPE), abs=1e-14)
    assert fit.worst_m == pytest.approx(worst_m, rel=1e-4)


@pytest.mark.parametrize(("worst_m", "snapped"), [(19e-9, True), (21e-9, False)])
def test_tones_within_20_nm_are_snapped_to_the_comb(worst_m: float, snapped: bool) -> None:
    grid = SiteGrid(column_frequency_hz=bent(worst_m))
    driven = drive(grid, MotionSpec(), 1)
    expected = fit_comb(bent(worst_m), SPACING_M)
    assert np.abs(driven.comb_error_m).max() == pytest.approx(worst_m if snapped else 0.0, rel=1e-3)
    program = tone_program(Plan.from_batches([([(0, 3)], [(0, 9)])]), grid)
    frequencies = expected.frequency_hz if snapped else bent(worst_m)
    assert program.column.end_hz[-1] == frequencies[9]
    unsnapped = tone_program(
        Plan.from_batches([([(0, 3)], [(0, 9)])]), grid, MotionSpec(rf=RfSpec(snap_within_m=0.0))
    )
    assert unsnapped.column.end_hz[-1] == bent(worst_m)[9]


@given(
    offset_m=st.tuples(st.floats(-2e-6, 2e-6), st.floats(-2e-6, 2e-6)),
    bend_m=st.floats(0.0, 0.5e-6),
    falling=st.booleans(),
)
def test_tweezers_beside_the_sites_come_to_stand_on_them(
    offset_m: tuple[float, float], bend_m: float, falling: bool
) -> None:
    """In truth each tone's tweezer stands by the offset beside where the calibration has it."""
    tones_hz = bent(bend_m)[:: -1 if falling else 1]
    grid = SiteGrid(20, 20, SPACING_M, row_frequency_hz=tones_hz, column_frequency_hz=tones_hz)
    corrected = correct_overlay(grid, offset_m)
    believed = InterpolatedUnivariateSpline(tones_hz if not falling else tones_hz[::-1], SITES_M, k=1)
    for corrected_hz, beside_m in zip(
        (corrected.column_frequency_hz, corrected.row_frequency_hz), offset_m, strict=True
    ):
        stands_m = (-1 if falling else 1) * np.asarray(believed(corrected_hz)) + beside_m
        assert stands_m == pytest.approx(SITES_M, abs=1e-12)
    assert np.array_equal(corrected.positions_m, grid.positions_m)


def test_without_an_offset_the_tones_stay_as_they_are() -> None:
    grid = SiteGrid(1, 4, SPACING_M)
    assert correct_overlay(grid, [0.0, 0.0]).row_frequency_hz is grid.row_frequency_hz
    moved = correct_overlay(grid, [1e-6, 0.0])
    assert np.array_equal(moved.row_frequency_hz, grid.row_frequency_hz)
    assert np.all(moved.column_frequency_hz < grid.column_frequency_hz)


def test_a_single_row_is_moved_by_the_step_of_the_columns() -> None:
    grid = SiteGrid(1, 4, SPACING_M)
    (moved_hz,) = correct_overlay(grid, [0.0, 1e-6]).row_frequency_hz - grid.row_frequency_hz
    assert moved_hz == pytest.approx(-1e-6 * np.diff(grid.column_frequency_hz).mean() / SPACING_M)


@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (3, 3)])
def test_a_correction_moves_tones_as_the_offset_of_a_probe_does(shape: tuple[int, int]) -> None:
    grid, offset_m = SiteGrid(*shape, SPACING_M), np.array([0.3e-6, -0.2e-6])
    corrected = correct_overlay(grid, -offset_m)
    probe = hold_program(grid, MotionSpec(), np.ones(shape, bool), offset_m, 1e-4)
    for axis, hz in ((probe.row, corrected.row_frequency_hz), (probe.column, corrected.column_frequency_hz)):
        assert np.unique(axis.start_hz.round(3)) == pytest.approx(np.unique(hz.round(3)))


def test_tones_are_not_moved_below_zero() -> None:
    grid = SiteGrid(3, 3, SPACING_M, column_frequency_hz=np.array([1e5, 2e6, 4e6]))
    with pytest.raises(LimitError, match="the lowest column frequency"):
        correct_overlay(grid, [2e-6, 0.0])


GRID = SiteGrid(4, 6)
HARMLESS = ([(0, 0)], [(0, 1)])
FOUR = ([(0, 0), (0, 1), (0, 2), (0, 3)], [(0, 1), (0, 2), (0, 3), (0, 4)])
QUARTERS = (0.25,) * 6


def program_of(*batches: Any, grid: SiteGrid = GRID, **rf: Any) -> ToneProgram:
    return tone_program(Plan.from_batches(list(batches)), grid, MotionSpec(rf=RfSpec(**rf)))


@pytest.mark.parametrize(
    ("batch", "rf", "words"),
    [
        (FOUR, {"column_band_hz": (90e6, 101e6)}, "column tone 3 in batch 1 .*102.4 MHz.* 90 to 101 MHz"),
        (
            ([(3, 0)], [(2, 0)]),
            {"row_band_hz": (90e6, 102e6)},
            "row tone 0 in batch 1 .*102.4 MHz.* 90 to 102",
        ),
        (FOUR, {"min_spacing_hz": 1.7e6}, "column tones 0 and 1 in batch 1 .*1.6 MHz.* 1.7 MHz"),
        (([(0, 0), (0, 2)], [(0, 4), (0, 1)]), {}, "column tones 0 and 1 in batch 1 .* 0 MHz.* 500 kHz"),
        (FOUR, {"column_amplitudes": (0.3, *QUARTERS[1:])}, "column tones 0 to 3 in batch 1 .*1.05 of full"),
        (FOUR, {"column_amplitudes": QUARTERS, "full_scale_v": 2.5}, "tones 0 to 3 in batch 1 .*2.5 V.* 2 V"),
        (
            FOUR,
            {"column_amplitudes": QUARTERS, "amplifier_gain_db": 27.0},
            "0 to 3 in batch 1 .*3.21 W.* 3 W",
        ),
        (HARMLESS, {"row_amplitudes": (0.1, 0.2)}, "row amplitudes is 2; .* 4"),
    ],
)
def test_what_would_be_too_much(batch: Any, rf: dict[str, Any], words: str) -> None:
    with pytest.raises(LimitError, match=words):
        program_of(HARMLESS, batch, **rf)


def test_amplitudes_that_change_on_the_way_may_be_too_loud_in_between() -> None:
    moves = ([(0, 1), (0, 4)], [(0, 0), (0, 5)])
    amplitudes = (0.1, 0.9, 0.1, 0.1, 0.1, 0.9)
    with pytest.raises(LimitError, match=r"sum of the amplitudes of column tones 0 to 1 in batch 0 is 1\.28"):
        program_of(moves, column_amplitudes=amplitudes, max_mean_power_w=100.0)


def test_frequencies_that_fall_along_the_grid() -> None:
    falling = SiteGrid(4, 6, column_frequency_hz=centred_comb(6, step_hz=-1.6e6))
    assert program_of(FOUR, grid=falling).n_segments == 5
    with pytest.raises(LimitError, match=r"column tones 0 and 1 in batch 0 is 1\.6 MHz; the limit is 2 MHz"):
        program_of(FOUR, grid=falling, min_spacing_hz=2e6)


@pytest.mark.parametrize(
    ("rf", "message"),
    [
        ({"row_band_hz": (2.0, 1.0)}, "the band goes from 2 Hz to 1 Hz"),
        (
            {"column_amplitudes": (0.1, 1.2)},
            r"column_amplitudes\.1\n  Input should be less than or ",
        ),
        ({"max_mean_power_w": float("nan")}, r"max_mean_power_w\n  Input should be a finite number"),
        ({"min_spacing_hz": -1.0}, r"min_spacing_hz\n  Input should be greater than or equal to 0"),
        ({"amplifier_gain_db": float("nan")}, r"amplifier_gain_db\n  Input should be a finite number"),
    ],
)
def test_settings_that_make_no_sense(rf: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RfSpec(**rf)


def test_power_at_full_scale() -> None:
    assert RfSpec(full_scale_v=1.0, amplifier_gain_db=20.0).full_scale_power_w == pytest.approx(1.0)
