"""The simulated Spectrum card under the real spcm: registers, errors, replay, FIFO, installation.

A test that fails here after an upgrade of ``spcm`` is good news: the fault is mended, and the
driver's work-around can go.
"""

from __future__ import annotations

import itertools
import subprocess
import sys
import textwrap
import threading
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_spcm_sim import (
    SimulatedCard,
    install,
    installed,
    registers,
)
from labseq_spcm_sim.library import CardOutputs
from labseq_spcm_sim.modes import AREA, Buffer, Fifo, Store

from labseq import DeviceError
from labseq.model import RfSamples, RfSpan, RfTones
from labseq.testing.fakes import FakeClock

ERR_LASTERR, ERR_VALUE, ERR_TIMEOUT = 0x10, 0x101, 0x107


def refusal(bench, register, value):
    """The vendor's error code for a value."""
    code = bench.sim.write(register, value)
    bench.sim.take_error()
    return code


def test_the_real_package_opens_the_card_and_knows_it(bench):
    assert str(bench.card) == "Card: M4i.6631-x8 sn 12345"
    assert bench.card.card_type() == bench.spcm.TYP_M4I6631_X8
    assert bench.card.num_channels() == 2
    assert bench.card.max_sample_value() == 32767
    assert not bench.card.is_demo_card()
    assert bench.card.ext_features() & bench.spcm.SPCM_FEAT_EXTFW_DDS20


def test_every_register_has_the_number_that_the_vendor_gave_it(bench):
    from spcm_core import constants

    ours = {name: value for name, value in vars(registers).items() if name.startswith(("SPC", "M2", "ERR_"))}
    assert len(ours) > 150
    assert {name: getattr(constants, name) for name in ours if hasattr(constants, name)} == {
        name: value for name, value in ours.items() if hasattr(constants, name)
    }
    assert [name for name in ours if not hasattr(constants, name)] == []


@pytest.mark.parametrize(
    ("register", "bad"),
    [
        ("SPC_MEMSIZE", 1000),
        ("SPC_MEMSIZE", 0),
        ("SPC_MEMSIZE", 1024**3 + 32),
        ("SPC_SAMPLERATE", 2_000_000_000),
        ("SPC_SAMPLERATE", 49_000_000),
        ("SPC_SAMPLERATE", 753_000_000),
        ("SPC_SAMPLERATE", 1_130_000_000),
        ("SPC_AMP0", 79),
        ("SPC_AMP1", 2001),
        ("SPC_OFFS0", 5),
        ("SPC_CHENABLE", 4),
        ("SPC_LOOPS", 2**32),
        ("SPC_TRIG_EXT0_LEVEL0", 10_010),
        ("SPC_TRIG_DELAY", 33),
        ("SPC_DATA_OUTBUFSIZE", 3000),
    ],
)
def test_a_value_out_of_range_is_refused_and_the_old_one_stays(bench, register, bad):
    number = getattr(bench.spcm, register)
    before = bench.card.get_i(number)
    with pytest.raises(bench.spcm.SpcmException, match=register):
        bench.card.set_i(number, bad)
    assert bench.card.get_i(number) == before
    assert refusal(bench, number, bad) == ERR_VALUE


def test_both_ends_of_each_clock_gap_can_be_set(bench):
    for rate in (750_000_000, 757_000_000, 1_125_000_000, 1_145_000_000):
        bench.card.set_i(bench.spcm.SPC_SAMPLERATE, rate)
        assert bench.card.get_i(bench.spcm.SPC_SAMPLERATE) == rate


@settings(max_examples=50)
@given(st.integers(50_000_000, 700_000_000))
def test_an_inexact_sample_rate_is_rounded_to_8_hz_without_a_word(rate):
    card = SimulatedCard(FakeClock())
    assert card.write(registers.SPC_SAMPLERATE, rate) == 0
    code, got = card.read(registers.SPC_SAMPLERATE)
    assert (code, got % 8) == (0, 0)
    assert abs(got - rate) <= 4


