"""Faults of ``spcm`` 1.13.4, each shown with the real package; the driver must work around them.

A test that fails here after an upgrade of ``spcm`` is good news: the fault is mended, and the
driver's work-around can go.
"""

from __future__ import annotations

import gc
import inspect

import pytest
from labseq_spcm.simulator import SimulatedCard, installed, registers as r


def commands(bench) -> list[int]:
    """The DDS commands that reached the driver."""
    return [int(entry.value) for entry in bench.sim.log if entry.register == r.SPC_DDS_CMD]


def test_two_cards_share_the_map_from_cores_to_channels(bench):
    s = bench.spcm
    with installed(SimulatedCard(bench.clock, serial_number=2)) as name, s.Card(name) as other:
        shared = dict(s.DDS._channel_from_core)
        try:
            first = s.DDS(bench.card, channels=bench.outputs())
            second = s.DDS(other)
            assert first._channel_from_core is second._channel_from_core
            assert second[0].channel.card.sn() == 12345  # core 0 of one card, channel of the other
        finally:
            s.DDS._channel_from_core.clear()
            s.DDS._channel_from_core.update(shared)


def test_wait_if_full_never_waits(bench, monkeypatch):
    def looked() -> int:
        raise AssertionError("it looks at the queue now: the fault is mended")

    s = bench.spcm
    queue = s.DDSCommandList(bench.card)
    queue.mode = queue.WRITE_MODE.WAIT_IF_FULL
    value = {s.SPC_DDS_CORE0_AMP: [0.1]}
    for _ in range(4):
        queue.load(value, repeat=1000)
        queue.write()
    assert queue.avail_user_len() < queue.current_index
    queue.load(value, repeat=1000)
    with monkeypatch.context() as patch:
        patch.setattr(queue, "avail_user_len", looked)
        queue.write()  # nobody empties the queue: a wait would never return
    assert queue.status() & r.SPCM_DDS_STAT_QUEUE_OVERRUN


def test_a_command_list_sends_single_commands_straight_to_the_card(bench):
    queue = bench.spcm.DDSCommandList(bench.card)
    n_writes = len(bench.sim.log)
    queue.freq(0, 80e6)
    assert len(bench.sim.log) == n_writes + 1
    assert queue.current_index == 0


def test_a_command_queue_flushes_in_the_middle_of_a_block(bench):
    queue = bench.spcm.DDSCommandQueue(bench.card)
    queue.reset()
    for core in range(queue.list_size - 1):
        queue.set_d(r.SPC_DDS_CORE0_FREQ + core % 8, 80e6)
    assert r.SPCM_DDS_CMD_WRITE_TO_CARD not in commands(bench)
    queue.set_d(r.SPC_DDS_CORE0_FREQ, 80e6)
    assert commands(bench)[-1] == r.SPCM_DDS_CMD_WRITE_TO_CARD
    assert r.SPCM_DDS_CMD_EXEC_AT_TRG not in commands(bench)


def test_register_list_has_room_for_1024_entries_and_does_not_look(bench):
    s = bench.spcm
    entry = {"lReg": s.SPC_DDS_CORE0_AMP, "lType": 1, "dValue": 0.5}
    bench.card.register_list([entry] * 1024)
    assert bench.card.get_d(s.SPC_DDS_CORE0_AMP) == pytest.approx(0.5, abs=1e-4)
    source = inspect.getsource(s.Card.register_list)
    assert "ST_LIST_PARAM * 1024" in source  # one more would be written behind the end
    assert "1024" not in source.replace("ST_LIST_PARAM * 1024", "")


def test_without_exceptions_a_refused_write_makes_all_later_ones_vanish(bench):
    s = bench.spcm
    with installed(SimulatedCard(bench.clock)) as name:
        quiet = s.Card(name, throw_error=False).open()
        quiet.set_i(s.SPC_SAMPLERATE, 5 * 10**9)
        quiet.set_i(s.SPC_AMP0, 700)
        quiet.get_error_info()
        assert quiet.get_i(s.SPC_AMP0) == 1000
        quiet.close()


def test_a_card_with_a_pending_error_cannot_be_closed_and_stays_in_use(bench):
    import spcm_core

    s = bench.spcm
    spcm_core.spcm_dwSetParam_i64(bench.card.handle(), s.SPC_AMP0, 9000)  # nobody looks at the answer
    with pytest.raises(s.SpcmException, match="9000"):
        bench.card.close()
    again = s.Card(bench.name)
    with pytest.raises(s.SpcmDeviceNotFound):
        again.open()
    again._closed = True


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_the_destructor_of_a_card_that_was_never_found_raises(bench, monkeypatch):
    import sys

    raised: list[str] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda report: raised.append(str(report.exc_type.__name__)))
    missing = bench.spcm.Card("simulated, but not installed")
    with pytest.raises(bench.spcm.SpcmDeviceNotFound):
        missing.open()
    assert not missing._closed
    del missing
    gc.collect()
    assert raised == ["SpcmException"]


def test_open_with_a_name_returns_nothing_and_learns_nothing(bench):
    with installed(SimulatedCard(bench.clock)) as name:
        card = bench.spcm.Card()
        assert card.open(name) is None
        assert (card.product_name(), card.max_sample_value()) == ("", 0)
        card.close()


def test_a_sequence_with_one_segment_cannot_be_written(bench):
    s = bench.spcm
    bench.card.card_mode(s.SPC_REP_STD_SEQUENCE)
    sequence = s.Sequence(bench.card)
    sequence.add_segment(384)
    with pytest.raises(s.SpcmException, match="SPC_SEQMODE_MAXSEGMENTS"):
        sequence.write_setup()


def test_a_step_has_no_loops_unless_it_is_told_which_the_card_refuses(bench):
    s = bench.spcm
    bench.card.card_mode(s.SPC_REP_STD_SEQUENCE)
    sequence = s.Sequence(bench.card)
    segments = [sequence.add_segment(384) for _ in range(2)]
    sequence.add_step(segments[0])
    with pytest.raises(s.SpcmException, match="at least one loop"):
        sequence.write_setup()


def test_the_flags_of_the_last_step_are_read_back_negative(bench):
    s = bench.spcm
    bench.card.card_mode(s.SPC_REP_STD_SEQUENCE)
    sequence = s.Sequence(bench.card)
    *_, flags = sequence.step_memory(3, 0, 1, 1, s.SPCSEQ_END)
    assert flags == s.SPCSEQ_END - 2**32
