"""Tones found in played outputs, against the intended ones; pulses between silences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_virtual.rf_analysis import (
    Band,
    PulseReceiver,
    RfPulse,
    Tracks,
    active_spans,
    envelope,
    track_tones,
)

from labseq.model import RfSamples, RfSpan, RfTones, TonesNow

from .rf import FULL_SCALE_V, RATE_HZ, START_S, played, program_of

BAND = Band(75e6, 50e6)
TRANSIT_S = 10e-6
MIN_V = FULL_SCALE_V / 20 * 0.045


def follow(spans: list[RfSpan] | list[RfSamples], start_s: float, end_s: float) -> Tracks:
    return track_tones(spans, start_s - 30e-6, end_s + 30e-6, BAND, TRANSIT_S, MIN_V, 1.2e6)


def parked(hz: list[float], volts: list[float], duration_s: float = 200e-6) -> RfTones:
    n, zeros = len(hz), np.zeros(len(hz))
    phase_rad = np.linspace(0, 5, n)
    return RfTones(START_S, START_S + duration_s, np.array(hz), zeros, np.array(volts), zeros, phase_rad)


def found(tracks: Tracks, k: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Frequency, volts and phase of the tones that are on in a frame, by frequency."""
    rows = np.stack([tracks.frequency_hz[k], tracks.amplitude_v[k], tracks.phase_rad[k]], axis=1)
    rows = rows[~np.isnan(rows[:, 0])]
    return rows[np.argsort(rows[:, 0])]


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("speed_profile", "within_hz"), [("constant", 1e3), ("minimum_jerk", 10e3)])
def test_a_program_is_recovered_from_its_samples(axis: int, speed_profile: str, within_hz: float) -> None:
    """Where the chirp changes, the mean over the beam is not the value in its middle."""
    program = program_of(
        ([(5, 2), (5, 4), (5, 9)], [(5, 1), (5, 4), (5, 13)]),
        ([(3, 7), (8, 7)], [(6, 7), (9, 7)]),
        speed_profile=speed_profile,
    )
    spans = played(program)[axis]
    n_compared = 0
    for start_s, end_s in active_spans(spans[0]):
        tracks = follow(spans, start_s, end_s)
        for k, time_s in enumerate(tracks.t_s - START_S):
            joint = np.abs(program.joint_s - time_s).min()
            meant: TonesNow = program.tones_at(time_s).row if axis == 0 else program.tones_at(time_s).column
            if joint < 1.4 * TRANSIT_S or not len(meant.frequency_hz):
                continue
            n_compared += 1
            order = np.argsort(meant.frequency_hz)
            hz, volts, phase_rad = found(tracks, k).T
            assert hz == pytest.approx(meant.frequency_hz[order], abs=within_hz)
            assert volts == pytest.approx(meant.amplitude[order] * FULL_SCALE_V, rel=5e-3)
            off = (phase_rad - meant.phase_rad[order] + math.pi) % math.tau - math.pi
            assert np.abs(off).max() < 0.05
    assert n_compared > 60


