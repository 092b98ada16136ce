"""The driver of the Spectrum card, on the real package ``spcm`` and a simulated card."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pytest
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings
from labseq_spcm.simulator import (
    M4I6631,
    CardModel,
    SampleSpan,
    SimulatedCard,
    Span,
    Tone,
    ToneSpan,
    installed,
)
from numpy.typing import NDArray

from labseq import (
    ConfigError,
    Context,
    DeviceError,
    DeviceTimeoutError,
    LimitError,
    MotionSpec,
    Plan,
    RfSpec,
    ToneProgram,
    TransientError,
)
from labseq.motion import tone_program
from labseq.motion.rendering import render
from labseq.testing import MobileTweezersContract
from labseq.testing.fakes import FakeClock

RATE_HZ = 250e6
DDS_MOTION = MotionSpec(max_row_tones=16, max_column_tones=5)


class TestReplayContract(MobileTweezersContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], SpcmMobileTweezers]:
        return partial(SpcmMobileTweezers, SpcmSettings(card="simulated"))


class TestFifoContract(MobileTweezersContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], SpcmMobileTweezers]:
        return partial(SpcmMobileTweezers, SpcmSettings(card="simulated", mode="fifo"))


class TestDdsContract(MobileTweezersContract):
    def context(self) -> Context:
        return replace(super().context(), motion=DDS_MOTION)

    @pytest.fixture
    def factory(self) -> Callable[[Context], SpcmMobileTweezers]:
        return partial(SpcmMobileTweezers, SpcmSettings(card="simulated", mode="dds"))


class CreepingClock(FakeClock):
    """Some time passes with every look at it, as while samples are rendered."""

    creep_s = 0.0

    def now(self) -> float:
        self._now_s += self.creep_s
        return super().now()


@dataclass
class Bench:
    tweezers: SpcmMobileTweezers
    card: SimulatedCard
    clock: FakeClock
    motion: MotionSpec

    def program(self, n_batches: int = 2) -> ToneProgram:
        batches: list[Any] = [
            ([(0, 0), (0, 3), (0, 7)], [(0, 2), (0, 6), (0, 8)]),
            ([(2, 1), (4, 1)], [(3, 1), (7, 1)]),
        ]
        plan = Plan.from_batches([batches[n % 2] for n in range(n_batches)])
        return tone_program(plan, motion=self.motion)

    def play(self, program: ToneProgram) -> None:
        duration_s = self.tweezers.prepare(program)
        self.tweezers.play()
        self.tweezers.wait(duration_s + 1.0)

    def samples(self, channel: int) -> NDArray[np.int16]:
        spans = self.card.played(channel)
        assert all(isinstance(span, SampleSpan) for span in spans)
        return np.concatenate([span.values() for span in spans if isinstance(span, SampleSpan)])

    def levels(self, register: int) -> list[float]:
        return [entry.value for entry in self.card.log if entry.register == register]


@contextmanager
def bench(
    mode: str = "replay",
    motion: MotionSpec | None = None,
    model: CardModel = M4I6631,
    clock: FakeClock | None = None,
    **settings: Any,
) -> Generator[Bench]:
    clock = clock or FakeClock()
    card = SimulatedCard(clock, model=model)
    motion = motion or (DDS_MOTION if mode == "dds" else MotionSpec())
    with installed(card) as name:
        chosen = SpcmSettings.model_validate({"card": name, "mode": mode, **settings})
        tweezers = SpcmMobileTweezers(chosen, Context("mobile_tweezers", clock=clock, motion=motion))
        tweezers.open()
        try:
            yield Bench(tweezers, card, clock, motion)
        finally:
            tweezers.close()


def context(motion: MotionSpec | None = None) -> Context:
    return Context("mobile_tweezers", clock=FakeClock(), motion=motion or MotionSpec())


class TestWhatIsPlayed:
    MODES: ClassVar = ["replay", "fifo"]

    @pytest.mark.parametrize("mode", MODES)
    def test_is_what_was_rendered_and_then_silence(self, mode: str) -> None:
        with bench(mode, sample_rate=RATE_HZ) as lab:
            program = lab.program(3)
            rendered = render(program, RATE_HZ).samples
            lab.play(program)
            for channel in (0, 1):
                played = lab.samples(channel)
                assert np.array_equal(played[: rendered.shape[1]], rendered[channel])
                assert not played[rendered.shape[1] :].any()
                assert len(played) - rendered.shape[1] < 32

    def test_is_streamed_beyond_what_card_and_ring_hold(self) -> None:
        with bench("fifo", sample_rate=RATE_HZ, fill=1e-3) as lab:
            program = lab.program(16)
            rendered = render(program, RATE_HZ).samples
            lab.tweezers.prepare(program)
            filled_s = lab.card._machine.fifo._handed / 4 / RATE_HZ  # type: ignore[union-attr]
            assert filled_s < 0.6 * program.total_duration_s
            lab.tweezers.play()
            lab.tweezers.wait(1.0)
            assert np.array_equal(lab.samples(0)[: rendered.shape[1]], rendered[0])
            assert np.array_equal(lab.samples(1)[: rendered.shape[1]], rendered[1])

    @pytest.mark.parametrize("mode", MODES)
    def test_comes_from_the_channel_that_the_profile_names(self, mode: str) -> None:
        with bench(mode, sample_rate=RATE_HZ, row_channel=1, column_channel=0) as lab:
            program = lab.program()
            rendered = render(program, RATE_HZ).samples
            lab.play(program)
            assert np.array_equal(lab.samples(1)[: rendered.shape[1]], rendered[0])
            assert np.array_equal(lab.samples(0)[: rendered.shape[1]], rendered[1])

    def test_is_rendered_for_the_rate_that_the_card_really_makes(self) -> None:
        with bench(sample_rate=RATE_HZ + 3) as lab:
            rate_hz = lab.tweezers.describe()["sample_rate_hz"]
            assert rate_hz == RATE_HZ
            program = lab.program()
            lab.play(program)
            rendered = render(program, rate_hz).samples
            assert np.array_equal(lab.samples(0)[: rendered.shape[1]], rendered[0])

    def test_has_the_amplitude_of_the_profile(self) -> None:
        with bench(motion=MotionSpec(rf=RfSpec(full_scale_v=0.2)), sample_rate=RATE_HZ) as lab:
            lab.play(lab.program())
            assert {span.amplitude_v for span in lab.card.played(0)} == {0.2}

    @pytest.mark.parametrize("mode", ["replay", "fifo", "dds"])
    def test_is_played_only_once(self, mode: str) -> None:
        with bench(mode) as lab:
            lab.play(lab.program())
            with pytest.raises(DeviceError, match="without a prepared program"):
                lab.tweezers.play()

    @pytest.mark.parametrize("mode", ["replay", "fifo", "dds"])
    def test_starts_at_the_external_trigger(self, mode: str) -> None:
        with bench(mode, trigger="external", sample_rate=RATE_HZ) as lab:
            duration_s = lab.tweezers.prepare(lab.program())
            assert not lab.card.trigger()  # too early: not armed yet
            lab.tweezers.play()
            lab.clock.sleep(2e-3)
            assert not lab.card.played(0)
            triggered_s = lab.clock.now()
            assert lab.card.trigger()
            lab.tweezers.wait(duration_s + 1e-3)
            assert lab.card.played(0)[0].start_s >= triggered_s


class TestDds:
    def test_tones_are_those_of_the_program(self) -> None:
        with bench("dds") as lab:
            program = lab.program(4)
            lab.play(program)
            start_s = _start_of_dds(lab)
            spans = [lab.card.played(channel) for channel in (0, 1)]
            for at_s in np.linspace(0, program.total_duration_s, 997)[1:-1]:
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

    @pytest.mark.parametrize("course", ["minimum_jerk", "constant_jerk"])
    def test_follows_other_courses_of_speed(self, course: Any) -> None:
        with bench("dds", motion=replace(DDS_MOTION, speed_profile=course)) as lab:
            program = lab.program(1)
            lab.play(program)
            start_s = _start_of_dds(lab)
            transport = int(np.flatnonzero(program.kind == 2)[0])
            spans = lab.card.played(1)
            first_s, last_s = program.joint_s[transport], program.joint_s[transport + 1]
            for at_s in np.linspace(first_s, last_s, 101)[1:-1]:
                wanted = np.sort(program.tones_at(at_s).column.frequency_hz)
                tones = np.sort([tone.frequency_hz for tone in _tones_at(spans, start_s + at_s)])
                assert np.abs(tones - wanted).max() < 0.05 * 1.6e6

    def test_is_silent_at_the_end(self) -> None:
        with bench("dds") as lab:
            program = lab.program()
            lab.play(program)
            ends = [span.end_s for channel in (0, 1) for span in lab.card.played(channel)]
            assert max(ends) <= _start_of_dds(lab) + program.total_duration_s + 1e-7
            assert not lab.card.running

    def test_a_program_larger_than_the_queue_is_fed_while_it_plays(self) -> None:
        with bench("dds") as lab:
            program = lab.program(100)
            lab.tweezers.prepare(program)
            assert lab.card.read(608006)[1] <= 4096
            lab.tweezers.play()
            lab.tweezers.wait(1.0)
            last = lab.card.played(0)[-1]
            assert last.end_s == pytest.approx(_start_of_dds(lab) + program.total_duration_s, abs=1e-7)

    def test_commands_that_come_too_late_are_an_error(self) -> None:
        with bench("dds") as lab:
            lab.tweezers.prepare(lab.program(100))
            lab.tweezers.play()
            lab.clock.sleep(0.5)
            with pytest.raises(TransientError, match="no commands in time"):
                lab.tweezers.wait(1.0)
            assert lab.card.outputs_on == (False, False)

    def test_a_jump_of_phase_in_the_program_is_played(self) -> None:
        with bench("dds") as lab:
            program = lab.program(1)
            phase_rad = program.row.phase_rad.copy()
            phase_rad[int(program.row.offsets[2]) :] += 1.0
            jumping = replace(program, row=replace(program.row, phase_rad=phase_rad))
            lab.play(jumping)
            at_s = program.joint_s[2] + 5e-6
            (tone,) = _tones_at(lab.card.played(0), _start_of_dds(lab) + at_s)
            wanted = jumping.tones_at(at_s).row.phase_rad[0]
            assert _apart(tone.phase_rad, wanted) < 0.05

    def test_a_ramp_of_no_length_is_a_step(self) -> None:
        with bench("dds", motion=replace(DDS_MOTION, pick_up_s=0.0)) as lab:
            lab.play(lab.program(1))
            assert lab.card.played(0)

    def test_a_segment_shorter_than_the_timer_is_refused(self) -> None:
        with (
            bench("dds", motion=replace(DDS_MOTION, pick_up_s=20e-9)) as lab,
            pytest.raises(LimitError, match=r"83\.2 ns"),
        ):
            lab.tweezers.prepare(lab.program(1))

    @pytest.mark.parametrize(("rows", "columns"), [(20, 20), (17, 2), (1, 6), (21, 1)])
    def test_profiles_with_more_tones_than_it_has_are_refused(self, rows: int, columns: int) -> None:
        settings = SpcmSettings(card="simulated", mode="dds")
        motion = MotionSpec(max_row_tones=rows, max_column_tones=columns)
        with pytest.raises(ConfigError, match=r"20 \+ 1 or 16 \+ 5"):
            SpcmMobileTweezers(settings, context(motion))

    @pytest.mark.parametrize(
        ("rows", "columns", "row_channel"), [(20, 1, 0), (16, 5, 0), (5, 16, 1), (1, 20, 1)]
    )
    def test_profiles_within_its_tones_are_taken(self, rows: int, columns: int, row_channel: int) -> None:
        motion = MotionSpec(max_row_tones=rows, max_column_tones=columns)
        with bench("dds", motion=motion, row_channel=row_channel, column_channel=1 - row_channel) as lab:
            plan = Plan.from_batches([([(0, 0)], [(0, 3)])])
            lab.play(tone_program(plan, motion=motion))
            assert lab.card.played(0)
            assert lab.card.played(1)

    def test_programs_with_more_tones_than_it_has_are_refused(self) -> None:
        with bench("dds") as lab:
            wide = [([(0, col) for col in range(6)], [(0, col + 1) for col in range(6)])]
            program = tone_program(Plan.from_batches(wide))
            with pytest.raises(LimitError, match="16 and 5"):
                lab.tweezers.prepare(program)


def _start_of_dds(lab: Bench) -> float:
    """When the program began: its first tones come after the pause of the first batch."""
    return lab.card.played(0)[0].start_s - lab.motion.overhead_per_batch_s


def _tones_at(spans: list[Span], at_s: float) -> list[Tone]:
    now = [span for span in spans if span.start_s <= at_s < span.end_s]
    return [tone.after(at_s - s.start_s) for s in now if isinstance(s, ToneSpan) for tone in s.tones]


def _apart(sine_rad: float, cosine_rad: float) -> float:
    """The distance of the card's phase, of a sine, from the program's, of a cosine."""
    return abs(math.remainder(sine_rad - np.pi / 2 - cosine_rad, 2 * np.pi))


class TestSafeState:
    @pytest.mark.parametrize("mode", ["replay", "fifo", "dds"])
    def test_ramps_down_stops_and_opens_the_output_relays(self, mode: str) -> None:
        with bench(mode) as lab:
            lab.tweezers.prepare(lab.program())
            lab.tweezers.play()
            lab.clock.sleep(0.6e-3)
            lab.card.log.clear()
            lab.tweezers.safe_state()
            levels = lab.levels(30010)
            ramp = levels[:-1]  # then the amplitude is set again, with the output off
            assert ramp == sorted(ramp, reverse=True)
            assert len(ramp) > 10
            assert min(ramp) == 481
            assert levels[-1] == 1600
            assert not lab.card.running
            assert lab.card.outputs_on == (False, False)

    def test_ramps_to_the_least_amplitude_where_no_relay_is_in_the_way(self) -> None:
        with bench(motion=MotionSpec(rf=RfSpec(full_scale_v=0.3))) as lab:
            lab.tweezers.prepare(lab.program())
            lab.tweezers.play()
            lab.tweezers.safe_state()
            assert min(lab.levels(30010)) == 80

    def test_twice_ramps_only_once(self) -> None:
        with bench() as lab:
            lab.tweezers.prepare(lab.program())
            lab.tweezers.play()
            lab.tweezers.safe_state()
            lab.card.log.clear()
            lab.tweezers.safe_state()
            assert set(lab.levels(30010)) == {1600}
            assert lab.card.outputs_on == (False, False)

    def test_works_when_an_error_locks_the_driver(self) -> None:
        with bench() as lab:
            lab.tweezers.prepare(lab.program())
            lab.tweezers.play()
            assert lab.card.write(30010, 9000) == 0x101  # somebody else's mistake
            lab.tweezers.safe_state()
            assert not lab.card.running
            assert lab.card.outputs_on == (False, False)

    def test_the_output_path_is_never_switched_while_the_outputs_are_on(self) -> None:
        with bench() as lab:
            lab.play(lab.program())
            lab.tweezers.prepare(lab.program())
            lab.tweezers.play()
            lab.tweezers.safe_state()
            assert not [value for value in lab.levels(30010) if value <= 480]

    def test_drops_what_was_prepared(self) -> None:
        with bench() as lab:
            lab.tweezers.prepare(lab.program())
            lab.tweezers.safe_state()
            with pytest.raises(DeviceError, match="without a prepared program"):
                lab.tweezers.play()

    @pytest.mark.parametrize("mode", ["replay", "fifo", "dds"])
    def test_nothing_of_the_old_program_is_played_after_it(self, mode: str) -> None:
        with bench(mode, sample_rate=RATE_HZ) as lab:
            lab.tweezers.prepare(lab.program(6))
            lab.tweezers.play()
            lab.clock.sleep(1e-3)
            lab.tweezers.safe_state()
            lab.card.forget(lab.clock.now() + 1.0)
            lab.clock.sleep(0.1)
            program = lab.program(1)
            lab.play(program)
            spans = lab.card.played(0)
            assert spans[-1].end_s - spans[0].start_s <= program.total_duration_s + 1e-6


class TestBadInput:
    @pytest.mark.parametrize("mode", ["replay", "fifo", "dds"])
    def test_a_trigger_that_never_comes_times_out_into_the_safe_state(self, mode: str) -> None:
        with bench(mode, trigger="external") as lab:
            lab.tweezers.prepare(lab.program())
            lab.tweezers.play()
            with pytest.raises(DeviceTimeoutError, match="no trigger came"):
                lab.tweezers.wait(50e-3)
            assert not lab.card.running
            assert lab.card.outputs_on == (False, False)
            lab.tweezers.prepare(lab.program())

    def test_an_underrun_is_an_error_and_ends_in_the_safe_state(self) -> None:
        with bench("fifo", sample_rate=RATE_HZ, fill=1e-3) as lab:
            lab.tweezers.prepare(lab.program(16))
            lab.tweezers.play()
            lab.clock.sleep(0.1)  # nobody feeds the card
            with pytest.raises(TransientError, match="underrun"):
                lab.tweezers.wait(1.0)
            assert lab.card.outputs_on == (False, False)
            lab.play(lab.program(1))

    @pytest.mark.parametrize("creep_s", [30e-6, 100e-6, 300e-6, 1e-3, 3e-3, 10e-3])
    def test_an_underrun_in_the_middle_of_feeding_is_an_underrun(self, creep_s: float) -> None:
        clock = CreepingClock()
        with bench("fifo", clock=clock, sample_rate=RATE_HZ, fill=1e-3) as lab:
            lab.tweezers.prepare(lab.program(16))
            lab.tweezers.play()
            clock.creep_s = creep_s
            try:
                lab.tweezers.wait(5.0)
            except TransientError as error:
                assert "underrun" in str(error)
                clock.creep_s = 0.0
                assert lab.card.outputs_on == (False, False)
            else:
                assert creep_s < 0.5e-3

    def test_an_unknown_card_is_named_with_the_drivers_reason(self) -> None:
        with bench():  # so that there is a driver library
            tweezers = SpcmMobileTweezers(SpcmSettings(card="simulated-none"), context())
            with pytest.raises(DeviceError, match=r"'simulated-none': .*no such card"):
                tweezers.open()

    def test_a_card_in_use_is_named(self) -> None:
        with bench() as lab:
            other = SpcmMobileTweezers(lab.tweezers._settings, context())
            with pytest.raises(DeviceError, match="in use"):
                other.open()
            lab.play(lab.program())

    def test_a_card_of_another_family_is_refused(self) -> None:
        digitizer = replace(M4I6631, name="M4i.4420-x8", card_type=0x74420)
        with (
            pytest.raises(DeviceError, match=r"is a M4i\.4420-x8 .* expected a Spectrum M4i\.66xx"),
            bench(model=digitizer),
        ):
            pass

    def test_a_card_with_another_serial_number_is_refused(self) -> None:
        with pytest.raises(DeviceError, match="serial number 12345; expected 99"), bench(serial=99):
            pass

    def test_a_program_longer_than_the_memory_is_refused(self) -> None:
        small = replace(M4I6631, memory_samples=2 * 2**16)
        with bench(model=small) as lab, pytest.raises(LimitError, match="memory"):
            lab.tweezers.prepare(lab.program())

    @pytest.mark.parametrize("rate_hz", [751e6, 1.13e9])
    def test_sample_rates_in_the_gaps_of_the_clock_are_refused(self, rate_hz: float) -> None:
        with pytest.raises(ValueError, match="gap"):
            SpcmSettings(sample_rate=rate_hz)

    @pytest.mark.parametrize("rate_hz", [49e6, 1.26e9])
    def test_sample_rates_beyond_the_clock_are_refused(self, rate_hz: float) -> None:
        with pytest.raises(ValueError, match=r"expected 50 MHz to 1\.25 GHz"):
            SpcmSettings(sample_rate=rate_hz)

    def test_rates_that_the_bus_cannot_carry_are_refused_for_fifo(self) -> None:
        with pytest.raises(ValueError, match="bus"):
            SpcmSettings(mode="fifo", sample_rate=1.25e9)

    def test_both_axes_on_one_output_are_refused(self) -> None:
        with pytest.raises(ValueError, match="both 0"):
            SpcmSettings(column_channel=0)

    @pytest.mark.parametrize(
        ("full_scale_v", "max_peak_v", "text"),
        [(2.1, 3.0, "2000 mV"), (0.05, 2.0, "80 mV"), (0.45, 2.0, "relay"), (1.0, 0.5, "max_peak")],
    )
    def test_amplitudes_that_card_or_amplifiers_cannot_do_are_refused(
        self, full_scale_v: float, max_peak_v: float, text: str
    ) -> None:
        motion = MotionSpec(rf=RfSpec(full_scale_v=full_scale_v, max_peak_v=max_peak_v))
        with pytest.raises(LimitError, match=text):
            SpcmMobileTweezers(SpcmSettings(card="simulated"), context(motion))

    @pytest.mark.parametrize("mode", ["replay", "fifo", "dds"])
    def test_programs_out_of_the_band_or_without_length_are_refused(self, mode: str) -> None:
        with bench(mode) as lab:
            program = lab.program()
            low = replace(program, row=replace(program.row, start_hz=program.row.start_hz - 50e6))
            with pytest.raises(LimitError, match="frequency of a row tone in batch 0"):
                lab.tweezers.prepare(low)
            endless = replace(program, duration_s=program.duration_s * np.inf)
            with pytest.raises(LimitError, match="duration"):
                lab.tweezers.prepare(endless)
            silent = replace(program, duration_s=program.duration_s * 0.0)
            with pytest.raises(LimitError, match="length"):
                lab.tweezers.prepare(silent)
            nowhere = replace(program, row=replace(program.row, phase_rad=program.row.phase_rad * np.nan))
            with pytest.raises(LimitError, match="phase"):
                lab.tweezers.prepare(nowhere)
            assert not lab.card.running