def test_the_first_error_locks_the_driver_until_it_is_read(bench):
    sim, s = bench.sim, bench.spcm
    assert sim.write(s.SPC_AMP0, 9000) == ERR_VALUE
    assert sim.write(s.SPC_AMP0, 600) == ERR_LASTERR
    assert sim.read(s.SPC_AMP0) == (ERR_LASTERR, 0)
    error = sim.take_error()
    assert (error.code, error.register, error.value) == (ERR_VALUE, s.SPC_AMP0, 9000)
    assert sim.read(s.SPC_AMP0) == (0, 1000)
    assert sim.take_error().code == 0


def test_a_timeout_does_not_lock_the_driver(bench):
    s = bench.spcm
    bench.outputs()
    bench.external_trigger()
    bench.card.timeout(20 * s.units.ms)
    start_s = bench.clock.now()
    with pytest.raises(s.SpcmTimeout):
        bench.card.start(s.M2CMD_CARD_ENABLETRIGGER, s.M2CMD_CARD_WAITREADY)
    assert bench.clock.now() - start_s == pytest.approx(0.02)
    assert bench.card.status() & s.M2STAT_CARD_READY == 0


def test_an_unknown_register_and_one_that_can_only_be_read_are_reported_apart(bench):
    assert refusal(bench, 999_999, 1) == bench.spcm.ERR_REG
    assert refusal(bench, bench.spcm.SPC_PCIMEMSIZE, 1) == bench.spcm.ERR_NOWRITEALLOWED
    assert bench.sim.read(999_999)[0] == bench.spcm.ERR_REG


def test_what_is_not_modelled_says_so(bench):
    with pytest.raises(bench.spcm.SpcmException, match="simulator models only"):
        bench.card.card_mode(bench.spcm.SPC_REP_STD_MULTI)


def test_the_set_up_cannot_change_while_the_card_runs_but_the_amplitude_can(bench):
    s = bench.spcm
    bench.outputs()
    bench.card.start()
    assert refusal(bench, s.SPC_SAMPLERATE, 500_000_000) == s.ERR_RUNNING
    assert refusal(bench, s.SPC_M2CMD, s.M2CMD_CARD_WRITESETUP) == 288
    assert refusal(bench, s.SPC_M2CMD, s.M2CMD_CARD_START) == s.ERR_SEQUENCE
    bench.card.set_i(s.SPC_AMP0, 600)
    bench.card.stop()
    bench.card.write_setup()


def test_reset_puts_everything_back_and_the_outputs_off(bench):
    bench.outputs()
    assert bench.sim.outputs_on == (True, True)
    bench.card.start()
    bench.card.reset()
    assert not bench.sim.running
    assert bench.sim.outputs_on == (False, False)
    assert bench.card.get_i(bench.spcm.SPC_AMP0) == 1000


def test_every_write_is_logged_with_its_time(bench):
    bench.clock.sleep(1.5)
    bench.card.loops(9)
    *_, last = bench.sim.log
    assert (last.time_s, last.register, last.value) == (1.5, bench.spcm.SPC_LOOPS, 9)


def test_a_card_in_use_cannot_be_opened_again_until_it_is_closed(bench):
    again = bench.spcm.Card(bench.name)
    with pytest.raises(bench.spcm.SpcmDeviceNotFound):
        again.open()
    again._closed = True  # else its destructor stops a card that it never had
    bench.card.close()
    bench.card = bench.spcm.Card(bench.name).open()
    assert bench.card.sn() == 12345


def test_threads_may_call_at_the_same_time(bench):
    s = bench.spcm
    registers_of = {0: s.SPC_LOOPS, 1: s.SPC_MEMSIZE, 2: s.SPC_TIMEOUT, 3: s.SPC_TRIG_DELAY}
    mixed_up: list[int] = []

    def work(thread: int) -> None:
        for value in range(32, 32 * 200, 32):
            bench.card.set_i(registers_of[thread], value)
            if bench.card.get_i(registers_of[thread]) != value:
                mixed_up.append(thread)

    threads = [threading.Thread(target=work, args=(thread,)) for thread in registers_of]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert mixed_up == []
    assert [bench.card.get_i(register) for register in registers_of.values()] == [6368] * 4