@settings(max_examples=10)
@given(st.lists(st.floats(0.5, 3.0), min_size=1, max_size=10), st.floats(83e6, 90e6), st.floats(0.004, 0.02))
def test_parked_tones_are_resolved_down_to_the_least_spacing(
    gaps_mhz: list[float], first_hz: float, volts: float
) -> None:
    hz = first_hz + np.cumsum([0.0, *gaps_mhz[1:]]) * 1e6
    tracks = follow([parked(hz.tolist(), [volts] * len(hz))], START_S, START_S + 200e-6)
    middle = found(tracks, len(tracks.t_s) // 2)
    assert middle[:, 0] == pytest.approx(hz, abs=2e3)
    assert middle[:, 1] == pytest.approx(np.full(len(hz), volts), rel=2e-2)


def test_tones_and_their_samples_give_the_same_tones() -> None:
    tones = parked([96e6, 99.3e6], [0.01, 0.005])
    t_s = np.arange(round(200e-6 * RATE_HZ)) / RATE_HZ
    waves = tones.amplitude_v[:, None] * np.cos(
        math.tau * tones.frequency_hz[:, None] * t_s + tones.phase_rad[:, None]
    )
    samples = np.rint(waves.sum(axis=0) / FULL_SCALE_V * 32767).astype(np.int16)
    sampled = RfSamples(START_S, RATE_HZ, samples, FULL_SCALE_V / 32767)
    middles = []
    for span in (tones, sampled):
        tracks = follow([span], START_S, START_S + 200e-6)
        k = int(np.abs(tracks.t_s - START_S - 100e-6).argmin())
        rows = found(tracks, k)
        rows[:, 2] -= math.tau * rows[:, 0] * (tracks.t_s[k] - START_S)
        rows[:, 2] = (rows[:, 2] + math.pi) % math.tau - math.pi
        middles.append(rows)
    np.testing.assert_allclose(middles[0][:, :2], middles[1][:, :2], rtol=1e-3)
    assert np.abs(np.exp(1j * middles[0][:, 2]) - np.exp(1j * middles[1][:, 2])).max() < 0.01


def test_a_tone_that_comes_on_at_once_rises_as_the_sound_crosses_the_beam() -> None:
    """The amplitude is the part of the beam, a Gaussian, that the sound has filled."""
    tracks = follow([parked([100e6], [0.01])], START_S, START_S + 200e-6)
    for time_s, volts in zip(tracks.t_s - START_S, tracks.amplitude_v[:, 0], strict=True):
        if 1e-6 < time_s < 30e-6:
            share = (1 + math.erf(math.sqrt(2) * time_s / (TRANSIT_S / 2))) / 2
            assert volts == pytest.approx(0.01 * share, rel=0.01)


def test_tones_beyond_the_band_make_no_light() -> None:
    tracks = follow([parked([60e6, 100e6, 140e6], [0.01] * 3)], START_S, START_S + 200e-6)
    assert found(tracks, len(tracks.t_s) // 2)[:, 0] == pytest.approx([100e6], abs=1e3)


def test_samples_sound_from_the_first_to_the_last_block_that_is_not_zero() -> None:
    samples = np.zeros(10_000, np.int16)
    assert active_spans(RfSamples(START_S, 1e6, samples, 1e-6)) == []
    samples[3000], samples[9999] = 1, -1
    first, second = active_spans(RfSamples(START_S, 1e6, samples, 1e-6))
    assert first == pytest.approx((START_S + 2048e-6, START_S + 3072e-6))
    assert second == pytest.approx((START_S + 9216e-6, START_S + 10_000e-6))


def test_spans_that_follow_one_another_are_one_signal() -> None:
    whole = played(program_of(([(5, 2)], [(5, 6)])))[1][0]
    cut = 400_000
    parts = [
        RfSamples(START_S, RATE_HZ, whole.samples[:cut], whole.volts_per_step),
        RfSamples(START_S + cut / RATE_HZ, RATE_HZ, whole.samples[cut:], whole.volts_per_step),
    ]
    one, two = (envelope(spans, START_S + 4e-4, START_S + 8e-4, BAND).values for spans in ([whole], parts))
    np.testing.assert_array_equal(one, two)


class Outputs:
    """An ``RfSource`` that says when it was asked, and answers what is put into it."""

    def __init__(self) -> None:
        self.rows: list[RfSpan] = []
        self.columns: list[RfSpan] = []
        self.asked: list[float] = []

    def played(self, until_s: float) -> tuple[list[RfSpan], list[RfSpan]]:
        self.asked.append(until_s)
        spans = self.rows, self.columns
        self.rows, self.columns = [], []
        return spans


def tone(start_s: float, end_s: float) -> RfTones:
    one = np.ones(1)
    return RfTones(start_s, end_s, 1e8 * one, 0 * one, one, 0 * one, 0 * one)


def times(found: list[RfPulse]) -> list[tuple[float, float]]:
    return [(pulse.start_s, pulse.end_s) for pulse in found]


def test_a_long_silence_separates_pulses_and_a_short_one_does_not() -> None:
    outputs = Outputs()
    outputs.rows = [tone(1.0, 1.1), tone(1.15, 1.2), tone(2.0, 2.1)]
    found = list(PulseReceiver(outputs, 0.1).receive_until(3.0))
    assert times(found) == [(1.0, 1.2), (2.0, 2.1)]
    assert [len(pulse.rows) for pulse in found] == [2, 1]
    assert outputs.asked == [3.0]


def test_a_pulse_lasts_while_either_output_plays() -> None:
    outputs = Outputs()
    outputs.rows, outputs.columns = [tone(1.0, 1.5)], [tone(0.8, 1.2), tone(4.0, 4.1)]
    first, second = PulseReceiver(outputs, 0.1).receive_until(5.0)
    assert times([first, second]) == [(0.8, 1.5), (4.0, 4.1)]
    assert (len(first.rows), len(first.columns), len(second.rows)) == (1, 1, 0)


def test_a_pulse_that_continues_across_two_calls_is_marked() -> None:
    outputs = Outputs()
    receiver = PulseReceiver(outputs, 0.1)
    outputs.rows = [tone(1.0, 2.0)]
    (before,) = receiver.receive_until(2.0)
    outputs.rows = [tone(2.0, 2.5)]
    (after,) = receiver.receive_until(3.0)
    outputs.rows = [tone(3.5, 3.6)]
    (later,) = receiver.receive_until(4.0)
    assert [pulse.continued for pulse in (before, after, later)] == [False, True, False]
