"""Tones that AOD or amplifier would not bear."""

from __future__ import annotations

from typing import Any

import pytest

from labseq.errors import LimitError
from labseq.model import MotionSpec, Plan, RfSpec, SiteGrid, ToneProgram
from labseq.model.grid import centred_comb
from labseq.motion import tone_program

GRID = SiteGrid(4, 6)
HARMLESS = ([(0, 0)], [(0, 1)])
FOUR = ([(0, 0), (0, 1), (0, 2), (0, 3)], [(0, 1), (0, 2), (0, 3), (0, 4)])
QUARTERS = (0.25,) * 6


def program_of(*batches: Any, grid: SiteGrid = GRID, **rf: Any) -> ToneProgram:
    return tone_program(Plan.from_batches(list(batches)), grid, MotionSpec(rf=RfSpec(**rf)))


@pytest.mark.parametrize(
    ("batch", "rf", "what", "limit"),
    [
        (
            FOUR,
            {"column_band_hz": (90e6, 101e6)},
            "the frequency of column tone 3 in batch 2 is 102.4 MHz",
            "the band of 90 to 101 MHz",
        ),
        (
            ([(3, 0)], [(2, 0)]),
            {"row_band_hz": (90e6, 102e6)},
            "the frequency of row tone 0 in batch 2 is 102.4 MHz",
            "the band of 90 to 102 MHz",
        ),
        (
            FOUR,
            {"min_spacing_hz": 1.7e6},
            "the distance of column tones 0 and 1 in batch 2 is 1.6 MHz",
            "1.7 MHz at least, in the order of the sites",
        ),
        (
            ([(0, 0), (0, 2)], [(0, 4), (0, 1)]),
            {},
            "the distance of column tones 0 and 1 in batch 2 is 0 MHz",
            "500 kHz at least, in the order of the sites",
        ),
        (
            FOUR,
            {"column_amplitudes": (0.3, *QUARTERS[1:])},
            "the sum of the amplitudes of column tones 0 to 3 in batch 2 is 1.05 of full scale",
            "1: the output would clip",
        ),
        (
            FOUR,
            {"column_amplitudes": QUARTERS, "full_scale_v": 2.5},
            "the peak voltage of column tones 0 to 3 in batch 2 is 2.5 V",
            "2 V: more ruins the amplifier",
        ),
        (
            FOUR,
            {"column_amplitudes": QUARTERS, "amplifier_gain_db": 27.0},
            "the mean RF power of column tones 0 to 3 in batch 2 is 3.21 W",
            "3 W at the AOD",
        ),
        (
            HARMLESS,
            {"row_amplitudes": (0.1, 0.2)},
            "the number of preassigned row amplitudes is 2",
            "4: one per row",
        ),
    ],
)
def test_what_would_be_too_much(batch: Any, rf: dict[str, Any], what: str, limit: str) -> None:
    with pytest.raises(LimitError) as caught:
        program_of(HARMLESS, batch, **rf)
    assert str(caught.value) == f"{what}; the limit is {limit}"


def test_what_is_just_not_too_much() -> None:
    program_of(FOUR, column_amplitudes=QUARTERS, full_scale_v=2.0, amplifier_gain_db=20.0)
    program_of(FOUR, min_spacing_hz=1.6e6, column_band_hz=(96e6, 102.4e6))


def test_amplitudes_that_change_on_the_way_may_be_too_loud_in_between() -> None:
    moves = ([(0, 1), (0, 4)], [(0, 0), (0, 5)])
    amplitudes = (0.1, 0.9, 0.1, 0.1, 0.1, 0.9)
    with pytest.raises(LimitError, match=r"sum of the amplitudes of column tones 0 to 1 in batch 1 is 1\.28"):
        program_of(moves, column_amplitudes=amplitudes, max_mean_power_w=100.0)


def test_frequencies_that_fall_along_the_grid() -> None:
    falling = SiteGrid(4, 6, column_frequency_hz=centred_comb(6, step_hz=-1.6e6))
    assert program_of(FOUR, grid=falling).n_segments == 4
    with pytest.raises(LimitError, match=r"column tones 0 and 1 in batch 1 is 1\.6 MHz; the limit is 2 MHz"):
        program_of(FOUR, grid=falling, min_spacing_hz=2e6)


def test_a_grid_of_one_site_has_room_to_eject() -> None:
    assert program_of(([(0, 0)], [(0, 1)]), grid=SiteGrid(1, 1)).n_segments == 4


@pytest.mark.parametrize(
    ("rf", "message"),
    [
        ({"row_band_hz": (2.0, 1.0)}, "a band goes from 2.0 to 1.0 Hz"),
        ({"column_amplitudes": (0.1, 1.2)}, "an amplitude is a fraction of full scale"),
        ({"row_amplitudes": (0.0,)}, "an amplitude is a fraction of full scale"),
        ({"full_scale_v": 0.0}, "voltages and powers must be above 0"),
        ({"max_mean_power_w": float("nan")}, "voltages and powers must be above 0"),
        ({"min_spacing_hz": -1.0}, "cannot be negative"),
        ({"snap_within_m": float("nan")}, "cannot be negative"),
        ({"amplifier_gain_db": float("nan")}, "gain is nan dB; expected a number"),
    ],
)
def test_settings_that_make_no_sense(rf: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RfSpec(**rf)


def test_power_at_full_scale() -> None:
    assert RfSpec(full_scale_v=1.0, amplifier_gain_db=20.0).full_scale_power_w == pytest.approx(1.0)
