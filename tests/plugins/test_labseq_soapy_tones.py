"""Local oscillator, loops and phases of the static tweezers' tones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from labseq_soapy import tones

from labseq import LimitError
from labseq.model.grid import centred_comb

PAPER = centred_comb(20)
COMBS = st.builds(
    centred_comb,
    st.integers(1, 30),
    st.integers(80, 120).map(lambda mhz: mhz * 1e6),
    st.integers(20, 100).map(lambda steps: steps * 2e4),
)


class TestLocalOscillator:
    def test_leaks_no_nearer_than_a_quarter_of_a_site_to_a_tone_of_the_paper_and_nor_do_images(self) -> None:
        oscillator_hz = tones.local_oscillator((PAPER, PAPER))
        spots = np.append(2 * oscillator_hz - PAPER, oscillator_hz)
        assert np.abs(spots[:, None] - PAPER).min() > 1.6e6 / 4
        assert abs(oscillator_hz - 100e6) < 1.6e6

    def test_half_a_site_beside_a_tone_would_put_images_onto_tones(self) -> None:
        assert tones.clearance(PAPER, 100e6) == 0.0

    @given(COMBS)
    def test_stays_a_third_of_a_site_off_on_every_comb(self, comb: np.ndarray) -> None:
        spacing_hz = comb[1] - comb[0] if len(comb) > 1 else 1e6
        clear_hz = tones.clearance(comb, tones.local_oscillator((comb, comb)))
        assert clear_hz >= spacing_hz / 3 - 1e-3

    @given(COMBS, COMBS)
    def test_is_shared_by_two_axes(self, rows: np.ndarray, columns: np.ndarray) -> None:
        oscillator_hz = tones.local_oscillator((rows, columns))
        low, high = min(rows.min(), columns.min()), max(rows.max(), columns.max())
        assert abs(oscillator_hz - (low + high) / 2) <= 2e6


class TestLoop:
    @given(COMBS, st.sampled_from([40e6, 50e6, 61.44e6]))
    def test_is_the_shortest_that_holds_all_tones_to_within_a_hertz(
        self, comb: np.ndarray, rate_hz: float
    ) -> None:
        offsets_hz = comb - tones.local_oscillator((comb, comb))
        n = tones.shortest_loop("x", offsets_hz, rate_hz, 1.0)
        errors_hz = [
            np.abs(np.rint(offsets_hz * m / rate_hz) * rate_hz / m - offsets_hz).max()
            for m in (n, n - 1)
            if m
        ]
        assert errors_hz[0] < 1.0
        assert n == 1 or errors_hz[1] >= 1.0

    def test_of_calibrated_tones_is_found_if_they_are_rounded(self) -> None:
        calibrated = np.round(PAPER + 3e4 * np.sin(np.arange(20.0)), -2)
        assert tones.shortest_loop("x", calibrated - 100e6, 40e6, 1.0) <= 400_000

    def test_that_would_be_too_long_is_refused_with_what_to_round_to(self) -> None:
        crooked = PAPER + np.random.default_rng(1).normal(0.0, 3e4, 20)
        with pytest.raises(
            LimitError, match="round tones, local_oscillator and sample_rate to multiples of 10 Hz"
        ):
            tones.shortest_loop("array", crooked - 100e6, 40e6, 1.0)

    def test_plays_each_tone_with_its_amplitude_without_a_seam(self) -> None:
        offsets_hz = PAPER - tones.local_oscillator((PAPER, PAPER))
        loop = tones.axis_loop(offsets_hz, tones.shortest_loop("x", offsets_hz, 40e6, 1.0), 40e6)
        amplitudes = np.linspace(0.01, 0.05, 20)
        samples = np.tile(loop.samples(amplitudes), 40)
        t_s = np.arange(len(samples)) / 40e6
        expected = np.exp(1j * (2 * np.pi * np.outer(t_s, offsets_hz) + loop.phase_rad)) @ amplitudes
        assert np.abs(samples - expected).max() < 1e-5

    @pytest.mark.parametrize("side", [-1, 1])
    def test_tones_beyond_four_fifths_of_the_rate_are_refused(self, side: int) -> None:
        edge = np.array([side * 16.0e6])
        tones.check_span("rows", 100e6 + edge, 100e6, 40e6)
        with pytest.raises(
            LimitError,
            match=r"rows: the outermost tone is 16.01 MHz from .*choose a sample_rate above 40.025 MHz",
        ):
            tones.check_span("rows", 100e6 + edge + side * 1e4, 100e6, 40e6)


class TestPhases:
    @pytest.mark.parametrize(
        ("n_tones", "crest"), [(1, 1.0), (2, 1.4143), (3, 1.3), (10, 1.2), (20, 1.21), (21, 1.2)]
    )
    def test_make_a_low_crest_factor(self, n_tones: int, crest: float) -> None:
        cycles = 16 * np.arange(n_tones)
        phases = tones.low_crest_phases(1e6 * np.arange(float(n_tones)))
        loop = tones.AxisLoop(512 * n_tones, cycles, phases)
        assert tones.crest_factor(loop.samples(np.ones(n_tones))) <= crest + 1e-3

    def test_are_the_same_each_time_and_wherever_the_tones_are(self) -> None:
        once, again = (tones.low_crest_phases(PAPER - offset) for offset in (0.0, 90e6))
        assert np.allclose(np.exp(1j * once), np.exp(1j * again), atol=1e-3)

    def test_of_crooked_tones_beat_random_ones(self) -> None:
        crooked = PAPER + 5e4 * np.sin(np.arange(20.0))
        waves = np.exp(2j * np.pi * np.outer(np.arange(4000) / 40e6, crooked - 100e6))
        ours = np.abs(waves @ np.exp(1j * tones.low_crest_phases(crooked))).max()
        random = np.random.default_rng(0).uniform(0, 2 * np.pi, 20)
        assert ours < np.abs(waves @ np.exp(1j * random)).max()


def test_silence_has_no_crest() -> None:
    assert tones.crest_factor(np.zeros(4, np.complex64)) == 0.0
