"""The static tweezers on a radio: contract, tones, and the samples that the radio receives."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_soapy import tones
from labseq_soapy.settings import SoapySettings
from labseq_soapy.static_tweezers import SoapyStaticTweezers
from labseq_soapy_stream.messages import Facts
from labseq_soapy_stream.output import BLOCK, Output, Samples
from labseq_soapy_stream.streamer import repeated

from labseq.model.grid import centred_comb
from labseq.plugin import Context, DeviceError, LimitError, SiteGrid
from labseq.testing import StaticTweezersContract

from .labseq_soapy_rig import GRID, SMALL, depth, made, opened, recorded, until


class TestSoapyStaticTweezers(StaticTweezersContract):
    ramp_s = 0.002

    def context(self) -> Context:
        return replace(super().context(), grid=GRID)

    @pytest.fixture
    def factory(self) -> Callable[[Context], SoapyStaticTweezers]:
        chosen = SoapySettings.model_validate({**SMALL, "switch": 1e-3})
        return partial(SoapyStaticTweezers, chosen)


def test_it_tests_itself_in_the_dark_and_describes_the_radio_and_the_tones() -> None:
    with opened(row_gain=12.0) as rig:
        rig.tweezers.self_test()
        rig.tweezers.check_interlocks()
        assert not rig.ring.latest(1000).any()
        rig.tweezers.start()
        described = rig.tweezers.describe()
        before_s = rig.clock.now()
        rig.tweezers.ramp(0.5, 0.01)
        assert rig.clock.now() == pytest.approx(before_s + 0.01)
    assert described["radio"]["driver"] == "capture"
    assert described["gain_db"] == [12.0, 0.0], "the lowest where none is given"
    assert described["locks"] == {"ref_locked": True, "lo_locked 0": True, "lo_locked 1": True}
    assert (described["loop_samples"], described["underflows"]) == (80, 0)
    assert all(1.0 < crest < 1.5 for crest in described["crest_factor"])


@pytest.mark.parametrize(
    ("chosen", "text"),
    [
        ({"sample_rate": 200e3}, "column tones: .* local oscillator at 100.015 MHz"),
        ({"local_oscillator": 99.3e6}, "0.48 MHz, .* sample rate of 1.2 MHz"),
        ({"local_oscillator": 100.1234567e6, "tone_tolerance": 1e-6}, "round tones, local_oscillator"),
    ],
)
def test_tones_that_the_radio_cannot_make_are_refused_before_it_is_opened(
    chosen: dict[str, Any], text: str
) -> None:
    with pytest.raises(LimitError, match=text):
        made(**chosen)


TONES_HZ = centred_comb(20)
RATE_HZ = 40e6
COMBS = st.builds(
    centred_comb,
    st.integers(1, 30),
    st.integers(80, 120).map(lambda mhz: mhz * 1e6),
    st.integers(20, 100).map(lambda steps: steps * 2e4),
)


@given(COMBS)
def test_the_oscillator_and_images_stay_a_third_of_a_site_off_every_comb(comb: np.ndarray) -> None:
    spacing_hz = comb[1] - comb[0] if len(comb) > 1 else 1e6
    assert tones.clearance(comb, tones.local_oscillator((comb, comb))) >= spacing_hz / 3 - 1e-3


@given(COMBS, COMBS)
def test_two_axes_share_the_oscillator_in_their_middle(rows: np.ndarray, columns: np.ndarray) -> None:
    low, high = min(rows.min(), columns.min()), max(rows.max(), columns.max())
    assert abs(tones.local_oscillator((rows, columns)) - (low + high) / 2) <= 2e6


@given(COMBS, st.sampled_from([40e6, 50e6, 61.44e6]))
def test_the_loop_is_the_shortest_that_holds_all_tones_to_within_a_hertz(
    comb: np.ndarray, rate_hz: float
) -> None:
    offsets_hz = comb - tones.local_oscillator((comb, comb))
    n = tones.shortest_loop("x", offsets_hz, rate_hz, 1.0)
    error_hz, shorter_hz = (
        np.abs(np.rint(offsets_hz * m / rate_hz) * rate_hz / m - offsets_hz).max() for m in (n, max(1, n - 1))
    )
    assert error_hz < 1.0
    assert n == 1 or shorter_hz >= 1.0


def test_a_loop_plays_each_tone_with_its_amplitude_without_a_seam() -> None:
    offsets_hz = TONES_HZ - tones.local_oscillator((TONES_HZ, TONES_HZ))
    loop = tones.axis_loop(offsets_hz, tones.shortest_loop("x", offsets_hz, RATE_HZ, 1.0), RATE_HZ)
    amplitudes = np.linspace(0.01, 0.05, 20)
    samples = np.tile(loop.samples(amplitudes), 40)
    t_s = np.arange(len(samples)) / RATE_HZ
    expected = np.exp(1j * (2 * np.pi * np.outer(t_s, offsets_hz) + loop.phase_rad)) @ amplitudes
    assert np.abs(samples - expected).max() < 1e-5


@pytest.mark.parametrize(("n_tones", "crest"), [(1, 1.0), (2, 1.4143), (3, 1.3), (10, 1.2), (20, 1.21)])
def test_phases_make_a_low_crest_factor(n_tones: int, crest: float) -> None:
    phases = tones.low_crest_phases(1e6 * np.arange(float(n_tones)))
    loop = tones.AxisLoop(512 * n_tones, 16 * np.arange(n_tones), phases)
    assert tones.crest_factor(loop.samples(np.ones(n_tones))) <= crest + 1e-3


@pytest.mark.parametrize(
    ("offset_hz", "components", "detune_hz"),
    [(0.0, 2, 0), (200e3, 2, 0), (200e3, 1, 0), (200e3, 1, 11e3), (200e3, 2, -11e3)],
)
def test_an_offset_moves_the_leakage_out_of_the_tones_and_leaves_them_where_they_are(
    offset_hz: float, components: int, detune_hz: float
) -> None:
    """Also on a radio that is tuned a little elsewhere: the tones follow what it reports."""
    tones_hz, n = centred_comb(4, 100e6, 60e3), 1200 * 64
    arguments = f"leakage=0.01,components={components},detune={detune_hz}"
    with opened(arguments=arguments, lo_offset=offset_hz) as rig:
        rig.tweezers.start()
        n_loop = rig.described("loop_samples")

        def is_steady() -> bool:
            """Whether the latest samples repeat: on a busy computer the radio may just have run dry."""
            samples = rig.ring.latest(n)[1]
            return len(samples) == n and np.array_equal(samples[n_loop:], samples[:-n_loop])

        until(lambda: bool(rig.ring["sent"] > 4 * n) and is_steady())
        spectrum = np.abs(np.fft.fft(rig.ring.output(n)[1])) / n
        zero_hz, leak_hz = float(rig.ring["frequency_hz"][1]), rig.described("oscillator_hz")[1]
        assert n % n_loop == 0
    assert (zero_hz == leak_hz) == (components == 1 or not offset_hz)
    lines_hz = zero_hz + np.fft.fftfreq(n, 1 / 1.2e6)[np.flatnonzero(spectrum > 0.005)]
    is_tone = np.isclose(lines_hz[:, None], tones_hz, atol=20.0).any(axis=1)
    assert np.count_nonzero(is_tone) == 4
    assert lines_hz[~is_tone] == pytest.approx([leak_hz], abs=20.0)
    assert (tones_hz.min() < leak_hz < tones_hz.max()) == (not offset_hz)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("lo_offset", [0.0, -200e3])
@pytest.mark.parametrize(("error_hz", "is_refused"), [(-12.1e3, 1), (-11.9e3, 0), (11.9e3, 0), (12.1e3, 1)])
def test_a_local_oscillator_tuned_further_away_than_a_hundredth_of_the_rate_is_refused(
    axis: int, lo_offset: float, error_hz: float, is_refused: bool
) -> None:
    chosen = SoapySettings.model_validate({**SMALL, "lo_offset": lo_offset})
    array = tones.ArrayTones("array", chosen, GRID.shape)
    oscillator_hz = [array.oscillator_hz + lo_offset] * 2
    oscillator_hz[axis] += error_hz
    facts = Facts({}, chosen.sample_rate, [array.oscillator_hz] * 2, oscillator_hz, (0.0, 0.0), {})
    refusal = pytest.raises(DeviceError, match=f"to {oscillator_hz[axis]:.10g} Hz")
    with refusal if is_refused else nullcontext():
        array.tune(facts)


B210, N210, X310 = "driver=uhd,type=b200", "driver=uhd,type=usrp2", "driver=uhd, product=X310"


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ({"device": "driver=uhd"}, []),
        ({"device": X310}, []),
        ({"device": B210}, ["B2x0 .* 30.72 MHz .* up to 30.72 MHz"]),
        ({"device": N210}, ["320 MB/s, .* Ethernet carries 100 MB/s.* up to 12.5 MHz"]),
        ({"device": N210, "stream": "WIRE=sc8", "sample_rate": 25e6}, []),
        ({"device": X310, "bus": "1gbe", "stream": "WIRE=sc8"}, ["160 MB/s.* 100 MB/s.* up to 25 MHz"]),
        ({"device": B210, "bus": "usb2", "sample_rate": 20e6}, ["160 MB/s.* 53.248 MB/s.* up to 6.656 MHz"]),
    ],
)
def test_a_sample_rate_that_a_radio_or_its_connection_cannot_keep_up_with_is_warned_of(
    chosen: dict[str, Any], expected: list[str]
) -> None:
    found = [f"{what}; {better}" for _, what, better in SoapySettings.model_validate(chosen).warnings()]
    assert len(found) == len(expected)
    assert all(map(re.search, expected, found)), found


N_LOOP = 96


def loop(scale: float = 1.0) -> Samples:
    wave = np.exp(2j * np.pi * 5 * np.arange(N_LOOP) / N_LOOP).astype(np.complex64)
    return repeated(scale * np.stack([wave, wave.conj()]).view(np.float32))


def played(output: Output, n: int) -> np.ndarray:
    """The next n samples or more, complex64 (2, n)."""
    blocks: list[np.ndarray] = []
    while sum(block.shape[1] for block in blocks) < n:
        blocks.append(output.block().copy().view(np.complex64))
    return np.concatenate(blocks, axis=1)


def switched_on() -> Output:
    """At full depth, at the loop's start."""
    output = Output()
    output.load(loop(), 1)
    output.ramp(1.0, 1)
    played(output, 1)
    return output


