"""The driver of the Spectrum card in the mode ``sequence``, and the sequence mode of the simulated card."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_spcm.card import Buffer as DriverBuffer
from labseq_spcm.play_sequence import SILENT_SAMPLES
from labseq_spcm.replay_fifo import CHUNK
from labseq_spcm_sim import M4I6631, SimulatedCard, registers as r
from labseq_spcm_sim.modes import Buffer
from labseq_spcm_sim.setup import OUTPUT_FIFO_BYTES
from numpy.typing import NDArray

from labseq.motion.rendering import render
from labseq.plugin import DeviceError, LimitError, ToneProgram, TransientError
from labseq.testing.fakes import FakeClock

from .conftest import Lab, open_driver

Samples = NDArray[np.int16]
FIFO_SAMPLES = OUTPUT_FIFO_BYTES // 2 // 4


def rendered(lab: Lab, *programs: ToneProgram) -> Samples:
    """The samples of programs one after the other, each to a multiple of 32, int16 (2, n)."""
    samples = [render(program, lab.rate_hz).samples for program in programs]
    return np.concatenate([np.pad(one, ((0, 0), (0, -one.shape[1] % 32))) for one in samples], axis=1)


def pauses(lab: Lab, expected: Samples) -> list[tuple[int, int]]:
    """Where the card waited: the sample of the program before which it did, and for how many samples.

    Everything else that it played is what was expected, on both channels.
    """
    played = np.stack([lab.samples(channel) for channel in (0, 1)])
    found: list[tuple[int, int]] = []
    done = at = 0
    while done < expected.shape[1]:
        n = min(expected.shape[1] - done, played.shape[1] - at)
        differs = (played[:, at : at + n] != expected[:, done : done + n]).any(axis=0)
        same = int(differs.argmax()) if differs.any() else n
        done, at = done + same, at + same
        if same == n:
            assert not expected[:, done:].any()
            break
        done, at = done - done % 32, at - done % 32  # parts begin at multiples of 32 samples
        silent = int(played[:, at:].any(axis=0).argmax())
        assert silent > 0, "neither the program nor silence"
        lead = int(expected[:, done:].any(axis=0).argmax())
        found.append((done, silent - lead))
        at += silent - lead
    return found


def begin(lab: Lab, program: ToneProgram) -> None:
    """Play the beginning of a program."""
    lab.tweezers.settle()
    lab.tweezers.prepare_beginning(program)
    lab.card.forget(lab.clock.now())
    lab.tweezers.play()


class TestPrograms:
    def test_of_many_parts_are_played_without_a_gap_one_after_the_other(self, driver: Any) -> None:
        slow = replace(M4I6631, bus_bytes_per_s=0.3e9)  # a third of what is played: all is there before
        with driver("sequence", model=slow) as lab:
            for n_batches in (50, 2, 20):
                program = lab.program(n_batches)
                lab.play(program)
                assert pauses(lab, rendered(lab, program)) == []
                lab.card.forget(lab.clock.now())
            assert lab.tweezers._mode._n_parts > 1
            assert lab.card.running, "it loops the idle segment"
            assert lab.tweezers.describe()["delayed_batches"] == 0

    def test_begin_as_late_as_the_description_says_or_earlier_by_the_idle_segment(self, driver: Any) -> None:
        with driver("sequence") as lab:
            for wait_s in np.linspace(0, 5e-6, 7):
                lab.tweezers.prepare(lab.program(1))
                lab.card.forget(lab.clock.now())
                lab.clock.sleep(wait_s)
                played_s = lab.clock.now()
                lab.tweezers.play()
                lab.tweezers.wait(1.0)
                late_s = lab.card.played(0)[0].start_s - played_s
                assert -1e-9 <= lab.tweezers.start_delay_s - late_s < SILENT_SAMPLES / lab.rate_hz

    def test_follow_a_safe_state_in_the_middle_of_another(self, driver: Any) -> None:
        with driver("sequence") as lab:
            for _ in range(3):
                lab.tweezers.prepare(lab.program(30))
                lab.tweezers.play()
                lab.clock.sleep(1e-3)
                lab.tweezers.safe_state()
                lab.card.forget(lab.clock.now() + 1.0)
                program = lab.program(3)
                lab.play(program)
                assert pauses(lab, rendered(lab, program)) == []

    def test_longer_than_the_memory_are_refused_before_anything_plays(self, driver: Any) -> None:
        small = replace(M4I6631, memory_samples=2 * 2**16)
        text = r"\(the card's memory\); use `mode: fifo`"
        with driver("sequence", model=small) as lab, pytest.raises(LimitError, match=text):
            lab.tweezers.prepare(lab.program(4))

    def test_use_small_memories_to_the_last_segment(self, driver: Any) -> None:
        small = replace(M4I6631, memory_samples=2 * 2**23)  # 8 segments of 2^20 samples
        with driver("sequence", model=small) as lab:
            program = lab.program(1)
            n_batches = int(7 * 2**20 / lab.rate_hz / program.total_duration_s) - 1
            program = lab.program(n_batches)
            lab.play(program)
            assert pauses(lab, rendered(lab, program)) == []
            assert lab.tweezers._mode._n_parts == 7


class TestAppending:
    @settings(max_examples=40, deadline=None)
    @given(st.floats(-150e-6, 150e-6), st.sampled_from([0.0, 1e-6, 20e-6]))
    def test_at_any_time_about_the_end_of_what_plays_loses_and_repeats_nothing(
        self, early_s: float, between_writes_s: float
    ) -> None:
        """The card goes from step to step while the driver writes them."""
        with open_driver("sequence") as lab:
            parts = lab.program(2), lab.program(30)
            begin(lab, parts[0])
            write = lab.card.write

            def slow_write(register: int, value: float) -> int:
                lab.clock.sleep(between_writes_s)
                return write(register, value)

            lab.card.write = slow_write  # type: ignore[method-assign]
            upload_s = 4 * CHUNK / M4I6631.bus_bytes_per_s
            lab.clock.sleep(max(0.0, parts[0].total_duration_s - upload_s + early_s))
            lab.tweezers.append(parts[1])
            lab.tweezers.wait(1.0)
            assert all(start % 32 == 0 for start, _ in pauses(lab, rendered(lab, *parts)))

    def test_in_time_leaves_no_gap_and_late_a_pause_while_no_tone_is_on(self, driver: Any) -> None:
        for bus_bytes_per_s, late_s, is_late in (
            (2.8e9, 0.0, False),
            (2.8e9, 3e-3, True),
            (0.4e9, 0.0, True),
        ):
            model = replace(M4I6631, bus_bytes_per_s=bus_bytes_per_s)
            with driver("sequence", model=model) as lab:
                parts = lab.program(5), lab.program(30)
                begin(lab, parts[0])
                lab.clock.sleep(late_s)
                lab.tweezers.append(parts[1])
                lab.tweezers.wait(1.0)
                found = pauses(lab, rendered(lab, *parts))
                assert bool(found) == is_late
                assert lab.tweezers.describe()["delayed_batches"] == len(found)
                ends = np.cumsum(np.concatenate([part.duration_s for part in parts])) * lab.rate_hz
                for start, _ in found:
                    assert np.abs(ends - start).min() < 64, "between two batches"
                lab.card.forget(lab.clock.now())
                program = lab.program(3)
                lab.play(program)
                assert pauses(lab, rendered(lab, program)) == []

    def test_after_another_thread_has_made_the_card_safe_is_an_error(
        self, driver: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        with driver("sequence") as lab:
            begin(lab, lab.program(5))
            finish = lab.tweezers._card.finish_upload

            def made_safe(*arguments: Any) -> None:
                lab.tweezers.safe_state()
                finish(*arguments)

            monkeypatch.setattr(lab.tweezers._card, "finish_upload", made_safe)
            with pytest.raises(DeviceError, match=r"stopped by safe_state\(\) while a program was uploaded"):
                lab.tweezers.append(lab.program(30))
            assert (lab.card.running, lab.card.outputs_on) == (False, (False, False))


def test_a_card_that_something_else_stops_has_not_played_to_the_end(driver: Any) -> None:
    with driver("sequence") as lab:
        lab.tweezers.prepare(lab.program(20))
        lab.tweezers.play()
        lab.tweezers._card.stop()
        with pytest.raises(TransientError, match="stopped in the middle of a program"):
            lab.tweezers.wait(1.0)
        assert lab.card.outputs_on == (False, False)
        lab.play(lab.program(1))


def test_a_second_edge_does_not_start_the_next_program(driver: Any) -> None:
    with driver("sequence", trigger="external") as lab:
        duration_s = lab.tweezers.prepare(lab.program(4))
        lab.tweezers.play()
        assert lab.card.trigger()
        lab.clock.sleep(duration_s / 2)
        assert lab.card.trigger(), "bounces of a cable"
        lab.tweezers.wait(1.0)
        assert not lab.card.trigger(), "nothing waits for an edge now"
        lab.card.forget(lab.clock.now())
        lab.tweezers.prepare(lab.program(1))
        lab.tweezers.play()
        lab.clock.sleep(2e-3)
        assert not lab.card.played(0)
        with pytest.raises(DeviceError, match="no trigger came"):
            lab.tweezers.wait(1e-3)


def test_a_card_without_the_mode_is_refused(driver: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    read = SimulatedCard.read
    without = {r.SPC_PCIFEATURES: (0, 0)}
    monkeypatch.setattr(SimulatedCard, "read", lambda card, reg: without.get(reg) or read(card, reg))
    with pytest.raises(DeviceError, match=r"no sequence mode .*; use `mode: replay`"), driver("sequence"):
        pass


# The simulated card


class Bench:
    """A simulated card in the sequence mode, with four segments; the first two are written."""

    def __init__(self) -> None:
        self.clock = FakeClock()
        self.card = SimulatedCard(self.clock)
        self.buffers: list[Samples] = []
        for register, value in (
            (r.SPC_CARDMODE, r.SPC_REP_STD_SEQUENCE),
            (r.SPC_SEQMODE_MAXSEGMENTS, 4),
            (r.SPC_SAMPLERATE, 250_000_000),
            (r.SPC_ENABLEOUT0, 1),
            (r.SPC_M2CMD, r.M2CMD_CARD_WRITESETUP),
        ):
            assert self.card.write(register, value) == 0
        self.clock.sleep(20e-3)
        for segment, n_samples in ((0, 320), (1, 640)):
            assert self.fill(segment, n_samples) == 0
            self.clock.sleep(1e-3)

    def fill(self, segment: int, n_samples: int, value: int | None = None) -> int:
        """Write a segment with its number + 1; returns the first error code."""
        frames = DriverBuffer().reserve(n_samples)
        frames[:] = segment + 1 if value is None else value
        self.buffers.append(frames)
        size = self.write((r.SPC_SEQMODE_WRITESEGMENT, segment), (r.SPC_SEQMODE_SEGMENTSIZE, n_samples))
        if size:
            return size
        buffer = Buffer(frames.ctypes.data, frames.nbytes, 0)
        code = self.card.define_transfer(r.SPCM_BUF_DATA, r.SPCM_DIR_PCTOCARD, 0, buffer)
        return code or self.write((r.SPC_M2CMD, r.M2CMD_DATA_STARTDMA))

    def write(self, *writes: tuple[int, int]) -> int:
        """Write registers up to the first that is refused, whose error is taken; returns its code."""
        code = self.card.write_all(writes)
        self.card.take_error()
        return code

    def step(self, number: int, segment: int, following: int, loops: int = 1, flags: int = 0) -> int:
        word = (flags | loops) << 32 | following << 16 | segment
        return self.write((r.SPC_SEQMODE_STEPMEM0 + number, word))

    def start(self) -> None:
        assert self.write((r.SPC_SEQMODE_STARTSTEP, 0)) == 0
        assert self.write((r.SPC_M2CMD, r.M2CMD_CARD_START | r.M2CMD_CARD_FORCETRIGGER)) == 0

    def status(self) -> int:
        return int(self.card.read(r.SPC_SEQMODE_STATUS)[1])

    def runs(self) -> list[tuple[int, int]]:
        """What channel 0 played: value, and how many samples in a row."""
        values = np.concatenate([span.values() for span in self.card.played(0)])
        return [(int(value), len(list(same))) for value, same in itertools.groupby(values)]


@pytest.fixture
def sim() -> Bench:
    return Bench()


class TestSimulatedCard:
    @pytest.mark.parametrize(
        "writes",
        [
            [(r.SPC_SEQMODE_MAXSEGMENTS, 3)],
            [(r.SPC_SEQMODE_MAXSEGMENTS, 1)],
            [(r.SPC_SEQMODE_MAXSEGMENTS, 1 << 17)],
            [(r.SPC_SEQMODE_WRITESEGMENT, 4)],
            [(r.SPC_SEQMODE_SEGMENTSIZE, 160)],
            [(r.SPC_SEQMODE_SEGMENTSIZE, 200)],
            [(r.SPC_SEQMODE_SEGMENTSIZE, 2**28 + 32)],
            [(r.SPC_SEQMODE_STARTSTEP, 4096)],
            [(r.SPC_SEQMODE_STEPMEM0, 1 << 32 | 4)],
            [(r.SPC_SEQMODE_STEPMEM0, 1 << 32 | 4096 << 16)],
            [(r.SPC_SEQMODE_STEPMEM0, 0)],
            [(r.SPC_SEQMODE_STEPMEM0, 0x10000001 << 32)],
        ],
        ids=str,
    )
    def test_refuses_what_is_out_of_range(self, sim: Bench, writes: list[tuple[int, int]]) -> None:
        register = writes[0][0]
        before = sim.card.read(register)
        assert sim.write(*writes) == r.ERR_VALUE
        assert sim.card.read(register) == before

    def test_knows_its_limits_and_what_can_only_be_read(self, sim: Bench) -> None:
        assert sim.card.read(r.SPC_SEQMODE_AVAILMAXSTEPS) == (0, 4096)
        assert sim.card.read(r.SPC_SEQMODE_AVAILMAXSEGMENT) == (0, 65536)
        assert sim.write((r.SPC_SEQMODE_STATUS, 1)) == r.ERR_NOWRITEALLOWED
        assert sim.write((r.SPC_CARDMODE, r.SPC_REP_STD_SINGLE)) == 0
        assert sim.write((r.SPC_SEQMODE_WRITESEGMENT, 0)) == r.ERR_SEQUENCE

    def test_starts_only_with_steps_and_samples_that_are_there(self, sim: Bench) -> None:
        assert sim.write((r.SPC_M2CMD, r.M2CMD_CARD_START)) == r.ERR_SEQUENCE, "no step"
        sim.step(0, 2, 0)
        assert sim.write((r.SPC_M2CMD, r.M2CMD_CARD_START)) == r.ERR_SEQUENCE, "an empty segment"
        sim.step(0, 0, 1)
        assert sim.write((r.SPC_M2CMD, r.M2CMD_CARD_START)) == r.ERR_SEQUENCE, "no next step"

    def test_plays_loops_of_segments_and_stops_at_the_end(self, sim: Bench) -> None:
        sim.step(0, 0, 7, loops=3)
        sim.step(7, 1, 0, flags=r.SPCSEQ_END)
        sim.start()
        sim.clock.sleep(1.0)
        assert sim.runs() == [(1, 960), (2, 640)]
        assert not sim.card.running

    def test_changes_at_the_end_of_a_segment_as_seen_by_the_fifo_and_tells_what_is_at_the_output(
        self, sim: Bench
    ) -> None:
        sim.step(0, 0, 0)
        sim.step(1, 1, 1)
        sim.start()
        sim.clock.sleep(1e-3)
        assert sim.step(0, 0, 1) == 0
        assert sim.status() == 0, "its samples are still on their way to the output"
        sim.clock.sleep(FIFO_SAMPLES / 250e6 + 320 / 250e6)
        assert sim.status() == 1
        (_, first), *_ = sim.runs()
        assert first % 320 == 0
        assert FIFO_SAMPLES <= first - (1e-3 * 250e6 - 238.5 - 4) <= FIFO_SAMPLES + 320

    def test_refuses_to_change_what_is_played_and_takes_everything_else(self, sim: Bench) -> None:
        sim.step(0, 0, 1)
        sim.step(1, 1, 0)
        sim.start()
        for segment in (0, 1):  # one is played, the other one will be next
            assert sim.fill(segment, 320) == r.ERR_SEQUENCE
        for write in ((r.SPC_SEQMODE_MAXSEGMENTS, 8), (r.SPC_SEQMODE_STARTSTEP, 1), (r.SPC_CARDMODE, 1)):
            assert sim.write(write) == r.ERR_RUNNING
        assert sim.fill(2, 320) == 0
        sim.step(2, 2, 2)
        assert sim.step(1, 1, 2) == r.ERR_SEQUENCE, "its samples have not arrived"
        sim.clock.sleep(1e-3)
        assert sim.step(1, 1, 2) == 0
        assert sim.step(2, 2, 3) == r.ERR_SEQUENCE, "that step was never written"
        sim.clock.sleep(1e-3)
        assert sim.runs()[-1][0] == 3
        assert sim.fill(1, 320) == 0, "nothing leads there any more"

    def test_a_step_keeps_the_size_that_its_segment_had_when_it_was_written(self, sim: Bench) -> None:
        sim.step(0, 0, 1)
        sim.step(1, 1, 1, flags=r.SPCSEQ_END)
        sim.fill(1, 320, value=9)
        sim.clock.sleep(1e-3)
        sim.start()
        sim.clock.sleep(1e-3)
        assert sim.runs() == [(1, 320), (9, 320), (2, 320)], "what is behind it is still there"

    def test_waits_for_a_trigger_that_came_while_the_detection_was_enabled(self, sim: Bench) -> None:
        sim.write((r.SPC_TRIG_ORMASK, r.SPC_TMASK_EXT0), (r.SPC_TRIG_EXT0_MODE, r.SPC_TM_POS))
        sim.write((r.SPC_TRIG_EXT0_LEVEL0, 1500))
        sim.step(0, 0, 1, flags=r.SPCSEQ_ENDLOOPONTRIG)
        sim.step(1, 1, 0, flags=r.SPCSEQ_END)
        sim.start()
        sim.clock.sleep(1e-3)
        assert not sim.card.trigger()
        sim.write((r.SPC_M2CMD, r.M2CMD_CARD_ENABLETRIGGER))
        sim.clock.sleep(1e-3)
        assert sim.card.running
        assert sim.card.trigger()
        sim.clock.sleep(1e-3)
        assert sim.runs()[-1] == (2, 640)
