"""The Spectrum driver's mode ``stream``: programs spliced into silence, and a computer that is held up."""

from __future__ import annotations

import math
import threading
from contextlib import nullcontext
from dataclasses import replace
from itertools import count
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from labseq_spcm import stream_kernels as k
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings
from labseq_spcm.stream import Stream, check_rendering, stream_program
from labseq_spcm_sim import M4I6631, Faults, SimulatedCard, installed, registers

from labseq.motion import tone_program
from labseq.motion.rendering import render
from labseq.plugin import Context, DeviceError, MotionSpec, Plan, SiteGrid, ToneProgram, TransientError
from labseq.plugin.motion import RfSpec

from .conftest import RATE_HZ, Lab

PARKED = {"row_frequency": 82.2e6, "column_frequency": 117.9e6}


def start_s(lab: Lab, program: ToneProgram, row_channel: int = 0) -> float:
    """When the only program since ``forget`` began, whose samples must be all that was not silent."""
    begun = set[int]()
    rendered = render(program, lab.rate_hz).samples
    for samples, channel in zip(rendered, (row_channel, 1 - row_channel), strict=True):
        played, first = lab.samples(channel), lab.card.played(channel)[0].start_s
        assert np.array_equal(np.trim_zeros(played), np.trim_zeros(samples))
        begun.add(round(first * lab.rate_hz) + int(played.nonzero()[0][0] - samples.nonzero()[0][0]))
    assert len(begun) == 1, "both axes at once"
    return begun.pop() / lab.rate_hz


@pytest.mark.parametrize(
    ("row_channel", "rate_hz", "notify_size"), [(0, RATE_HZ, 1 << 16), (1, 624e6, 1 << 12)]
)
def test_programs_are_played_to_the_sample_within_the_look_ahead(
    driver: Any, row_channel: int, rate_hz: float, notify_size: int
) -> None:
    outputs = {"row_channel": row_channel}
    with driver("stream", sample_rate=rate_hz, notify_size=notify_size, fill=3e-3, **outputs) as lab:
        lab.tweezers.settle()
        lab.clock.sleep(1e-3)
        ahead_s = lab.tweezers.describe()["trigger_delay_s"]
        assert ahead_s < max(250e-6, 0.46e-3 * RATE_HZ / rate_hz)
        for n_batches, pause_s in [(5, 0.0), (1, 1.234e-3), (12, 0.1), (2, 1e-6)]:
            lab.clock.sleep(pause_s)
            lab.card.forget(lab.clock.now())
            program = lab.program(n_batches)
            duration_s = lab.tweezers.prepare(program)
            played_s = lab.clock.now()
            lab.tweezers.play()
            lab.tweezers.wait(duration_s + 1e-3)
            lab.clock.sleep(1e-3)
            assert 0.4 * ahead_s < start_s(lab, program, row_channel) - played_s <= ahead_s
        assert lab.tweezers.describe()["silent_underruns"] == 0
        assert lab.written(registers.SPC_M2CMD).count(registers.M2CMD_CARD_STOP) <= 1