def test_there_is_silence_before_a_loop_is_on_and_then_the_loop_itself_without_a_copy() -> None:
    output, own = Output(), loop()
    assert not played(output, 10).any()
    output.load(own, 100)
    assert not played(output, 10).any()
    assert output.steady
    output.ramp(1.0, 1)
    output.block()
    assert np.shares_memory(output.block(), own)


@settings(max_examples=40)
@given(st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(1, 3 * BLOCK)), min_size=1, max_size=4))
def test_the_depth_is_linear_to_the_sample_and_phases_run_on(ramps: list[tuple[float, int]]) -> None:
    output, wave = Output(), loop().view(np.complex64)
    output.load(loop(), 1)
    start, at = 0.0, 0
    for end, n in ramps:
        output.ramp(end, n)
        samples = played(output, n)
        factor = samples / wave[:, (at + np.arange(samples.shape[1])) % wave.shape[1]]
        expected = start + (end - start) * np.minimum(1.0, np.arange(1, samples.shape[1] + 1) / n)
        assert np.abs(factor.imag).max() < 1e-5
        assert np.abs(factor.real**4 - expected).max() < 1e-5
        start, at = end, at + samples.shape[1]
        assert output.depth == end


def test_a_ramp_that_comes_during_a_ramp_goes_on_from_where_it_is() -> None:
    output = Output()
    output.load(loop(), 1)
    output.ramp(1.0, 4 * BLOCK)
    first = played(output, BLOCK)
    output.ramp(0.0, BLOCK)
    course = np.abs(np.concatenate([first, played(output, BLOCK)], axis=1)[0]) ** 4
    assert course.max() == pytest.approx(0.25, abs=1e-3)
    assert np.abs(np.diff(course)).max() < 1.01 / BLOCK
    assert course[-1] < 1e-9


