"""FIFO mode of the simulated Spectrum card: played while it is streamed, on a virtual clock."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, strategies as st
from labseq_spcm.simulator.fifo import Fifo
from labseq_spcm.simulator.memory import Buffer
from labseq_spcm.simulator.store import Store

BUS = 2.8e9
NOTIFY = 4096
"""Samples per channel and block."""
DELAY_S = 238.5 / 500e6 + 16e-9


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


def test_the_clock_consumes_the_data(bench):
    stream = Stream(bench)
    stream.start(8)
    bench.clock.sleep(DELAY_S + 3 * NOTIFY / 500e6)
    assert len(heard(bench)) == pytest.approx(3 * NOTIFY, abs=1)
    assert bench.sim.running


def test_an_underrun_stops_the_output_and_is_told_by_the_next_wait(bench):
    s = bench.spcm
    stream = Stream(bench)
    stream.start(4)
    start_s = bench.clock.now()
    bench.clock.sleep(5e-3)
    assert bench.card.status() & s.M2STAT_DATA_OVERRUN
    assert not bench.sim.running
    values = heard(bench)
    assert len(values) == 4 * NOTIFY
    assert bench.sim.played(0)[-1].end_s == pytest.approx(start_s + DELAY_S + 4 * NOTIFY / 500e6, abs=1e-9)
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
    assert bench.clock.now() - start_s == pytest.approx(DELAY_S + 6 * NOTIFY / 500e6)
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
