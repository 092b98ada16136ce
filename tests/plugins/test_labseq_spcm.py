"""The driver of the Spectrum card, on the real package spcm and a simulated card: what is played."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from labseq_spcm.keep_warm import KeepWarm
from labseq_spcm.mobile_tweezers import HOT_C, TEST_SAMPLES, SpcmMobileTweezers
from labseq_spcm.replay_fifo import CHUNK, InterleavedRenderer
from labseq_spcm.settings import SpcmSettings
from labseq_spcm_sim import (
    M4I6631,
    SimulatedCard,
    SimulatedLibrary,
    Span,
    Tone,
    ToneSpan,
    installed,
    registers,
)
from labseq_spcm_sim.fifo_kernels import HANDED, TOTAL
from labseq_spcm_sim.library import CardOutputs
from labseq_virtual.rf_analysis import active_spans, reach_hz

from labseq.motion import render, tone_program
from labseq.plugin import (
    ConfigError,
    Context,
    DeviceError,
    DeviceTimeoutError,
    LimitError,
    MotionSpec,
    Plan,
    SiteGrid,
    TransientError,
)
from labseq.plugin.motion import RfSpec
from labseq.plugin.simulation import RfTones
from labseq.roles import Hardware, overrides
from labseq.testing import MobileTweezersContract
from labseq.testing.fakes import FakeClock

from .conftest import RATE_HZ

MODES = ["replay", "fifo", "stream", "dds"]
TRIGGERED = ["replay", "fifo", "dds"]


class TestReplayContract(MobileTweezersContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], SpcmMobileTweezers]:
        return partial(SpcmMobileTweezers, SpcmSettings(card="simulated"))


class TestFifoContract(MobileTweezersContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], SpcmMobileTweezers]:
        return partial(SpcmMobileTweezers, SpcmSettings(card="simulated", mode="fifo"))


class TestStreamContract(MobileTweezersContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], SpcmMobileTweezers]:
        return partial(SpcmMobileTweezers, SpcmSettings(card="simulated", mode="stream"))


class TestDdsContract(MobileTweezersContract):
    def context(self) -> Context:
        motion = MotionSpec(max_row_tones=16, max_column_tones=5)
        return replace(super().context(), motion=motion)

    @pytest.fixture
    def factory(self) -> Callable[[Context], SpcmMobileTweezers]:
        return partial(SpcmMobileTweezers, SpcmSettings(card="simulated", mode="dds"))


class TestSamples:
    @pytest.mark.parametrize(("mode", "row_channel"), [("replay", 0), ("fifo", 1)])
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
            assert 0.1e-6 < delay_s < (500e-6 if mode == "stream" else 10e-6)
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
            begun_s = _start_s(lab) if mode == "dds" else lab.card.played(0)[0].start_s
            delay_s = float(lab.tweezers.describe()["trigger_delay_s"])
            assert begun_s - triggered_s == pytest.approx(delay_s, abs=1e-9)


@pytest.mark.parametrize("mode", MODES)
def test_the_relays_close_once_and_settle_before_a_program(driver: Any, mode: str) -> None:
    with driver(mode) as lab:
        closed_s = lab.clock.now()
        lab.tweezers.settle()
        settled_s = lab.clock.now()
        assert settled_s - closed_s == M4I6631.output_relay_s
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


MOTION = MotionSpec(max_row_tones=16, max_column_tones=5)
DDS_CMD, EXEC_AT_TRG, WRITE_TO_CARD = 608003, 2, 8


PARKED = {"row_frequency": 82.2e6, "column_frequency": 117.9e6}


def _power_w(lab: Any, channel: int, start_s: float, end_s: float) -> float:
    """Mean power into 50 Ohm of what an output played within a time."""
    energy = 0.0
    for span in lab.card.played(channel):
        part = span.between(start_s, end_s) if span.start_s < end_s and span.end_s > start_s else None
        if isinstance(part, ToneSpan):
            length_s = part.end_s - part.start_s
            for tone in part.tones:
                first, last = tone.amplitude, tone.after(length_s).amplitude
                energy += (first**2 + first * last + last**2) / 3 * part.amplitude_v**2 * length_s / 100
        elif part is not None and part.n_samples:
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
    @pytest.mark.parametrize("mode", MODES)
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

    def test_with_the_dds_lasts_until_the_trigger_and_follows_the_program_at_once(self, driver: Any) -> None:
        motion = MotionSpec(max_row_tones=16, max_column_tones=5, overhead_per_batch_s=0.0)
        with driver("dds", motion=motion, keep_warm=PARKED, trigger="external") as lab:
            for n in range(3):
                duration_s = lab.tweezers.prepare(lab.program(2))
                if n == 1:  # prepared again without being played
                    lab.tweezers.prepare(lab.program(2))
                assert not lab.card.trigger(), "not armed yet"
                lab.tweezers.play()
                lab.clock.sleep(1e-3)
                assert lab.card.trigger()
                lab.tweezers.wait(duration_s + 1e-3)
            lab.clock.sleep(1e-3)
            spans = [span for span in lab.card.played(0) if isinstance(span, ToneSpan)]
            parked = [[tone.frequency_hz for tone in span.tones] == [pytest.approx(82.2e6)] for span in spans]
            assert parked[0]
            assert parked[-1]
            dark = [after.start_s - before.end_s for before, after in pairwise(spans)]
            assert max(dark) < 200e-6
            assert sum(gap_s > 1e-9 for gap_s in dark) == 1, "only where a prepared program was dropped"

    def test_of_which_the_trigger_never_comes_says_so(self, driver: Any) -> None:
        with driver("dds", keep_warm=PARKED, trigger="external") as lab:
            lab.tweezers.prepare(lab.program(1))
            lab.tweezers.play()
            with pytest.raises(DeviceTimeoutError, match="no trigger came within"):
                lab.tweezers.wait(10e-3)
            assert lab.card.outputs_on == (False, False)

    @pytest.mark.parametrize(
        ("key", "hz", "says"),
        [
            ("row_frequency", 100e6, "is 100 MHz; the limit is 82 to 82.4 MHz or 117.6 to 118 MHz: within"),
            ("row_frequency", 83.2e6, "the AOD's band and off the atoms"),
            ("column_frequency", 81e6, "keep_warm.column_frequency is 81 MHz"),
            ("amplitude", 1.0, "mean power of the row axis' keep-warm tone"),
        ],
    )
    def test_on_the_atoms_outside_the_band_or_too_strong_is_refused(
        self, key: str, hz: float, says: str
    ) -> None:
        settings = SpcmSettings.model_validate({"card": "simulated", "keep_warm": {**PARKED, key: hz}})
        motion = MotionSpec(eject_slots=1, rf=RfSpec(max_mean_power_w=2.0))
        with pytest.raises(LimitError, match=re.escape(says)) as refused:
            SpcmMobileTweezers(settings, Context("mobile_tweezers", motion=motion))
        assert refused.value.setting == ("keep_warm", key)

    @pytest.mark.parametrize("row_hz", [82.2e6, 84.8e6])
    def test_reaches_the_virtual_atoms_only_if_it_is_on_them(self, row_hz: float) -> None:
        tones = KeepWarm((row_hz, 84.8e6), (0.3, 0.3))
        clock, grid = FakeClock(), Context().grid
        card = SimulatedCard(clock)
        with installed(card) as name:
            settings = SpcmSettings(card=name, sample_rate=RATE_HZ)
            tweezers = SpcmMobileTweezers(settings, Context("mobile_tweezers", clock=clock))
            tweezers._keep_warm = tones
            tweezers.open()
            tweezers.settle()
            clock.sleep(2e-3)
            reach = [reach_hz(hz, 0) for hz in (grid.row_frequency_hz, grid.column_frequency_hz)]
            (row,), _ = source = CardOutputs(card, 0).played(clock.now())
            assert isinstance(row, RfTones)
            assert row.frequency_hz == pytest.approx([row_hz], abs=2e3)
            assert row.amplitude_v == pytest.approx([0.3 * 1.6], rel=1e-3)
            lit = [active_spans(spans[0], limits) for spans, limits in zip(source, reach, strict=True)]
            assert [bool(spans) for spans in lit] == [row_hz > 84e6, True]
            clock.sleep(20e-6)  # less than a period of the loop
            later = CardOutputs(card, 0)
            later.played(clock.now() - 10e-6)
            assert all(isinstance(span, RfTones) for spans in later.played(clock.now()) for span in spans)
            tweezers.close()


def _start_s(lab: Any) -> float:
    """When the program began: its first tones come after the pause of the first batch."""
    return lab.card.played(0)[0].start_s - lab.motion.overhead_per_batch_s


def _tones_at(spans: list[Span], at_s: float) -> list[Tone]:
    now = [span for span in spans if span.start_s <= at_s < span.end_s]
    return [tone.after(at_s - s.start_s) for s in now if isinstance(s, ToneSpan) for tone in s.tones]


def _apart(sine_rad: float, cosine_rad: float) -> float:
    """The distance of the card's phase, of a sine, from the program's, of a cosine."""
    return abs(math.remainder(sine_rad - np.pi / 2 - cosine_rad, 2 * np.pi))


class TestTones:
    def test_are_those_of_the_program(self, driver: Any) -> None:
        with driver("dds") as lab:
            program = lab.program(2)
            lab.play(program)
            start_s = _start_s(lab)
            spans = [lab.card.played(channel) for channel in (0, 1)]
            for at_s in np.linspace(0, program.total_duration_s, 199)[1:-1]:
                if np.abs(program.joint_s - at_s).min() < 1e-6:
                    continue
                now = program.tones_at(at_s)
                axes = (program.row, now.row), (program.column, now.column)
                for channel, (axis, wanted) in enumerate(axes):
                    most = axis.start_amplitude.max()
                    tones = _tones_at(spans[channel], start_s + at_s)
                    for hz, amplitude, phase_rad in zip(
                        wanted.frequency_hz, wanted.amplitude, wanted.phase_rad, strict=True
                    ):
                        tone = min(tones, key=lambda tone: abs(tone.frequency_hz - hz))
                        assert abs(tone.frequency_hz - hz) < 5
                        assert abs(tone.amplitude**2 - amplitude**2) < 0.006 * most**2
                        assert _apart(tone.phase_rad, phase_rad) < 0.01

    @pytest.mark.parametrize("n_sites", [1, 14])
    @pytest.mark.parametrize("course", ["minimum_jerk", "constant_jerk"])
    def test_follow_other_courses_of_speed_within_20_nm(self, driver: Any, course: Any, n_sites: int) -> None:
        motion = replace(MOTION, speed_profile=course)
        plan = Plan.from_batches([([(0, col) for col in range(5)], [(0, col + n_sites) for col in range(5)])])
        with driver("dds", motion=motion) as lab:
            program = tone_program(plan, SiteGrid(), motion)
            lab.play(program)
            start_s = _start_s(lab)
            transport = int(np.flatnonzero(program.kind == 2)[0])
            spans = lab.card.played(1)
            first_s, last_s = program.joint_s[transport], program.joint_s[transport + 1]
            for at_s in np.linspace(first_s, last_s, 1001)[1:-1]:
                wanted = np.sort(program.tones_at(at_s).column.frequency_hz)
                tones = np.sort([tone.frequency_hz for tone in _tones_at(spans, start_s + at_s)])
                off_m = np.abs(tones - wanted).max() / 1.6e6 * SiteGrid().spacing_m
                assert off_m < 20.5e-9

    def test_that_cannot_follow_a_course_are_warned_of(self, driver: Any) -> None:
        few = replace(MOTION, speed_profile="minimum_jerk", max_row_tones=7)
        with driver("dds", motion=few) as lab:
            assert not lab.tweezers.warnings()
        with driver("dds", motion=replace(few, max_row_tones=16)) as lab:
            (text,) = lab.tweezers.warnings()
        assert all(fact in text for fact in ("16 row and 5 column tones", "66.1 nm", "20 nm"))

    def test_of_a_program_larger_than_the_queue_are_sent_while_it_plays(self, driver: Any) -> None:
        with driver("dds") as lab:
            program = lab.program(50)
            n_sent = []
            for call in (partial(lab.tweezers.prepare, program), lab.tweezers.play):
                call()
                n_sent.append(sum(603000 <= entry.register < DDS_CMD for entry in lab.card.log))
            assert 500 < n_sent[0] <= 1000 < 3000 < n_sent[1] <= 4096 + 1000
            lab.tweezers.wait(1.0)
            assert not lab.card.running
            last = lab.card.played(0)[-1]
            assert last.end_s == pytest.approx(_start_s(lab) + program.total_duration_s, abs=1e-7)
            commands = [(entry.register, entry.value) for entry in lab.card.log if entry.register >= 603000]
            sent = [i for i, command in enumerate(commands) if command == (DDS_CMD, WRITE_TO_CARD)]
            assert len(sent) > 5
            assert all(commands[i - 1] == (DDS_CMD, EXEC_AT_TRG) for i in sent), "only whole blocks are sent"

    @pytest.mark.parametrize("keep_warm", [None, {"row_frequency": 82.2e6, "column_frequency": 117.9e6}])
    def test_of_the_rest_of_a_program_follow_those_of_its_beginning(
        self, driver: Any, keep_warm: Any
    ) -> None:
        with driver("dds", keep_warm=keep_warm) as lab:
            parts, begun = (lab.program(4), lab.program(20)), list[float]()
            for _ in range(2):
                lab.clock.sleep(1e-3)
                lab.tweezers.prepare_beginning(parts[0])
                begun.append(lab.clock.now() + float(lab.tweezers.describe()["trigger_delay_s"]))
                lab.tweezers.play()
                lab.tweezers.append(parts[1])
                lab.tweezers.wait(1.0)
            played = lab.card.played(1)
            for start_s in begun:
                joint_s = start_s + parts[0].total_duration_s + 166.4e-9  # the cores are silenced in between
                for part, at_s in zip(parts, (start_s, joint_s), strict=True):
                    for u in np.linspace(0.013, 0.987, 50):
                        now = part.tones_at(u * part.total_duration_s).column
                        wanted = np.sort(now.frequency_hz[now.amplitude > 0.0])
                        tones = _tones_at(played, at_s + u * part.total_duration_s)
                        loud = np.sort([tone.frequency_hz for tone in tones if tone.amplitude > 0.0])
                        assert loud == pytest.approx(wanted, abs=2e4)

    def test_of_the_rest_that_come_too_late_are_an_error(self, driver: Any) -> None:
        with driver("dds") as lab:
            lab.tweezers.prepare_beginning(lab.program(2))
            lab.tweezers.play()
            lab.clock.sleep(10e-3)
            lab.tweezers.append(lab.program(20))
            with pytest.raises(TransientError, match="no commands in time"):
                lab.tweezers.wait(1.0)
            assert lab.card.outputs_on == (False, False)

    def test_jump_in_phase_where_the_program_does(self, driver: Any) -> None:
        with driver("dds") as lab:
            program = lab.program(1)
            phase_rad = program.row.phase_rad.copy()
            phase_rad[int(program.row.offsets[2]) :] += 1.0
            jumping = replace(program, row=replace(program.row, phase_rad=phase_rad))
            lab.play(jumping)
            at_s = program.joint_s[2] + 5e-6
            (tone,) = _tones_at(lab.card.played(0), _start_s(lab) + at_s)
            wanted = jumping.tones_at(at_s).row.phase_rad[0]
            assert _apart(tone.phase_rad, wanted) < 0.05

    def test_for_less_time_than_the_timer_can_do_are_refused(self, driver: Any) -> None:
        with (
            driver("dds", motion=replace(MOTION, pick_up_s=20e-9)) as lab,
            pytest.raises(LimitError, match=r"83\.2 ns"),
        ):
            lab.tweezers.prepare(lab.program(1))


class TestNumberOfTones:
    @pytest.mark.parametrize(("rows", "columns"), [(17, 2), (1, 6), (21, 1)])
    def test_profiles_with_more_tones_than_it_has_are_refused(
        self, driver: Any, rows: int, columns: int
    ) -> None:
        settings = SpcmSettings(card="simulated", mode="dds")
        motion = MotionSpec(max_row_tones=rows, max_column_tones=columns)
        with pytest.raises(ConfigError, match=r"20 \+ 1 or 16 \+ 5"):
            SpcmMobileTweezers(settings, Context(motion=motion))

    def test_of_programs_are_refused_beyond_those_it_has(self, driver: Any) -> None:
        with driver("dds") as lab:
            wide = [([(0, col) for col in range(6)], [(0, col + 1) for col in range(6)])]
            program = tone_program(Plan.from_batches(wide))
            with pytest.raises(LimitError, match="16 and 5"):
                lab.tweezers.prepare(program)


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
    slow = replace(M4I6631, bus_bytes_per_s=0.5e9)  # half of what is played
    with driver("fifo", model=slow, fill=1e-3) as lab:
        lab.tweezers.prepare(lab.program(6))
        lab.tweezers.play()
        fifo = lab.card._machine.fifo
        with pytest.raises(TransientError, match=r"underrun: .* \(100% of the program was rendered"):
            lab.tweezers.wait(1.0)
        assert fifo.failed
        words = lab.card._machine.words
        assert words[HANDED] >= words.view(np.float64)[TOTAL], "all samples were handed over"
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
        if mode == "replay":
            assert lab.card.memory.shape == (TEST_SAMPLES, 2)
            assert not lab.card.memory.any()
        with pytest.raises(DeviceError, match="without a prepared program"):
            lab.tweezers.play()
        lab.play(lab.program(1))


@pytest.mark.parametrize(("above_c", "well"), [(0, True), (1, False)])
def test_a_hot_card_is_reported(driver: Any, above_c: int, well: bool) -> None:
    with driver(model=replace(M4I6631, temperature_c=HOT_C + above_c)) as lab:
        if well:
            lab.tweezers.self_test()
            return
        with pytest.raises(DeviceError, match="81 degrees Celsius; expected at most 80"):
            lab.tweezers.self_test()


def test_a_card_with_its_recovery_firmware_is_reported(driver: Any) -> None:
    with driver(model=replace(M4I6631, firmware_type=2)) as lab:
        assert lab.tweezers.versions()["driver"] == ("7.9.22000", "")
        with pytest.raises(DeviceError, match="recovery firmware"):
            lab.tweezers.self_test()


def test_a_clock_that_another_program_has_changed_is_reported(driver: Any) -> None:
    with driver() as lab:
        lab.card.write(20000, 100_000_000)
        with pytest.raises(DeviceError, match="100 MHz; expected 250 MHz"):
            lab.tweezers.self_test()


def test_the_simulated_card_of_a_profile_keeps_only_the_last_program() -> None:
    clock = FakeClock()
    tweezers = SpcmMobileTweezers(SpcmSettings(card="simulated"), Context(clock=clock))
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