def test_a_fade_that_is_cut_short_by_another_one_goes_on_from_where_it_is() -> None:
    output = switched_on()
    output.load(loop(0.5), 4 * BLOCK)
    first = played(output, BLOCK)
    output.load(loop(0.25), BLOCK)
    size = np.abs(np.concatenate([first, played(output, BLOCK)], axis=1)[0])
    assert np.abs(np.diff(size)).max() < 1.0 / BLOCK
    assert size[-1] == pytest.approx(0.25, abs=1e-5)


def test_a_ramp_and_a_fade_may_come_together() -> None:
    output = switched_on()
    output.load(loop(0.5), 2 * BLOCK)
    output.ramp(0.0, BLOCK)
    size = np.abs(played(output, BLOCK)[0])
    assert np.all(np.diff(size) <= 1e-6)
    output.ramp(1.0, 1)
    assert np.abs(played(output, 2 * BLOCK))[0, -1] == pytest.approx(0.5, abs=1e-5)


FULL: dict[str, Any] = {
    "grid": SiteGrid(20, 20),
    "device": "simulated",
    "sample_rate": RATE_HZ,
    "row_frequency": {},
    "column_frequency": {},
}
"""The paper's array, on a radio whose clock goes at a tenth of real time."""


def test_two_times_twenty_tones_are_as_requested_on_their_outputs_and_too_much_changes_nothing() -> None:
    rows, columns = 0.03 + 0.02 * np.sin(np.arange(20.0)), 0.04 + 0.01 * np.cos(np.arange(20.0))
    with opened(**FULL, row_channel=1, column_channel=0, max_depth=1.5) as rig:
        rig.tweezers.load((rows, columns))
        rig.tweezers.start()
        with pytest.raises(LimitError, match=r"peak of the row tones is 1.0\d of full scale"):
            rig.tweezers.load((np.full(20, 0.18), columns))  # too much at the greatest depth only
        offsets_hz = TONES_HZ - rig.described("local_oscillator")
        n = 75 * 1000  # whole loops, so that a seam would show
        samples = rig.ring.latest(n)
    for axis, amplitudes in zip(samples, (columns, rows), strict=True):
        spectrum = np.abs(np.fft.fft(axis)) / n
        bins = np.rint(offsets_hz * n / RATE_HZ).astype(int) % n
        assert np.abs(spectrum[bins] / amplitudes - 1.0).max() < 1e-5  # no more than float32 rounds
        spectrum[bins] = 0.0
        assert 20 * np.log10(spectrum.max() / amplitudes.min()) < -100.0  # in dBc
        halves = axis.reshape(2, -1)
        waves = np.exp(-2j * np.pi * np.outer(offsets_hz, np.arange(n // 2) / RATE_HZ))
        turned = np.angle((waves @ halves[1]) / (waves @ halves[0]))
        expected = 2 * np.pi * offsets_hz * (n // 2) / RATE_HZ
        turn = np.angle(np.exp(1j * (turned - expected)))
        assert np.abs(turn / (2 * np.pi) * RATE_HZ / (n // 2)).max() < 1.0, "a tone is off by 1 Hz"


SMALL_LOOP = 80
"""Samples of the small array's loop."""


def at_full_depth(samples: np.ndarray) -> slice:
    """A stretch in which the power of a loop does not change and is highest."""
    n = len(samples) // SMALL_LOOP
    power = np.mean(np.abs(samples[: n * SMALL_LOOP].reshape(n, SMALL_LOOP)) ** 2, axis=1)
    highest = np.flatnonzero(power > power.max() * (1 - 1e-5))
    return slice(int(highest[1]) * SMALL_LOOP, int(highest[-1]) * SMALL_LOOP)


def test_ramps_are_linear_in_depth_and_last_as_long_as_requested(tmp_path: Path) -> None:
    with opened(arguments=f"folder={tmp_path},record=10000000") as rig:
        rig.tweezers.start()
        rig.tweezers.ramp(0.3, 0.02)
        rig.tweezers.ramp(0.3, 0.005)
        rig.tweezers.ramp(1.0, 0.03)
        rig.tweezers.safe_state()
    for channel in (0, 1):
        samples = recorded(tmp_path, channel)
        course = depth(samples, SMALL_LOOP, at_full_depth(samples))
        assert not np.isnan(course).any(), "a phase jumped"
        jumps = np.abs(np.diff(course[np.abs(samples) > 0.02]))
        steepest = 1.0 / (0.01 * 1.2e6)  # of start and safe_state: from 0 to 1 in 10 ms
        assert jumps.max() < 20 * steepest  # where samples between were too small to judge by
        assert np.quantile(jumps, 0.99) < 2.1 * steepest
        assert np.abs(samples[-100:]).max() == 0.0
        lit = np.flatnonzero((course > 0.3005) & (course < 0.9995))
        ramps = np.split(lit, np.flatnonzero(np.diff(lit) > 1000) + 1)  # start, down, up, safe state
        assert [np.ptp(ramp) / 1.2e6 for ramp in ramps[1:3]] == pytest.approx([0.02, 0.03], rel=0.02)


def test_ramps_of_no_duration_switch_from_one_sample_to_the_next(tmp_path: Path) -> None:
    with opened(arguments=f"folder={tmp_path},record=10000000") as rig:
        rig.tweezers.start()
        rig.tweezers.ramp(0.5, 0.0)
        rig.tweezers.ramp(1.0, 0.0)
    samples = recorded(tmp_path)
    course = depth(samples, SMALL_LOOP, at_full_depth(samples))
    assert np.count_nonzero(np.abs(course - 0.5) < 1e-3) > 1000
    assert not np.isnan(course).any(), "a phase jumped"


def test_a_release_is_silence_for_its_samples_and_the_loop_runs_on(tmp_path: Path) -> None:
    with opened(arguments=f"folder={tmp_path},record=10000000") as rig:
        rig.tweezers.start()
        assert rig.tweezers.release(50.7e-6) == 61 / 1.2e6
        assert rig.tweezers.describe()["depth"] == 1.0
    samples = recorded(tmp_path)
    full = at_full_depth(samples)
    wave = np.resize(samples[full.start : full.start + SMALL_LOOP], full.stop - full.start)
    kept = samples[full] == wave  # to the last bit: no phase jumps, no other amplitude
    (dark,) = np.flatnonzero(np.diff(np.flatnonzero(np.concatenate([[True], kept, [True]]))) > 1)
    assert np.count_nonzero(~kept) == 61
    assert not samples[full][dark : dark + 61].any()


def test_a_ramp_that_comes_during_a_release_starts_from_the_dark_at_once() -> None:
    output = switched_on()
    output.release(10 * BLOCK)
    assert not played(output, BLOCK).any()
    assert not output.steady
    output.ramp(0.0, BLOCK)  # the safe state
    assert not played(output, BLOCK).any()
    assert output.steady
    output.ramp(1.0, 1)
    played(output, 1)
    output.release(BLOCK)
    output.ramp(1.0, BLOCK)  # the next shot
    course = np.abs(played(output, BLOCK)[0]) ** 4
    assert course[0] < 2 / BLOCK
    assert course[-1] == pytest.approx(1.0, abs=1e-4)
    output.release(100)
    assert not played(output, 100).any()
    assert output.steady
    assert played(output, 1).any()


def test_new_amplitudes_are_faded_in(tmp_path: Path) -> None:
    with opened(arguments=f"folder={tmp_path},record=10000000", fade=0.005) as rig:
        rig.tweezers.start()
        rig.tweezers.load((np.full(3, 0.1), np.full(4, 0.1)))
        latest = rig.ring.latest(800)
    samples = recorded(tmp_path)
    assert np.mean(np.abs(latest) ** 2, axis=1) == pytest.approx([0.03, 0.04], rel=1e-4)
    full = at_full_depth(samples)
    change = np.abs(samples[full.start + SMALL_LOOP :] - samples[full.start : -SMALL_LOOP])
    assert change[: 30 * SMALL_LOOP].max() < 1.01 * SMALL_LOOP / (0.005 * 1.2e6)
