"""The driver of the Spectrum card, on the real package spcm and a simulated card: what is played."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from labseq_spcm.keep_warm import KeepWarm
from labseq_spcm.mobile_tweezers import HOT_C, TEST_SAMPLES, SpcmMobileTweezers
from labseq_spcm.play_sequence import SILENT_SAMPLES
from labseq_spcm.replay_fifo import CHUNK, InterleavedRenderer
from labseq_spcm.settings import SpcmSettings
from labseq_spcm_sim import M4I6631, SimulatedCard, SimulatedLibrary, installed, registers
from labseq_spcm_sim.library import CardOutputs
from labseq_virtual.rf_analysis import active_spans, reach_hz

from labseq.motion import tone_program
from labseq.motion.rendering import render
from labseq.plugin import (
    Context,
    DeviceError,
    LimitError,
    MotionSpec,
    Plan,
    TransientError,
)
from labseq.plugin.motion import RfSpec
from labseq.plugin.simulation import RfTones
from labseq.roles import Hardware, overrides
from labseq.testing import MobileTweezersContract
from labseq.testing.fakes import FakeClock

from .conftest import RATE_HZ

MODES = ["replay", "sequence", "fifo", "stream"]
TRIGGERED = ["replay", "sequence", "fifo"]


class TestReplayContract(MobileTweezersContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], SpcmMobileTweezers]:
        return partial(SpcmMobileTweezers, SpcmSettings(card="simulated", mode="replay"))


class TestSequenceContract(MobileTweezersContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], SpcmMobileTweezers]:
        return partial(SpcmMobileTweezers, SpcmSettings(card="simulated", mode="sequence"))


class TestFifoContract(MobileTweezersContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], SpcmMobileTweezers]:
        return partial(SpcmMobileTweezers, SpcmSettings(card="simulated", mode="fifo"))


class TestStreamContract(MobileTweezersContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], SpcmMobileTweezers]:
        return partial(SpcmMobileTweezers, SpcmSettings(card="simulated", mode="stream"))


class TestSamples:
    @pytest.mark.parametrize(("mode", "row_channel"), [("replay", 0), ("sequence", 0), ("fifo", 1)])
    def test_are_what_was_rendered_and_then_silence(self, driver: Any, mode: str, row_channel: int) -> None:
        motion = MotionSpec(rf=RfSpec(full_scale_v=0.2))
        outputs = {"row_channel": row_channel}
        with driver(mode, motion=motion, sample_rate=250e6 + 3, **outputs) as lab:
            assert lab.rate_hz == 250e6, "what the card really makes"
            lab.play(lab.program(5))
            lab.card.forget(lab.clock.now())
            program = lab.program(2)
            rendered = render(program, lab.rate_hz).samples
            lab.play(program)
            for samples, channel in zip(rendered, (row_channel, 1 - row_channel), strict=True):
                played = lab.samples(channel)
                assert np.array_equal(played[: len(samples)], samples)
                assert not played[len(samples) :].any(), "nothing of the program before is left"
                assert len(played) - len(samples) < 32
            assert {span.amplitude_v for span in lab.card.played(0)} == {0.2}


class TestPlaying:
    @pytest.mark.parametrize("mode", MODES)
    def test_takes_the_program_and_the_delay_of_the_trigger(self, driver: Any, mode: str) -> None:
        with driver(mode) as lab:
            program = lab.program(3)
            delay_s = float(lab.tweezers.describe()["trigger_delay_s"])
            most_s = {"stream": 500e-6, "sequence": 110e-6}.get(mode, 10e-6)
            assert 0.1e-6 < delay_s < most_s
            assert lab.tweezers.prepare(program) == pytest.approx(
                program.total_duration_s + delay_s, abs=1.5 / lab.rate_hz * 32
            )
            assert lab.tweezers.prepare(program) > program.total_duration_s + 0.9 * delay_s
            lab.tweezers.play()
            lab.tweezers.wait(1.0)
            with pytest.raises(DeviceError, match="without a prepared program"):
                lab.tweezers.play()

    @pytest.mark.parametrize(("rate_hz", "clocks"), [(250e6, 238.5), (625e6, 238.5), (640e6, 476.5)])
    def test_begins_as_long_after_the_trigger_as_the_manual_says(
        self, driver: Any, rate_hz: float, clocks: float
    ) -> None:
        with driver(sample_rate=rate_hz) as lab:
            delay_s = lab.tweezers.describe()["trigger_delay_s"]
            assert delay_s == pytest.approx(clocks / rate_hz + 16e-9, abs=1e-9)

    @pytest.mark.parametrize("mode", TRIGGERED)
    def test_starts_at_the_external_trigger(self, driver: Any, mode: str) -> None:
        with driver(mode, trigger="external") as lab:
            duration_s = lab.tweezers.prepare(lab.program())
            assert not lab.card.trigger()  # too early: not armed yet
            lab.tweezers.play()
            lab.clock.sleep(2e-3)
            assert not lab.card.played(0)
            triggered_s = lab.clock.now()
            assert lab.card.trigger()
            lab.tweezers.wait(duration_s + 1e-3)
            begun_s = lab.card.played(0)[0].start_s
            delay_s = float(lab.tweezers.describe()["trigger_delay_s"])
            loop_s = SILENT_SAMPLES / lab.rate_hz if mode == "sequence" else 1e-9
            assert -1e-9 < triggered_s + delay_s - begun_s < loop_s


@pytest.mark.parametrize("mode", MODES)
def test_the_relays_close_once_and_settle_before_a_program(driver: Any, mode: str) -> None:
    with driver(mode) as lab:
        closed_s = lab.clock.now()
        lab.tweezers.settle()
        settled_s = lab.clock.now()
        assert settled_s - closed_s == pytest.approx(M4I6631.output_relay_s)
        assert lab.card.outputs_on == (True, True)
        lab.card.log.clear()
        for _ in range(2):
            lab.play(lab.program(1))
        assert not lab.written(registers.SPC_ENABLEOUT0)
        lab.tweezers.safe_state()
        assert lab.card.outputs_on == (False, False)
        lab.card.forget(lab.clock.now())
        lab.play(lab.program(1))
        assert lab.written(registers.SPC_ENABLEOUT0) == [0, 1], "opened, and closed for the next program"
        log = list(lab.card.log)
        closing = max(n for n, e in enumerate(log) if e.register == registers.SPC_ENABLEOUT1)
        written, *_, started = [
            e for e in log[closing:] if e.register == registers.SPC_M2CMD and e.value & 0x6
        ]
        assert (written.value, started.value & 0x4) == (registers.M2CMD_CARD_WRITESETUP, 0x4)
        assert started.time_s >= written.time_s + M4I6631.output_relay_s


PARKED = {"row_frequency": 82.2e6, "column_frequency": 117.9e6}


def _power_w(lab: Any, channel: int, start_s: float, end_s: float) -> float:
    """Mean power into 50 Ohm of what an output played within a time."""
    energy = 0.0
    for span in lab.card.played(channel):
        part = span.between(start_s, end_s) if span.start_s < end_s and span.end_s > start_s else None
        if part is not None and part.n_samples:
            once = part.samples if part.n_samples > len(part.samples) else part.values()
            rms = np.sqrt(np.mean(np.square(once / 32767)))
            energy += (rms * part.amplitude_v) ** 2 / 50 * part.n_samples / part.sample_rate_hz
    return energy / (end_s - start_s)


def _shot(lab: Any) -> tuple[float, float, float]:
    """Play two programs within 60 ms; start, end, and the time of upload and playing as a fraction."""
    lab.tweezers.settle()
    start_s, busy_s = lab.clock.now(), 0.0
    for _ in range(2):
        lab.clock.sleep(20e-3)
        begun_s = lab.clock.now()
        lab.play(lab.program(4))
        busy_s += lab.clock.now() - begun_s
    lab.clock.sleep(20e-3)
    return start_s, lab.clock.now(), busy_s / (lab.clock.now() - start_s)


class TestKeepWarm:
    @pytest.mark.parametrize("mode", ["sequence", "stream"])
    def test_holds_the_mean_power_over_a_shot(self, driver: Any, mode: str) -> None:
        with driver(mode) as lab:
            start_s, end_s, busy = _shot(lab)
            assert busy < 0.2
            silent = [_power_w(lab, channel, start_s, end_s) for channel in (0, 1)]
        with driver(mode, keep_warm=PARKED) as lab:
            n_tones = lab.motion.max_row_tones, lab.motion.max_column_tones
            assert _power_w(lab, 0, lab.clock.now() - 1e-3, lab.clock.now()) == 0
            start_s, end_s, busy = _shot(lab)
            for channel in (0, 1):
                held_w = 1.6**2 / 100 / n_tones[channel]
                assert _power_w(lab, channel, end_s - 10e-3, end_s) == pytest.approx(held_w, rel=0.01)
                share = _power_w(lab, channel, start_s, end_s) / held_w
                assert 1 - busy - 0.01 < share < 1.01
                assert silent[channel] / held_w < 0.2
            lab.tweezers.safe_state()
            assert _power_w(lab, 0, lab.clock.now(), lab.clock.now() + 1e-3) == 0
            assert lab.card.outputs_on == (False, False)
            lab.play(lab.program(1))
            assert lab.card.outputs_on == (True, True)

    @pytest.mark.parametrize(
        ("key", "hz", "says"),
        [
            ("row_frequency", 100e6, "is 100 MHz; the limit is 82 to 82.4 MHz or 117.6 to 118 MHz, within"),
            ("row_frequency", 83.2e6, "the AOD's band and off the atoms"),
            ("column_frequency", 81e6, "keep_warm.column_frequency is 81 MHz"),
            ("amplitude", 1.0, "mean power of the row axis' keep-warm tone"),
        ],
    )
    def test_on_the_atoms_outside_the_band_or_too_strong_is_refused(
        self, key: str, hz: float, says: str
    ) -> None:
        settings = SpcmSettings.model_validate(
            {"card": "simulated", "mode": "stream", "keep_warm": {**PARKED, key: hz}}
        )
        motion = MotionSpec(eject_slots=1, rf=RfSpec(max_mean_power_w=2.0))
        with pytest.raises(LimitError, match=re.escape(says)) as refused:
            SpcmMobileTweezers(settings, Context("mobile_tweezers", motion=motion))
        assert refused.value.setting == ("keep_warm", key)

    @pytest.mark.parametrize("mode", ["sequence", "stream"])
    @pytest.mark.parametrize("row_hz", [82.2e6, 84.8e6])
    def test_reaches_the_virtual_atoms_only_if_it_is_on_them(self, row_hz: float, mode: str) -> None:
        tones = KeepWarm((row_hz, 84.8e6), (0.3, 0.3))
        clock, grid = FakeClock(), Context().grid
        card = SimulatedCard(clock)
        with installed(card) as name:
            settings = SpcmSettings.model_validate({"card": name, "mode": mode, "sample_rate": RATE_HZ})
            tweezers = SpcmMobileTweezers(settings, Context("mobile_tweezers", clock=clock))
            tweezers._keep_warm = tones
            tweezers.open()
            tweezers.settle()
            clock.sleep(2e-3)
            reach = [reach_hz(hz, 0) for hz in (grid.row_frequency_hz, grid.column_frequency_hz)]
            (row,), _ = source = CardOutputs(card, 0).played(clock.now())
            assert isinstance(row, RfTones)
            assert row.frequency_hz == pytest.approx([row_hz], abs=8e3)
            assert row.amplitude_v == pytest.approx([0.3 * 1.6], rel=1e-3)
            lit = [active_spans(spans[0], limits) for spans, limits in zip(source, reach, strict=True)]
            assert [bool(spans) for spans in lit] == [row_hz > 84e6, True]
            clock.sleep(20e-6)  # less than a block of the stream, and than the idle segment
            later = CardOutputs(card, 0)
            later.played(clock.now() - 10e-6)
            assert all(isinstance(span, RfTones) for spans in later.played(clock.now()) for span in spans)
            tweezers.close()


class CreepingClock(FakeClock):
    """Some time passes with every look at it, as while samples are rendered."""

    creep_s = 0.0

    def now(self) -> float:
        self._now_s += self.creep_s
        return super().now()


@pytest.mark.parametrize("fill_s", [8e-3, 20e-3])
def test_card_and_ring_are_filled_about_as_far_ahead_as_the_profile_says(driver: Any, fill_s: float) -> None:
    with driver("fifo", fill=fill_s) as lab:
        lab.tweezers.prepare(lab.program(100))
        ahead_s = sum(lab.card.levels) / 4 / lab.rate_hz
        assert fill_s / 1.5 < ahead_s < 1.5 * fill_s


@pytest.mark.parametrize(("fill_s", "share"), [(1e-3, 0.7), (8e-3, 0.7), (20e-3, 0.2)])
def test_a_card_is_kept_supplied_when_that_takes_most_of_the_time(
    driver: Any, fill_s: float, share: float
) -> None:
    """Each chunk takes two looks at the clock: for room, and to hand it over."""
    clock = CreepingClock()
    with driver("fifo", clock=clock, fill=fill_s) as lab:
        program = lab.program(40)
        lab.tweezers.prepare(program)
        lab.tweezers.play()
        clock.creep_s = share * 2**18 / lab.rate_hz / 2
        lab.tweezers.wait(5.0)
        clock.creep_s = 0.0
        rendered = render(program, lab.rate_hz).samples
        assert np.array_equal(lab.samples(0)[: rendered.shape[1]], rendered[0])


def test_data_that_is_withheld_is_an_underrun_and_ends_in_the_safe_state(driver: Any) -> None:
    with driver("fifo", fill=1e-3) as lab:
        lab.tweezers.prepare(lab.program(60))
        lab.tweezers.play()
        lab.clock.sleep(0.1)  # nothing feeds the card
        with pytest.raises(TransientError, match="underrun"):
            lab.tweezers.wait(1.0)
        assert lab.card.outputs_on == (False, False)
        lab.card.forget(lab.clock.now())
        lab.clock.sleep(0.1)
        assert not lab.card.played(0), "what was cut short is not played on"
        program = lab.program(1)
        lab.play(program)
        rendered = render(program, lab.rate_hz).samples
        assert np.array_equal(lab.samples(0)[: rendered.shape[1]], rendered[0])


def test_a_card_that_something_else_stops_has_not_played_to_the_end(driver: Any) -> None:
    with driver("fifo", fill=1e-3) as lab:
        lab.tweezers.prepare(lab.program(60))
        lab.tweezers.play()
        lab.tweezers._card.stop()
        with pytest.raises(TransientError, match="underrun"):
            lab.tweezers.wait(1.0)
        assert lab.card.outputs_on == (False, False)


def test_a_slot_that_is_slower_than_the_output_is_an_underrun_also_at_the_end(
    driver: Any,
) -> None:
    slow = replace(M4I6631, bus_bytes_per_s=0.3e9)  # a third of what is played
    with driver("fifo", model=slow, fill=1e-3) as lab:
        lab.tweezers.prepare(lab.program(10))
        lab.tweezers.play()
        fifo = lab.card._machine.fifo
        with pytest.raises(TransientError, match=r"underrun: .* \(100% of the program was rendered"):
            lab.tweezers.wait(1.0)
        assert fifo.failed
        assert fifo.handed >= fifo.total, "all samples were handed over"
        assert lab.card.outputs_on == (False, False)


@pytest.mark.parametrize("row_channel", [0, 1])
def test_any_stretch_of_a_program_is_rendered_as_in_the_whole(row_channel: int) -> None:
    program = tone_program(Plan.from_batches([([(0, 0)], [(0, 3)]), ([(2, 1)], [(4, 1)])]))
    whole = render(program, 625e6).samples
    renderer = InterleavedRenderer(program, 625e6, row_channel)
    assert 0 <= renderer.n_samples - whole.shape[1] < 32
    wanted = np.zeros((renderer.n_samples + 2 * CHUNK, 2), np.int16)
    wanted[: whole.shape[1]] = whole.T if row_channel == 0 else whole[::-1].T
    for start, n_samples in [(0, len(wanted)), (0, 1), (12345, CHUNK), (CHUNK - 7, CHUNK + 100)]:
        out = np.full((n_samples, 2), 99, np.int16)
        renderer.write(start, out)
        assert np.array_equal(out, wanted[start : start + n_samples])


@pytest.mark.parametrize("mode", MODES)
def test_a_card_that_is_well_passes_and_stays_silent(driver: Any, mode: str) -> None:
    with driver(mode) as lab:
        assert overrides(lab.tweezers, Hardware.self_test)
        lab.tweezers.self_test()
        assert lab.card.outputs_on == (False, False)
        lab.tweezers.prepare(lab.program(1))
        lab.tweezers.self_test()
        assert not lab.card.running
        assert not lab.card.played(0)
        if mode == "sequence":
            assert not lab.card._machine.memory.segments[1].any()
        if mode == "replay":
            assert lab.card.memory.shape == (TEST_SAMPLES, 2)
            assert not lab.card.memory.any()
        with pytest.raises(DeviceError, match="without a prepared program"):
            lab.tweezers.play()
        lab.play(lab.program(1))


@pytest.mark.parametrize(
    ("place", "text"), [("temperature_c", "base card"), ("amplifier_c", "amplifier"), ("", "")]
)
def test_a_hot_card_is_reported(driver: Any, place: str, text: str) -> None:
    hottest = {"temperature_c": HOT_C, "amplifier_c": HOT_C}
    model = replace(M4I6631, **(hottest | ({place: HOT_C + 1} if place else {})))
    with driver(model=model) as lab:
        if not place:
            lab.tweezers.self_test()
            return
        with pytest.raises(DeviceError, match=f"{text} is at 81 degrees Celsius, above the limit of 80"):
            lab.tweezers.self_test()


def test_a_card_with_its_recovery_firmware_is_reported(driver: Any) -> None:
    with driver(model=replace(M4I6631, firmware_type=2)) as lab:
        assert lab.tweezers.versions()["driver"] == ("7.9.22000", "")
        with pytest.raises(DeviceError, match="recovery firmware"):
            lab.tweezers.self_test()


def test_a_clock_that_another_program_has_changed_is_reported(driver: Any) -> None:
    with driver() as lab:
        lab.card.write(20000, 100_000_000)
        with pytest.raises(DeviceError, match="100 MHz, but it was set to 250 MHz"):
            lab.tweezers.self_test()


def test_the_simulated_card_of_a_profile_keeps_only_the_last_program() -> None:
    clock = FakeClock()
    tweezers = SpcmMobileTweezers(SpcmSettings(card="simulated", mode="replay"), Context(clock=clock))
    tweezers.open()
    assert isinstance(tweezers.library, SimulatedLibrary)
    card = tweezers.library.card
    assert card is not None
    program = tone_program(Plan.from_batches([([(0, 0)], [(0, 3)])]))
    starts_s: list[float] = []
    for _ in range(3):
        tweezers.prepare(program)
        starts_s.append(clock.now())
        tweezers.play()
        tweezers.wait(1.0)
        assert [span.start_s > starts_s[-1] for span in card.played(0)] == [True]
    tweezers.close()
    assert tweezers.library.card is None


@pytest.mark.parametrize("mode", MODES)
def test_a_rate_that_is_slow_to_render_is_reported_before_a_run(mode: str) -> None:
    for rate_hz, n_warnings in ((624e6, 0), (625e6, 1)):
        settings = SpcmSettings.model_validate({"card": "simulated", "mode": mode, "sample_rate": rate_hz})
        warnings = SpcmMobileTweezers(settings, Context()).warnings()
        assert len(warnings) == n_warnings
        assert all("set sample_rate: 624 MHz" in text for text in warnings)