def test_names_of_real_devices_and_names_that_are_taken_are_refused(bench):
    with pytest.raises(DeviceError, match="does not begin with 'simulated'"):
        install(SimulatedCard(bench.clock), "/dev/spcm0")
    with pytest.raises(DeviceError, match="is taken"):
        install(SimulatedCard(bench.clock), bench.name)


def test_a_fault_of_the_simulator_is_reported_and_not_swallowed(bench, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(bench.sim, "write", lambda *_: 1 / 0)
        with pytest.raises(bench.spcm.SpcmException, match="fault of the simulator: ZeroDivisionError"):
            bench.card.loops(3)


FAKE_VENDOR = """
import ctypes, types
from labseq.testing.fakes import FakeClock
from labseq_spcm_sim import registers
from labseq_spcm_sim import SimulatedCard, installed, vendor_library_found
from labseq_spcm_sim.library import Library

real = SimulatedCard(FakeClock(), serial_number=1)  # plays the real card, in a library of its own
vendor = Library(None)
vendor.cards["/dev/spcm0"] = real
load = ctypes.cdll.LoadLibrary
ours = types.SimpleNamespace(**vendor.functions)
ctypes.cdll.LoadLibrary = lambda name: ours if name.startswith("libspcm") else load(name)
"""

SIDE_BY_SIDE = """
simulated = SimulatedCard(FakeClock(), serial_number=2)
with installed(simulated) as name:
    assert vendor_library_found()
    import spcm, spcm_core
    with spcm.Card("/dev/spcm0") as first, spcm.Card(name) as second:
        assert (first.sn(), second.sn()) == (1, 2)
        handle = second.handle()
        second.loops(5)
        assert (first.loops(), second.loops()) == (1, 5)
        second.set_d(spcm.SPC_DDS_CORE0_AMP, 0.5)
        dds = spcm.DDS(first)
        dds[0].amp(0.25)
        assert abs(dds[0].get_amp() - 0.25) < 1e-4
        try:
            first.set_i(spcm.SPC_AMP0, 9999)
        except spcm.SpcmException as error:
            assert "9999" in str(error)
with spcm.Card("/dev/spcm0") as first:
    assert first.sn() == 1
code = spcm_core.spcm_dwSetParam_i64(handle, spcm.SPC_LOOPS, 3)
assert code == spcm.ERR_INVALIDHANDLE  # closed, but still ours: it never reaches the vendor's library
assert not any(entry.register == spcm.SPC_LOOPS for entry in real.log)
print("done")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="the stand-in for the vendor's library is for cdll")
@pytest.mark.parametrize("imported_before", [False, True])
def test_real_and_simulated_cards_work_in_one_process_whichever_came_first(imported_before):
    code = FAKE_VENDOR + ("import spcm\n" if imported_before else "") + SIDE_BY_SIDE
    command = [sys.executable, "-c", textwrap.dedent(code)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.stdout, done.returncode) == ("done\n", 0), done.stderr


def test_what_is_still_looked_at_keeps_its_values() -> None:
    store = Store()
    taken = [store.take(AREA // 2) for _ in range(8)]
    for k, part in enumerate(taken):
        part.fill(k)
    assert [np.unique(part).tolist() for part in taken] == [[k] for k in range(8)]


def test_a_part_of_it_is_enough_to_keep_it() -> None:
    store = Store()
    seen = store.take(AREA)[10:20]
    seen.fill(7)
    store.take(AREA).fill(1)
    store.take(AREA).fill(1)
    assert seen.tolist() == [7] * 10


def test_memory_that_nobody_looks_at_is_used_again() -> None:
    store = Store()
    addresses = {store.take(AREA).ctypes.data for _ in range(20)}
    assert len(addresses) <= 2


RATE_HZ = 625e6
DELAY_S = 238.5 / RATE_HZ + 16e-9


def sines(n_samples: int, *frequencies_hz: float) -> np.ndarray:
    t_s = np.arange(n_samples) / RATE_HZ
    return np.array([30000 * np.sin(2 * np.pi * hz * t_s) for hz in frequencies_hz]).astype(np.int16)


def test_what_is_played_on_two_channels_has_the_tones_that_were_uploaded(bench):
    s, n_samples = bench.spcm, 64 * 1024
    bench.outputs(500)
    bench.card.set_i(s.SPC_TRIG_ORMASK, s.SPC_TMASK_SOFTWARE)
    samples = sines(n_samples, 80e6, 100e6)
    bench.upload(samples)
    assert np.array_equal(bench.sim.memory, samples.T)
    start_s = bench.clock.now()
    bench.card.start(s.M2CMD_CARD_ENABLETRIGGER, s.M2CMD_CARD_WAITREADY)
    frequency_hz = np.fft.rfftfreq(n_samples, 1 / RATE_HZ)
    for channel, tone_hz in ((0, 80e6), (1, 100e6)):
        (span,) = bench.sim.played(channel)
        assert span.start_s == pytest.approx(start_s + DELAY_S, abs=1e-12)
        assert np.array_equal(span.values(), samples[channel])
        spectrum = np.abs(np.fft.rfft(span.volts())) / n_samples * 2
        assert frequency_hz[np.argmax(spectrum)] == pytest.approx(tone_hz, abs=RATE_HZ / n_samples)
        assert np.max(np.abs(span.volts())) == pytest.approx(0.5 * 30000 / 32767, rel=1e-2)
    assert bench.clock.now() - start_s == pytest.approx(DELAY_S + n_samples / RATE_HZ)
    assert bench.card.status() & s.M2STAT_CARD_READY


def test_a_transfer_takes_the_time_of_the_bus(bench):
    bench.outputs()
    start_s = bench.clock.now()
    bench.upload(np.zeros((2, 700_000 // 4 * 32), np.int16))
    assert bench.clock.now() - start_s == pytest.approx(700_000 * 32 / 2.8e9, rel=1e-6)


def test_a_buffer_is_used_only_once_and_needs_one_to_begin_with(bench):
    s = bench.spcm
    assert bench.sim.write(s.SPC_M2CMD, s.M2CMD_DATA_STARTDMA) == s.ERR_SEQUENCE
    bench.sim.take_error()
    bench.upload(np.zeros((2, 64), np.int16))
    assert bench.sim.write(s.SPC_M2CMD, s.M2CMD_DATA_STARTDMA) == s.ERR_SEQUENCE


def test_a_transfer_longer_than_the_memory_and_an_odd_notify_size_are_refused(bench):
    transfer = bench.spcm.DataTransfer(bench.card)
    transfer.memory_size(64)
    transfer.allocate_buffer(4096)
    with pytest.raises(bench.spcm.SpcmException, match="at most 256 bytes"):
        transfer.start_buffer_transfer()
    transfer.memory_size(4096)
    with pytest.raises(bench.spcm.SpcmException, match="not a multiple of 4096"):
        transfer.start_buffer_transfer(notify_samples=1100)


def test_a_memory_can_be_filled_in_parts(bench):
    import spcm_core

    s = bench.spcm
    transfer = s.DataTransfer(bench.card)
    transfer.memory_size(4096)
    transfer.allocate_buffer(2048)
    address = transfer.buffer.ctypes.data_as(s.c_void_p)
    for part, value in enumerate((3, 4)):
        transfer.buffer[:] = value
        spcm_core.spcm_dwDefTransfer_i64(bench.card.handle(), 1000, 0, 0, address, part * 8192, 8192)
        bench.card.cmd(s.M2CMD_DATA_STARTDMA, s.M2CMD_DATA_WAITDMA)
    assert np.array_equal(bench.sim.memory, np.repeat([[3, 3], [4, 4]], 2048, axis=0))


def test_endless_loops_play_until_the_stop_and_repeat_the_memory(bench):
    s, samples = bench.spcm, sines(3200, 80e6, 100e6)
    bench.outputs()
    bench.card.loops(0)
    bench.upload(samples)
    bench.card.start(s.M2CMD_CARD_ENABLETRIGGER, s.M2CMD_CARD_FORCETRIGGER)
    bench.clock.sleep(DELAY_S + 8000 / RATE_HZ)
    bench.card.stop()
    bench.clock.sleep(1.0)
    (span,) = bench.sim.played(1)
    assert span.n_samples in (7999, 8000)
    assert np.array_equal(span.values(), np.tile(samples[1], 3)[: span.n_samples])


@pytest.mark.parametrize(("voltage_v", "heard"), [(3.3, True), (1.4, False), (-3.3, False)])
def test_a_pulse_triggers_only_if_it_crosses_the_level(bench, voltage_v, heard):
    s = bench.spcm
    bench.external_trigger()
    bench.upload(np.zeros((2, 64), np.int16))
    bench.card.start()
    assert not bench.sim.trigger(voltage_v)  # not enabled yet
    bench.card.cmd(s.M2CMD_CARD_ENABLETRIGGER)
    assert bench.sim.trigger(voltage_v) is heard
    assert bool(bench.card.status() & s.M2STAT_CARD_TRIGGER) is heard


def test_output_off_means_nothing_is_played_and_the_relay_acts_at_once(bench):
    s = bench.spcm
    bench.outputs()
    bench.card.loops(0)
    bench.upload(sines(6400, 80e6, 100e6))
    bench.card.start(s.M2CMD_CARD_ENABLETRIGGER, s.M2CMD_CARD_FORCETRIGGER)
    bench.clock.sleep(10e-6)
    bench.card.set_i(s.SPC_ENABLEOUT0, 0)
    off_s = bench.clock.now()
    bench.clock.sleep(10e-6)
    assert [span.end_s for span in bench.sim.played(0)] == pytest.approx([off_s], abs=2 / RATE_HZ)
    assert bench.sim.played(1)[0].end_s == pytest.approx(bench.clock.now(), abs=2 / RATE_HZ)


@pytest.mark.parametrize(
    ("steps_mv", "gaps"),
    [((1000, 480, 420), 0), ((1000, 419), 1), ((400, 480), 0), ((400, 481), 1), ((400, 450, 481, 450), 1)],
)
def test_changing_the_amplifier_path_puts_the_output_off_for_10_ms(bench, steps_mv, gaps):
    s = bench.spcm
    bench.outputs(steps_mv[0])
    bench.card.loops(0)
    bench.upload(sines(6400, 80e6, 100e6))
    bench.card.start(s.M2CMD_CARD_ENABLETRIGGER, s.M2CMD_CARD_FORCETRIGGER)
    bench.clock.sleep(0.05)
    for step_mv in steps_mv[1:]:
        bench.card.set_i(s.SPC_AMP0, step_mv)
        bench.clock.sleep(0.05)
    spans = bench.sim.played(0)
    pauses_s = [after.start_s - before.end_s for before, after in itertools.pairwise(spans)]
    assert [pause_s for pause_s in pauses_s if pause_s > 1e-6] == pytest.approx([10e-3] * gaps)
    assert spans[-1].amplitude_v == steps_mv[-1] / 1000


def test_a_wait_is_aborted_when_another_thread_stops_the_card():
    class Waited(FakeClock):
        def __init__(self) -> None:
            super().__init__()
            self.waits = threading.Event()

        def sleep(self, duration_s: float) -> None:
            super().sleep(duration_s)
            self.waits.set()

    clock = Waited()
    card = SimulatedCard(clock)
    codes: list[int] = []
    commands = registers.M2CMD_CARD_START | registers.M2CMD_CARD_WAITREADY
    thread = threading.Thread(target=lambda: codes.append(card.write(registers.SPC_M2CMD, commands)))
    thread.start()
    assert clock.waits.wait(10)
    assert card.write(registers.SPC_M2CMD, registers.M2CMD_CARD_STOP) == 0
    thread.join(10)
    assert codes == [registers.ERR_ABORT]
    assert card.read(registers.SPC_LOOPS) == (0, 1)


def test_a_wait_ends_when_the_run_is_asked_to_stop():
    clock = FakeClock()
    card = SimulatedCard(clock)
    clock.stop.request()
    commands = registers.M2CMD_CARD_START | registers.M2CMD_CARD_WAITREADY
    assert card.write(registers.SPC_M2CMD, commands) == registers.ERR_ABORT


def test_what_was_played_can_be_forgotten(bench):
    s = bench.spcm
    bench.outputs()
    bench.external_trigger()
    bench.card.loops(0)
    bench.upload(sines(6400, 80e6, 100e6))
    for _ in range(3):
        bench.card.start(s.M2CMD_CARD_ENABLETRIGGER)
        bench.sim.trigger()
        bench.clock.sleep(1e-3)
        bench.card.stop()
    spans = bench.sim.played(0)
    bench.sim.forget(spans[1].end_s)
    assert [span.start_s for span in bench.sim.played(0)] == [spans[2].start_s]


def test_the_card_is_gone_after_its_block():
    clock = FakeClock()
    with installed(SimulatedCard(clock)) as name:
        import spcm
    card = spcm.Card(name)
    with pytest.raises(spcm.SpcmDeviceNotFound):
        card.open()
    card._closed = True


BUS = 2.8e9
NOTIFY = 4096
"""Samples per channel and block."""
FIFO_DELAY_S = 238.5 / 500e6 + 16e-9


class Stream:
    """A ring of blocks, filled with a count of the blocks."""

    def __init__(self, bench, n_blocks: int = 8, rate_hz: int = 500_000_000) -> None:
        s = bench.spcm
        self.bench = bench
        self.rate_hz = rate_hz
        self.n_sent = 0
        bench.outputs()
        bench.card.set_i(s.SPC_TRIG_ORMASK, s.SPC_TMASK_SOFTWARE)
        bench.card.card_mode(s.SPC_REP_FIFO_SINGLE)
        bench.card.loops(0)
        bench.card.timeout(1000 * s.units.ms)
        bench.card.set_i(s.SPC_SAMPLERATE, rate_hz)
        self.transfer = s.DataTransfer(bench.card)
        self.transfer.allocate_buffer(n_blocks * NOTIFY)

    def define(self) -> None:
        self.transfer.start_buffer_transfer(notify_samples=NOTIFY)

    def fill(self, n_blocks: int) -> None:
        """Write blocks where the card says that there is room, and hand them over."""
        for _ in range(n_blocks):
            position = self.transfer.avail_user_pos()
            self.n_sent += 1
            self.transfer.buffer[:, position : position + NOTIFY] = self.n_sent
            self.transfer.avail_card_len(NOTIFY)

    def start(self, n_blocks: int) -> None:
        s = self.bench.spcm
        self.define()
        self.fill(n_blocks)
        self.bench.card.cmd(s.M2CMD_DATA_STARTDMA, s.M2CMD_DATA_WAITDMA)
        self.bench.card.start(s.M2CMD_CARD_ENABLETRIGGER)


def heard(bench, channel: int = 0) -> np.ndarray:
    return np.concatenate([span.values() for span in bench.sim.played(channel)])


def test_a_stream_is_played_in_order_without_a_gap(bench):
    stream = Stream(bench)
    stream.start(8)
    for _ in range(40):
        stream.transfer.wait_dma()
        stream.fill(stream.transfer.avail_user_len() // NOTIFY)
    bench.card.stop()
    values = heard(bench)
    assert stream.n_sent >= 40
    assert np.array_equal(values, (np.arange(len(values)) // NOTIFY + 1).astype(np.int16))
    spans = bench.sim.played(1)
    for before, after in itertools.pairwise(spans):
        assert after.start_s == pytest.approx(before.end_s, abs=1e-12)


def test_an_underrun_stops_the_output_and_is_reported_by_the_next_wait(bench):
    s = bench.spcm
    stream = Stream(bench)
    stream.start(4)
    start_s = bench.clock.now()
    bench.clock.sleep(5e-3)
    assert bench.card.status() & s.M2STAT_DATA_OVERRUN
    assert not bench.sim.running
    values = heard(bench)
    assert len(values) == 4 * NOTIFY
    assert bench.sim.played(0)[-1].end_s == pytest.approx(
        start_s + FIFO_DELAY_S + 4 * NOTIFY / 500e6, abs=1e-9
    )
    with pytest.raises(s.SpcmException, match="underrun"):
        stream.transfer.wait_dma()
    assert bench.sim.write(s.SPC_M2CMD, s.M2CMD_CARD_WAITREADY) == s.ERR_FIFOHWOVERRUN


def test_after_an_underrun_a_new_stream_can_be_played(bench):
    stream = Stream(bench)
    stream.start(2)
    bench.clock.sleep(1e-3)
    assert not bench.sim.running
    n_before = len(heard(bench))
    bench.card.stop()
    stream.start(8)
    bench.clock.sleep(5 * NOTIFY / 500e6)
    assert bench.sim.running
    assert len(heard(bench)) > n_before + 4 * NOTIFY


def test_two_channels_at_full_rate_outrun_the_bus(bench):
    s = bench.spcm
    stream = Stream(bench, n_blocks=64, rate_hz=1_250_000_000)
    bench.card.set_i(s.SPC_DATA_OUTBUFSIZE, 64 * 1024)
    stream.start(64)
    start_s = bench.clock.now()

    def feed() -> None:
        for _ in range(1000):
            stream.transfer.wait_dma()
            stream.fill(stream.transfer.avail_user_len() // NOTIFY)

    with pytest.raises(s.SpcmException, match="underrun"):
        feed()
    stored_s = 64 * 1024 / (5e9 - BUS)
    assert bench.clock.now() - start_s < 10 * stored_s
    bench.clock.sleep(0.05)
    assert not bench.sim.running


def test_a_bounded_stream_ends_by_itself(bench):
    s = bench.spcm
    stream = Stream(bench)
    bench.card.set_i(s.SPC_SEGMENTSIZE, NOTIFY)
    bench.card.loops(6)
    stream.start(8)
    start_s = bench.clock.now()
    bench.card.cmd(s.M2CMD_CARD_WAITREADY)
    assert bench.clock.now() - start_s == pytest.approx(FIFO_DELAY_S + 6 * NOTIFY / 500e6)
    assert bench.card.status() & (s.M2STAT_CARD_READY | s.M2STAT_DATA_OVERRUN) == s.M2STAT_CARD_READY
    assert np.array_equal(np.unique(heard(bench)), np.arange(1, 7))


def test_the_buffer_is_free_again_in_whole_blocks_and_the_fill_level_comes_in_sixteenths(bench):
    s = bench.spcm
    stream = Stream(bench)
    bench.card.set_i(s.SPC_DATA_OUTBUFSIZE, 64 * 1024)
    stream.define()
    stream.fill(8)
    assert stream.transfer.avail_user_len() == 0
    bench.card.cmd(s.M2CMD_DATA_STARTDMA)
    bench.clock.sleep(1.5 * 16384 / BUS)
    assert stream.transfer.avail_user_len() == NOTIFY
    assert stream.transfer.fill_size_promille() == 375
    bench.clock.sleep(1.0)
    assert stream.transfer.fill_size_promille() == 1000
    assert stream.transfer.avail_user_len() == 4 * NOTIFY


def test_more_than_is_free_and_a_start_without_a_buffer_are_refused(bench):
    s = bench.spcm
    stream = Stream(bench)
    assert bench.sim.write(s.SPC_M2CMD, s.M2CMD_CARD_START) == s.ERR_SEQUENCE
    bench.sim.take_error()
    assert bench.sim.write(s.SPC_DATA_AVAIL_CARD_LEN, 16) == s.ERR_SEQUENCE
    bench.sim.take_error()
    stream.define()
    stream.fill(8)
    with pytest.raises(s.SpcmException, match="expected 0 to 0 bytes"):
        stream.transfer.avail_card_len(NOTIFY)


def test_card_and_transfer_cannot_be_started_together(bench):
    s = bench.spcm
    stream = Stream(bench)
    stream.define()
    stream.fill(1)
    code = bench.sim.write(s.SPC_M2CMD, s.M2CMD_CARD_START | s.M2CMD_DATA_STARTDMA)
    assert code == s.ERR_SEQUENCE


def test_a_wait_for_room_that_never_comes_times_out(bench):
    s = bench.spcm
    stream = Stream(bench)
    bench.card.set_i(s.SPC_DATA_OUTBUFSIZE, 16 * 1024)
    stream.define()
    stream.fill(8)
    bench.card.cmd(s.M2CMD_DATA_STARTDMA, s.M2CMD_DATA_WAITDMA)
    stream.fill(1)
    with pytest.raises(s.SpcmTimeout):
        stream.transfer.wait_dma()


@given(
    st.lists(st.floats(1e-7, 1e-4), min_size=1, max_size=20),
    st.integers(0, 60),
    st.sampled_from([1024, 16 * 1024, 2**20]),
)
def test_looking_more_often_changes_nothing(pauses_s, n_frames, room_bytes):
    """The flow of bytes depends on time alone, not on how often somebody asks."""
    ring = np.zeros(3 * 4096, np.int16)
    start = -ring.ctypes.data % 4096
    store = Store()

    def stream() -> Fifo:
        fifo = Fifo(Buffer(ring.ctypes.data + start, 0, 8192, 0), 2, 625e6, room_bytes, BUS, store)
        fifo.hand_over(n_frames * 128)
        fifo.start_dma(0.0)
        fifo.trigger(1e-6)
        return fifo

    often, once, now_s = stream(), stream(), 0.0
    for pause_s in pauses_s:
        now_s += pause_s
        often.advance(now_s)
    once.advance(now_s)
    assert [often.failed, often.user_bytes] == [once.failed, once.user_bytes]
    assert sum(part.n_samples for part in often.played(now_s)) == pytest.approx(
        sum(part.n_samples for part in once.played(now_s)), abs=1
    )


def values(spans: list[RfSpan]) -> np.ndarray[tuple[int], np.dtype[np.int16]]:
    """The samples of spans that follow one another without a gap."""
    sampled = [span for span in spans if isinstance(span, RfSamples)]
    assert len(sampled) == len(spans)
    for before, after in itertools.pairwise(sampled):
        assert after.start_s == pytest.approx(before.end_s, abs=1e-12)
    return np.concatenate([span.samples for span in sampled])


@pytest.mark.parametrize("mode", ["replay", "fifo"])
def test_samples_are_reported_in_pieces_that_fit_together(driver: Any, mode: str) -> None:
    with driver(mode) as lab:
        lab.play(lab.program(1))
        expected = [lab.samples(channel) for channel in (0, 1)]
        start_s = lab.card.played(0)[0].start_s
        outputs = CardOutputs(lab.card, row_channel=0)
        received: tuple[list[RfSpan], list[RfSpan]] = ([], [])
        for until_s in (start_s - 1e-3, start_s + 0.61234567e-3, start_s + 0.7e-3, start_s + 1.0):
            for axis, spans in zip(received, outputs.played(until_s), strict=True):
                axis += spans
        for axis, samples in zip(received, expected, strict=True):
            np.testing.assert_array_equal(values(axis), samples)
        assert outputs.played(start_s + 2.0) == ([], [])
        assert lab.card.played(0) == []


def test_the_row_output_comes_first(driver: Any) -> None:
    with driver("replay", row_channel=1, column_channel=0) as lab:
        lab.play(lab.program(1))
        rows, columns = lab.samples(1), lab.samples(0)
        received = CardOutputs(lab.card, row_channel=1).played(lab.clock.now())
        np.testing.assert_array_equal(values(received[0]), rows)
        np.testing.assert_array_equal(values(received[1]), columns)


def test_tones_are_cosines_in_volts(driver: Any) -> None:
    with driver("dds") as lab:
        lab.play(lab.program(1))
        played = [span for span in lab.card.played(0) if span.tones]
        received = [
            span for span in CardOutputs(lab.card, 0).played(lab.clock.now())[0] if isinstance(span, RfTones)
        ]
        assert len(received) == len(played) > 5
        for span, heard in zip(played, received, strict=True):
            t_s = np.linspace(0, span.end_s - span.start_s, 50, endpoint=False)
            expected = sum(tone.values(t_s) for tone in span.tones) * span.amplitude_v
            turns = heard.frequency_hz[:, None] * t_s + heard.frequency_slope[:, None] * t_s**2 / 2
            volts = heard.amplitude_v[:, None] + heard.amplitude_slope[:, None] * t_s
            waves = volts * np.cos(2 * np.pi * turns + heard.phase_rad[:, None])
            np.testing.assert_allclose(waves.sum(axis=0), expected, atol=1e-7)
