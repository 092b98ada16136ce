"""The simulated Spectrum card plays from its memory: samples, triggers, amplifier, sequences."""

from __future__ import annotations

import itertools
import threading

import numpy as np
import pytest
from labseq_spcm.simulator import SimulatedCard, installed, registers, trigger_delay_s

from labseq.testing.fakes import FakeClock

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


def test_each_trigger_restarts_the_replay_until_all_loops_are_played(bench):
    s, samples = bench.spcm, sines(6400, 80e6, 100e6)
    bench.outputs()
    bench.external_trigger()
    bench.card.card_mode(s.SPC_REP_STD_SINGLERESTART)
    bench.card.loops(2)
    bench.upload(samples)
    bench.card.start(s.M2CMD_CARD_ENABLETRIGGER)
    starts_s: list[float] = []
    for _ in range(2):
        assert bench.sim.running
        starts_s.append(bench.clock.now())
        assert bench.sim.trigger()
        assert bench.sim.trigger()  # heard, but it plays already
        bench.clock.sleep(1e-3)
    assert not bench.sim.running
    assert not bench.sim.trigger()
    spans = bench.sim.played(0)
    assert [span.start_s for span in spans] == pytest.approx([t + DELAY_S for t in starts_s], abs=1e-12)
    assert all(np.array_equal(span.values(), samples[0]) for span in spans)


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


def test_the_trigger_takes_its_time_to_the_output():
    assert trigger_delay_s(1.25e9) == pytest.approx(397e-9, abs=0.5e-9)
    assert trigger_delay_s(625e6) == pytest.approx(DELAY_S)


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
    bench.card.card_mode(s.SPC_REP_STD_SINGLERESTART)
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


class Sequencer:
    """A sequence of one waiting step and one that ends it."""

    def __init__(self, bench) -> None:
        s = bench.spcm
        bench.outputs()
        bench.external_trigger()
        bench.card.card_mode(s.SPC_REP_STD_SEQUENCE)
        bench.card.set_i(s.SPC_SAMPLERATE, int(RATE_HZ))
        self.sequence = s.Sequence(bench.card)
        self.hold = self.sequence.add_segment(384)
        self.move = self.sequence.add_segment(768)
        self.hold[:] = 1
        self.move[:] = 2
        first = self.sequence.add_step(self.hold, loops=3)
        last = self.sequence.add_step(self.move, loops=2)
        first.set_transition(last, on_trig=True)
        last.final_step()
        self.sequence.entry_step(first)
        self.sequence.write_setup()
        bench.card.start(s.M2CMD_CARD_ENABLETRIGGER)


def test_a_sequence_waits_in_its_step_for_the_trigger_and_then_ends(bench):
    sequencer = Sequencer(bench)
    start_s = bench.clock.now()
    bench.sim.trigger()
    bench.clock.sleep(1e-3)
    assert sequencer.sequence.status() == 0
    bench.sim.trigger()
    bench.card.cmd(bench.spcm.M2CMD_CARD_WAITREADY)
    hold, move = bench.sim.played(0)
    assert hold.start_s == pytest.approx(start_s + DELAY_S, abs=1e-12)
    assert set(hold.values().tolist()) == {1}
    assert hold.n_samples % (3 * 384) == 0
    assert hold.end_s - start_s == pytest.approx(1e-3, abs=4 * 384 / RATE_HZ)
    assert (move.values().tolist(), move.start_s) == ([2] * 1536, pytest.approx(hold.end_s, abs=1e-12))
    assert bench.clock.now() == pytest.approx(move.end_s, abs=1e-8)


def test_a_segment_written_in_time_is_played_and_one_that_comes_late_is_not(bench):
    sequencer = Sequencer(bench)
    bench.sim.trigger()
    bench.clock.sleep(1e-4)
    sequencer.move[:] = 7
    sequencer.sequence.transfer_segment(sequencer.move)
    bench.sim.trigger()
    bench.card.cmd(bench.spcm.M2CMD_CARD_WAITREADY)
    sequencer.move[:] = 8
    sequencer.sequence.transfer_segment(sequencer.move)
    assert set(bench.sim.played(1)[-1].values().tolist()) == {7}


def test_a_step_with_no_loops_or_no_segment_is_refused(bench):
    s = bench.spcm
    bench.card.set_i(s.SPC_SEQMODE_MAXSEGMENTS, 4)
    for entry in (0, 1 << 32 | 4):
        assert bench.sim.write(s.SPC_SEQMODE_STEPMEM0, entry) == s.ERR_VALUE
        bench.sim.take_error()


def test_the_card_is_gone_after_its_block():
    clock = FakeClock()
    with installed(SimulatedCard(clock)) as name:
        import spcm
    card = spcm.Card(name)
    with pytest.raises(spcm.SpcmDeviceNotFound):
        card.open()
    card._closed = True