def test_a_program_is_over_when_the_outputs_have_played_it(
    driver: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the loop looks every 0.25 ms and the driver every 0.1 ms, so both look while the end is on the card
    monkeypatch.setattr(Stream, "max_wait_s", 0.1e-3)
    with driver("stream", fill=1e-3) as lab:
        lab.tweezers.settle()
        lab.card.forget(lab.clock.now())
        program = lab.program(1)
        lab.play(program)
        ended_s = lab.clock.now()
        lab.clock.sleep(1e-3)
        assert ended_s >= start_s(lab, program) + program.total_duration_s


def test_a_computer_that_is_held_up_in_silence_costs_nothing(driver: Any) -> None:
    with driver("stream", sample_rate=624e6) as lab:
        lab.tweezers.settle()
        for program in (lab.program(40), lab.program(2)):
            lab.card.hold_up(14e-3)
            lab.clock.sleep(14e-3)
            lab.card.forget(lab.clock.now())
            played_s = lab.clock.now()
            lab.play(program)
            assert start_s(lab, program) - played_s <= lab.tweezers.describe()["trigger_delay_s"]
        assert lab.tweezers.describe()["silent_underruns"] == 0


def test_a_batch_that_is_rendered_too_slowly_begins_later_and_is_played_to_the_sample(driver: Any) -> None:
    with driver("stream", sample_rate=624e6) as lab:
        lab.tweezers.settle()
        stream: Any = lab.tweezers._mode

        def slow_step() -> float | None:
            pause_s = stream._virtual_step()
            return 0.2e-3 if stream._box[k.RENDERED_AT] >= 0 else pause_s  # for 26 us of samples

        step = lab.tweezers.library.call_in_virtual_time
        lab.tweezers.library.call_in_virtual_time = lambda _: step(slow_step)
        program = lab.program(8)
        made = stream_program(program, lab.rate_hz, 0, 1, {})
        duration_s = lab.tweezers.prepare(program)
        lab.card.forget(lab.clock.now())
        lab.tweezers.play()
        lab.tweezers.wait(duration_s + 1.0)
        for channel in (0, 1):
            played, rendered = lab.samples(channel), render(program, lab.rate_hz).samples[channel]
            for piece in np.split(rendered, made.cuts[: int(made.words[k.N_CUTS]) - 1]):
                found = np.trim_zeros(piece)
                played = played[played.nonzero()[0][0] :]
                assert np.array_equal(played[: len(found)], found)
                played = played[len(found) :]
            assert not played.any()
        assert lab.tweezers.describe()["delayed_batches"] >= 6


@pytest.mark.parametrize("keep_warm", [None, PARKED])
def test_an_underrun_in_silence_is_counted_and_the_stream_begins_again(driver: Any, keep_warm: Any) -> None:
    with driver("stream", keep_warm=keep_warm) as lab:
        lab.play(lab.program(1))
        for n in range(3):
            lab.card.hold_up(25e-3)
            lab.clock.sleep(24e-3)
            assert not lab.card.running, "dry"
            lab.clock.sleep(n * 1e-3)  # the program is spliced in before or after the thread is back
            lab.card.forget(lab.clock.now())
            program = lab.program(2)
            lab.play(program)
            if keep_warm is None:
                start_s(lab, program)
            lab.clock.sleep(2e-3)
            assert lab.tweezers.describe()["silent_underruns"] == n + 1
            assert lab.card.running


@pytest.mark.parametrize("n_batches", [1, 60])
@pytest.mark.parametrize("is_begun", [False, True])
def test_a_card_that_ran_dry_before_a_program_was_written_plays_it_and_one_in_its_middle_is_an_error(
    driver: Any, n_batches: int, is_begun: bool
) -> None:
    with driver("stream", fill=4e-3) as lab:
        lab.tweezers.settle()
        lab.clock.sleep(1e-3)
        stream: Any = lab.tweezers._mode
        box, held = stream._box, list[float]()

        def held_step() -> float | None:
            pause_s = stream._virtual_step()
            is_now = box[k.START] < box[k.MADE] < box[k.END] if is_begun else box[k.START] == box[k.MADE]
            if box[k.TAKEN] == 1 and is_now and not held:
                held.append(25e-3)  # longer than what is in the ring
                return held[0]
            return pause_s

        step = lab.tweezers.library.call_in_virtual_time
        lab.tweezers.library.call_in_virtual_time = lambda _: step(held_step)
        program = lab.program(n_batches)
        lab.tweezers.prepare(program)
        lab.card.forget(lab.clock.now())
        lab.tweezers.play()
        if is_begun:
            with pytest.raises(TransientError, match=r"underrun: .* of a part of .* was played"):
                lab.tweezers.wait(1.0)
        else:
            lab.tweezers.wait(1.0)
            start_s(lab, program)
            assert lab.tweezers.describe()["silent_underruns"] == 1
        assert held


def test_a_program_of_which_a_part_may_have_been_played_is_not_played_again(driver: Any) -> None:
    with driver("stream") as lab:
        stream: Any = lab.tweezers._mode
        box, block = stream._box, stream._block
        box[k.START] = box[k.FETCHED]  # of the block that is being fetched the card reports nothing
        box[k.MADE], box[k.END] = box[k.START] + block, box[k.START] + 9 * block
        with pytest.raises(TransientError, match=r"underrun: .* \(0% of a part of .*s was played\)"):
            stream._recover(k.DRY)


@pytest.mark.parametrize(("held_s", "is_survived"), [(6e-3, True), (12e-3, False)])
def test_a_computer_that_is_held_up_in_motion(driver: Any, held_s: float, is_survived: bool) -> None:
    with driver("stream", fill=8e-3) as lab:
        program = lab.program(100)
        duration_s = lab.tweezers.prepare(program)
        lab.card.forget(lab.clock.now())
        lab.tweezers.play()
        lab.clock.sleep(1e-3)
        lab.card.hold_up(held_s)
        if is_survived:
            lab.tweezers.wait(duration_s + 1e-3)
            start_s(lab, program)
            return
        with pytest.raises(TransientError, match=r"underrun: .* \(\d\d% .*; raise `fill`"):
            lab.tweezers.wait(duration_s + 1e-3)
        assert lab.card.outputs_on == (False, False)
        assert not lab.card.running
        lab.card.forget(lab.clock.now())
        program = lab.program(2)
        lab.play(program)
        start_s(lab, program)
        assert lab.tweezers.describe()["silent_underruns"] == 0


def test_a_computer_that_is_held_up_after_the_last_samples_were_handed_over(driver: Any) -> None:
    with driver("stream") as lab:
        program = lab.program(4)
        duration_s = lab.tweezers.prepare(program)
        lab.card.forget(lab.clock.now())
        lab.tweezers.play()
        lab.clock.sleep(duration_s / 2)
        lab.card.hold_up(duration_s)
        lab.tweezers.wait(1.0)
        start_s(lab, program)


@pytest.mark.parametrize("pause_s", [0.0, 5e-3, 1.5])
@pytest.mark.parametrize(("lag_s", "is_seen"), [(20e-6, False), (131e-6, True)])
def test_a_position_that_is_reported_more_than_a_block_late_is_an_underrun(
    driver: Any, lag_s: float, is_seen: bool, pause_s: float
) -> None:
    """Without a look at the clock the first samples were lost, and nothing said so."""
    late = Faults(position_lag_s=lag_s)
    with driver("stream", sample_rate=624e6, card_faults=late) as lab:
        lab.tweezers.settle()
        lab.clock.sleep(pause_s)
        lab.card.forget(lab.clock.now())
        program = lab.program(3)
        with pytest.raises(TransientError, match="underrun") if is_seen and pause_s else nullcontext():
            lab.play(program)
            start_s(lab, program)


@pytest.mark.parametrize("drift", [-18e-6, 18e-6])
def test_a_card_whose_clock_drifts_is_followed(driver: Any, drift: float) -> None:
    """After 6 s the clocks are four blocks apart."""
    with driver("stream", sample_rate=624e6) as lab:
        lab.tweezers.settle()
        lab.card._machine.fifo._rate *= 1 + drift
        for _ in range(12):
            lab.clock.sleep(0.5)
            lab.play(lab.program(1))
        shift = lab.tweezers._mode._box[k.SHIFT]
        assert shift == pytest.approx(drift * 6 * 624e6, rel=0.2)


@pytest.mark.parametrize("late_s", [0.0, 3e-3, 60e-3])
def test_the_rest_of_a_program_follows_its_beginning(driver: Any, late_s: float) -> None:
    with driver("stream") as lab:
        parts = [lab.program(4), lab.program(30)]
        lab.tweezers.settle()
        lab.clock.sleep(1e-3)
        lab.tweezers.prepare_beginning(parts[0])
        lab.card.forget(lab.clock.now())
        lab.tweezers.play()
        lab.clock.sleep(late_s / 20)
        if late_s > 10e-3:
            lab.card.hold_up(30e-3)  # the whole beginning is in the ring, and the card runs dry after it
        lab.clock.sleep(late_s)
        lab.tweezers.append(parts[1])
        lab.tweezers.wait(1.0)
        lab.clock.sleep(1e-3)
        for channel in (0, 1):
            played = np.trim_zeros(lab.samples(channel))
            begins, follows = (np.trim_zeros(render(part, lab.rate_hz).samples[channel]) for part in parts)
            assert np.array_equal(played[: len(begins)], begins)
            assert np.array_equal(played[-len(follows) :], follows)
            pause = played[len(begins) : -len(follows)]
            assert not pause.any()
            block_s = (1 << 16) / 4 / lab.rate_hz
            assert (len(pause) / lab.rate_hz < 2 * block_s) == (late_s == 0.0)
        assert lab.tweezers.describe()["silent_underruns"] == (late_s > 10e-3)


@pytest.mark.parametrize("mode", ["stream", "replay"])
def test_nothing_is_appended_where_nothing_plays_or_a_program_must_be_whole(driver: Any, mode: str) -> None:
    with driver(mode) as lab:
        lab.tweezers.prepare(lab.program(2))
        assert (lab.tweezers.beginning_s == math.inf) == (mode == "replay")
        if mode == "replay":
            lab.tweezers.play()
        with pytest.raises(DeviceError, match=r"plays whole programs only|append\(\) while nothing plays"):
            lab.tweezers.append(lab.program(2))


@pytest.mark.parametrize(
    ("pcie", "text"), [((2, 4), "4 lanes of PCIe generation 2"), ((1, 8), "generation 1")]
)
def test_a_slot_that_cannot_stream_is_named(driver: Any, pcie: tuple[int, int], text: str) -> None:
    slot = replace(M4I6631, pcie=pcie)
    with (
        pytest.raises(DeviceError, match=rf"the slot with .*{text} carries 1\.4 GB/s, .* 2\.5 GB/s"),
        driver("stream", model=slot, sample_rate=624e6),
    ):
        pass


@pytest.mark.parametrize("slow_call", ["define_transfer", "write"])
def test_what_a_transfer_takes_whatever_its_size_is_not_taken_for_a_slow_bus(
    driver: Any, slow_call: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pinning of the buffer's pages, and the start of each transfer."""
    call = getattr(SimulatedCard, slow_call)

    def slow(card: SimulatedCard, *arguments: Any) -> Any:
        if slow_call == "define_transfer" or arguments == (
            registers.SPC_M2CMD,
            registers.M2CMD_DATA_STARTDMA,
        ):
            card._clock.sleep(3e-3)
        return call(card, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(SimulatedCard, slow_call, slow)
        with driver("stream", sample_rate=624e6) as lab:
            assert lab.tweezers.describe()["bus_bytes_per_s"] == pytest.approx(2.8e9, rel=0.01)


def test_a_bus_that_cannot_stream_is_reported_when_the_card_is_opened(driver: Any) -> None:
    slow = replace(M4I6631, bus_bytes_per_s=1.4e9)  # four lanes
    text = r"1\.4 GB/s, .* 624 MHz needs 2\.5 GB/s; .* below 350 MHz"
    with pytest.raises(DeviceError, match=text), driver("stream", model=slow, sample_rate=624e6):
        pass
    with driver("stream", model=slow, sample_rate=300e6) as lab:
        lab.play(lab.program(1))


@pytest.mark.parametrize("shape", [(20, 20), (1, 20), (20, 1), (1, 1)])
def test_a_computer_that_renders_too_slowly_is_reported(
    monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]
) -> None:
    context = Context(grid=SiteGrid(*shape))
    for step_s in (1e-6, 1.0):
        clock = SimpleNamespace(perf_counter=count(0.0, step_s).__next__)
        monkeypatch.setattr("labseq_spcm.stream.time", clock)
        slow = pytest.raises(DeviceError, match=r"\d+ moving tones .* lower sample_rate")
        with slow if step_s == 1.0 else nullcontext():
            check_rendering("awg", context, 250e6, 0)


def test_an_error_of_the_card_in_silence_ends_the_stream_and_is_raised_by_the_next_call(driver: Any) -> None:
    with driver("stream") as lab:
        lab.tweezers.settle()
        lab.card.break_down("for this test")
        lab.clock.sleep(10e-3)
        with pytest.raises(DeviceError, match="for this test"):
            lab.tweezers.prepare(lab.program(1))
        lab.tweezers.safe_state()
        assert lab.card.outputs_on == (False, False)
        lab.card.forget(lab.clock.now())
        lab.play(program := lab.program(1))
        start_s(lab, program)


def threads() -> list[threading.Thread]:
    """Those of streams."""
    return [thread for thread in threading.enumerate() if thread.name in ("spcm stream", "spcm helper")]


def play_when_the_computer_is_not_held_up(lab: Lab, program: ToneProgram) -> None:
    """Play a program in real time; as a session does, again if the card ran dry because others are busy."""
    for _ in range(100):
        lab.tweezers.prepare(program)
        lab.card.forget(lab.clock.now())
        lab.tweezers.play()
        try:
            lab.tweezers.wait(60.0)
        except TransientError:
            continue
        return
    pytest.fail("the card ran dry a hundred times")


def slow_context() -> Context:
    """Of a lab in real time whose tones need 50 MS/s only."""
    tones_hz, band = np.linspace(12e6, 18e6, 5), (10e6, 20e6)
    grid = SiteGrid(5, 5, row_frequency_hz=tones_hz, column_frequency_hz=tones_hz)
    motion = MotionSpec(rf=RfSpec(row_band_hz=band, column_band_hz=band))
    return Context("mobile_tweezers", grid, motion=motion)


def test_in_real_time_a_thread_feeds_the_card_until_it_is_safe() -> None:
    context = slow_context()
    motion = context.motion
    plan = Plan.from_batches([([(0, 0), (0, 2)], [(0, 1), (0, 3)])])  # handed over as a whole by play()
    program = tone_program(plan, context.grid, motion)
    card = SimulatedCard(context.clock)
    assert not context.clock.virtual
    with installed(card) as name:
        settings = SpcmSettings(card=name, mode="stream", sample_rate=50e6, fill=0.2)
        tweezers = SpcmMobileTweezers(settings, context)
        tweezers.warm()
        tweezers.open()
        lab = Lab(tweezers, card, context.clock, motion)  # type: ignore[arg-type]
        try:
            for _ in range(2):
                tweezers.settle()
                assert any(thread.name == "spcm stream" for thread in threads())
                play_when_the_computer_is_not_held_up(lab, program)
                start_s(lab, program)
                tweezers.safe_state()
                for thread in threads():
                    thread.join(60.0)
                assert not threads()
                assert (card.running, card.outputs_on) == (False, (False, False))
        finally:
            tweezers.close()


class Watched(SimulatedCard):
    """A card that notes whether a call comes from another thread while one is under way.

    The owner's first reading of the serial number waits for such a call for 0.1 s.
    """

    entered: threading.Event | None = None
    owner = 0

    def read(self, register: int) -> tuple[int, int | float]:
        if self.entered is not None and threading.get_ident() != self.owner:
            self.entered.set()
        if register == registers.SPC_PCISERIALNO and threading.get_ident() == self.owner:
            self.entered = threading.Event()
            self.meanwhile()
            self.is_alone = not self.entered.wait(0.1)
            self.entered = None
        return super().read(register)

    def meanwhile(self) -> None:
        """What another thread begins now."""


@pytest.mark.parametrize("mode", ["replay", "stream"])
def test_the_driver_library_is_called_by_one_thread_at_a_time(mode: str) -> None:
    """By another thread of Python's, or by the loop of a stream."""
    context = slow_context()
    card = Watched(context.clock)
    with installed(card) as name:
        settings = SpcmSettings(card=name, mode=mode, sample_rate=50e6, fill=20e-3)  # type: ignore[arg-type]
        tweezers: Any = SpcmMobileTweezers(settings, context)
        tweezers.warm()
        tweezers.open()
        try:
            tweezers.settle()
            card.owner = threading.get_ident()
            other = threading.Thread(target=lambda: tweezers._card.status)
            card.meanwhile = other.start if mode == "replay" else lambda: None  # type: ignore[method-assign]
            assert tweezers._card.serial_number == 12345
            assert card.is_alone
            if mode == "replay":
                other.join(60.0)
        finally:
            tweezers.close()
