"""What the radio is really sent: the spectrum at the full span, ramps, fades, amplitudes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labseq import LimitError, SiteGrid
from labseq.model.grid import centred_comb

from .labseq_soapy_rig import depth, opened, recorded

RATE_HZ = 40e6
TONES_HZ = centred_comb(20)
FULL: dict[str, Any] = {
    "grid": SiteGrid(20, 20),
    "device": "simulated",
    "sample_rate": RATE_HZ,
    "row_frequency": {},
    "column_frequency": {},
}
"""The paper's array, on a radio whose clock goes at a tenth of real time."""
N_LOOP = 80
"""Of the small array."""


def amplitudes_in(samples: np.ndarray, oscillator_hz: float) -> np.ndarray:
    waves = np.exp(2j * np.pi * np.outer(np.arange(samples.shape[-1]) / RATE_HZ, TONES_HZ - oscillator_hz))
    return np.abs(np.linalg.lstsq(waves, samples, rcond=None)[0])


class TestFullSpan:
    def test_of_two_times_twenty_tones_is_as_it_was_asked_for(self) -> None:
        asked = 0.03 + 0.02 * np.sin(np.arange(20.0)), 0.04 + 0.01 * np.cos(np.arange(20.0))
        with opened(**FULL) as rig:
            rig.tweezers.load(asked)
            rig.tweezers.start()
            oscillator_hz = rig.described("local_oscillator")
            n = 75 * 1000  # whole loops, so that a seam would show
            samples = rig.ring.latest(n)
        for axis, amplitudes in zip(samples, asked, strict=True):
            spectrum = np.abs(np.fft.fft(axis)) / n
            bins = np.rint((TONES_HZ - oscillator_hz) * n / RATE_HZ).astype(int) % n
            assert np.abs(spectrum[bins] / amplitudes - 1.0).max() < 0.01
            assert np.abs(spectrum[bins] / amplitudes - 1.0).max() < 1e-5  # no more than float32 rounds
            spectrum[bins] = 0.0
            assert 20 * np.log10(spectrum.max() / amplitudes.min()) < -100.0  # asked for: -50 dBc
            halves = axis.reshape(2, -1)
            waves = np.exp(-2j * np.pi * np.outer(TONES_HZ - oscillator_hz, np.arange(n // 2) / RATE_HZ))
            turned = np.angle((waves @ halves[1]) / (waves @ halves[0]))
            expected = 2 * np.pi * (TONES_HZ - oscillator_hz) * (n // 2) / RATE_HZ
            turn = np.angle(np.exp(1j * (turned - expected)))
            assert np.abs(turn / (2 * np.pi) * RATE_HZ / (n // 2)).max() < 1.0  # Hz

    def test_of_calibrated_rows_and_columns_goes_to_their_own_outputs(self) -> None:
        rows, columns = np.full(20, 0.02), np.linspace(0.01, 0.04, 20)
        with opened(**FULL, row_channel=1, column_channel=0) as rig:
            rig.tweezers.load((rows, columns))
            rig.tweezers.start()
            samples = rig.ring.latest(7500)
            oscillator_hz = rig.described("local_oscillator")
        assert amplitudes_in(samples[1], oscillator_hz) == pytest.approx(rows, rel=1e-3)
        assert amplitudes_in(samples[0], oscillator_hz) == pytest.approx(columns, rel=1e-3)

    def test_is_refused_beyond_full_scale_and_nothing_changes(self) -> None:
        with opened(**FULL) as rig:
            rig.tweezers.start()
            too_much, columns = np.full(20, 0.2), np.full(20, 0.05)
            with pytest.raises(
                LimitError, match=r"peak of the row tones is 1.0\d of full scale; the limit is 1"
            ):
                rig.tweezers.load((too_much, columns))
            oscillator_hz = rig.described("local_oscillator")
            heard = amplitudes_in(rig.ring.latest(7500)[0], oscillator_hz)
        assert heard == pytest.approx(np.full(20, 0.05), rel=1e-3)


class TestRamps:
    def test_are_linear_in_depth_from_where_it_is_without_a_jump(self, tmp_path: Path) -> None:
        with opened(arguments=f"folder={tmp_path},record=10000000") as rig:
            rig.tweezers.start()
            rig.tweezers.ramp(0.3, 0.02)
            rig.tweezers.ramp(0.3, 0.005)
            rig.tweezers.ramp(1.0, 0.03)
            rig.tweezers.safe_state()
        for channel in (0, 1):
            samples = recorded(tmp_path, channel)
            course = depth(samples, N_LOOP, _full(samples))
            assert not np.isnan(course).any(), "a phase jumped"
            known = course[np.abs(samples) > 0.02]
            jumps = np.abs(np.diff(known))
            steepest = 1.0 / (0.01 * 1.2e6)  # of start and safe_state: from 0 to 1 in 10 ms
            assert jumps.max() < 20 * steepest  # where samples between were too small to judge by
            assert np.quantile(jumps, 0.99) < 2.1 * steepest
            assert np.abs(samples[-100:]).max() == 0.0

    def test_turn_the_light_up_and_down_in_the_time_that_is_asked_for(self, tmp_path: Path) -> None:
        with opened(arguments=f"folder={tmp_path},record=10000000") as rig:
            rig.tweezers.start()
            rig.tweezers.ramp(0.5, 0.01)
        samples = recorded(tmp_path)
        course = depth(samples, N_LOOP, _full(samples))
        between = np.flatnonzero(
            (course > 0.5005) & (course < 0.9995) & (np.arange(len(course)) > _full(samples).start)
        )
        assert np.ptp(between) == pytest.approx(0.01 * 1.2e6, rel=0.02)

    def test_of_no_duration_switch_from_one_sample_to_the_next(self, tmp_path: Path) -> None:
        with opened(arguments=f"folder={tmp_path},record=10000000") as rig:
            rig.tweezers.start()
            rig.tweezers.ramp(0.5, 0.0)
            rig.tweezers.ramp(1.0, 0.0)
        samples = recorded(tmp_path)
        course = depth(samples, N_LOOP, _full(samples))
        lowered = np.flatnonzero(np.abs(course - 0.5) < 1e-3)
        assert len(lowered) > 1000
        assert not np.isnan(course).any(), "a phase jumped"

    def test_before_start_raise_the_calibrated_amplitudes(self) -> None:
        with opened() as rig:
            rig.tweezers.ramp(1.0, 0.001)
            power = np.mean(np.abs(rig.ring.latest(800)) ** 2, axis=1)
        assert power == pytest.approx([3 / 3**2, 4 / 4**2], rel=1e-4)


def test_new_amplitudes_take_the_place_of_old_ones_without_a_jump(tmp_path: Path) -> None:
    with opened(arguments=f"folder={tmp_path},record=10000000", fade=0.005) as rig:
        rig.tweezers.start()
        rig.tweezers.load((np.full(3, 0.1), np.full(4, 0.1)))
        latest = rig.ring.latest(800)
    samples = recorded(tmp_path)
    assert np.mean(np.abs(latest) ** 2, axis=1) == pytest.approx([0.03, 0.04], rel=1e-4)
    full = _full(samples)
    change = np.abs(samples[full.start + N_LOOP :] - samples[full.start : -N_LOOP])
    assert change[: 30 * N_LOOP].max() < 1.01 * N_LOOP / (0.005 * 1.2e6)


def test_the_gain_that_is_not_given_is_the_lowest() -> None:
    with opened(row_gain=30.0) as rig:
        assert rig.ring["gain_db"].tolist() == [30.0, 0.0]


def _full(samples: np.ndarray) -> slice:
    """A stretch at full depth: where the power of a loop does not change and is highest."""
    n = len(samples) // N_LOOP
    power = np.mean(np.abs(samples[: n * N_LOOP].reshape(n, N_LOOP)) ** 2, axis=1)
    highest = np.flatnonzero(power > power.max() * (1 - 1e-5))
    return slice(int(highest[1]) * N_LOOP, int(highest[-1]) * N_LOOP)
