"""DDS commands of the simulated Spectrum card that come as lists, and by DMA."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from labseq_spcm.simulator import M4I6631, CardModel, LogEntry, SimulatedCard, ToneSpan, registers as r
from labseq_spcm.simulator.calls import LIST_PARAM, list_writes
from labseq_spcm.simulator.records import Log
from numpy.typing import NDArray

from labseq.testing.fakes import FakeClock

Write = tuple[int, float]


def entries(writes: list[Write]) -> NDArray[np.void]:
    """A register list; integers where the card wants them."""
    made = np.zeros(len(writes), LIST_PARAM)
    for entry, (register, value) in zip(made, writes, strict=True):
        whole = register in (r.SPC_DDS_CMD, r.SPC_DDS_TRG_SRC, r.SPC_TIMEOUT)
        entry["register"], entry["type"] = register, r.TYPE_INT64 if whole else r.TYPE_DOUBLE
        entry["value"] = int(value) if whole else np.float64(value).view(np.int64)
    return made


def synthesizer(by_dma: bool = False, model: CardModel = M4I6631) -> tuple[SimulatedCard, FakeClock]:
    """A card in DDS mode with its outputs on."""
    clock = FakeClock()
    card = SimulatedCard(clock, model=model)
    card.write(r.SPC_CARDMODE, r.SPC_REP_STD_DDS)
    card.write(r.SPC_DDS_DATA_TRANSFER_MODE, int(by_dma))
    card.write(r.SPC_ENABLEOUT0, 1)
    card.write(r.SPC_ENABLEOUT1, 1)
    clock.sleep(0.02)
    return card, clock


REASONABLE = st.one_of(
    st.tuples(st.sampled_from([603000, 603007, 603020]), st.floats(0, 625e6)),
    st.tuples(st.sampled_from([604000, 604012]), st.floats(-1e13, 1e13)),
    st.tuples(st.sampled_from([605000, 605007, 605020]), st.floats(-1, 1)),
    st.tuples(st.sampled_from([606000, 606012]), st.floats(-3e5, 3e5)),
    st.tuples(st.sampled_from([607000, 607020]), st.floats(-1e4, 1e4)),
    st.tuples(st.just(r.SPC_DDS_TRG_TIMER), st.floats(1e-7, 1e-3)),
    st.tuples(st.just(r.SPC_DDS_TRG_SRC), st.sampled_from([1.0, 2.0])),
    st.tuples(st.just(r.SPC_DDS_CMD), st.sampled_from([2.0, 2.0, 8.0])),
)
WRONG: list[Write] = [
    (603000, -1.0),
    (603000, float("nan")),
    (605001, 1.5),
    (607003, float("inf")),
    (603040, 80e6),
    (r.SPC_DDS_TRG_TIMER, 1e-9),
    (r.SPC_DDS_CMD, float(r.SPCM_DDS_CMD_EXEC_NOW)),
    (r.SPC_DDS_CMD, float(r.SPCM_DDS_CMD_RESET)),
    (r.SPC_DDS_NUM_CORES, 3.0),
    (r.SPC_TIMEOUT, 5.0),
]


@given(st.lists(REASONABLE, max_size=40), st.one_of(st.none(), st.sampled_from(WRONG)), st.integers(0, 40))
def test_a_list_does_what_its_writes_do_one_by_one(
    writes: list[Write], wrong: Write | None, place: int
) -> None:
    if wrong is not None:
        writes.insert(place, wrong)
    seen: list[Any] = []
    for at_once in (True, False):
        card, clock = synthesizer()
        made = entries(writes)
        code = card.write_list(made) if at_once else card.write_all(list_writes(made))
        logged = [(entry.register, float(entry.value)) for entry in card.log]
        error = replace(card.take_error(), value=0)
        values = [card.read(register) for register in (603000, 604012, 605007, 607020, r.SPC_DDS_TRG_TIMER)]
        card.write(r.SPC_M2CMD, r.M2CMD_CARD_START | r.M2CMD_CARD_ENABLETRIGGER)
        for _ in range(3):
            card.write(r.SPC_M2CMD, r.M2CMD_CARD_FORCETRIGGER)
            clock.sleep(1e-4)
        state = [card.read(register) for register in (r.SPC_DDS_STATUS, r.SPC_DDS_QUEUE_CMD_COUNT)]
        seen.append([code, error, values, state, card.played(0), card.played(1), repr(logged)])
    assert seen[0] == seen[1]


def test_a_list_is_kept_waiting_as_its_writes_are() -> None:
    card, clock = synthesizer()
    start_s = clock.now()
    writes: list[Write] = [(603000, 80e6)] * 400 + [(r.SPC_DDS_CMD, 2), (r.SPC_DDS_CMD, 8)]
    assert card.write_list(entries(writes)) == r.ERR_OK
    assert clock.now() - start_s == pytest.approx(1e-3)  # 400,000 commands a second


def test_a_list_for_a_locked_driver_is_lost() -> None:
    card, _ = synthesizer()
    card.write(r.SPC_AMP0, 9000)
    assert card.write_list(entries([(603000, 80e6)])) == r.ERR_LASTERR


def test_a_block_waits_for_its_trigger_only_when_all_of_it_has_arrived() -> None:
    card, clock = synthesizer(by_dma=True)
    writes: list[Write] = [(603000, 80e6)] * 1000 + [(605000, 0.5), (r.SPC_DDS_CMD, 2), (r.SPC_DDS_CMD, 8)]
    card.write_list(entries(writes))
    card.write(r.SPC_M2CMD, r.M2CMD_CARD_START)
    arrival_s = clock.now() + 1001 / 10e6 + 20e-6
    clock.sleep(arrival_s - clock.now() - 1e-6)
    assert card.read(r.SPC_DDS_STATUS) == (r.ERR_OK, 0)
    clock.sleep(2e-6)
    assert card.read(r.SPC_DDS_STATUS) == (r.ERR_OK, r.SPCM_DDS_STAT_WAITING_FOR_TRG)


def test_a_trigger_before_the_block_has_arrived_is_an_underrun() -> None:
    card, clock = synthesizer(by_dma=True)
    card.write_list(entries([(603000, 80e6), (605000, 0.5), (r.SPC_DDS_CMD, 2), (r.SPC_DDS_CMD, 8)]))
    card.write(r.SPC_M2CMD, r.M2CMD_CARD_START | r.M2CMD_CARD_ENABLETRIGGER | r.M2CMD_CARD_FORCETRIGGER)
    assert card.read(r.SPC_DDS_STATUS) == (r.ERR_OK, r.SPCM_DDS_STAT_QUEUE_UNDERRUN)
    clock.sleep(1e-3)
    assert card.played(0) == []


def test_cards_with_fewer_cores_play_what_they_have() -> None:
    card, clock = synthesizer(model=replace(M4I6631, n_dds_cores=8))
    card.write_list(entries([(603007, 80e6), (605007, 0.5), (r.SPC_DDS_CMD, 2), (r.SPC_DDS_CMD, 8)]))
    card.write(r.SPC_M2CMD, r.M2CMD_CARD_START | r.M2CMD_CARD_ENABLETRIGGER | r.M2CMD_CARD_FORCETRIGGER)
    clock.sleep(1e-3)
    (span,) = card.played(0)
    assert isinstance(span, ToneSpan)
    assert [tone.core for tone in span.tones] == [7]
    assert card.write_list(entries([(603008, 80e6)])) == r.ERR_REG


class TestLog:
    def test_gives_writes_in_order_and_one_by_one(self) -> None:
        log = Log(100)
        log.add(1.0, [5], [7])
        log.add(2.0, [6, 8], [0.5, 0.25])
        assert list(log) == [LogEntry(1.0, 5, 7), LogEntry(2.0, 6, 0.5), LogEntry(2.0, 8, 0.25)]
        assert len(log) == 3

    def test_forgets_the_oldest_calls(self) -> None:
        log = Log(3)
        for k in range(10):
            log.add(float(k), [k], [k])
        assert [entry.register for entry in log] == [7, 8, 9]

    def test_can_be_cleared(self) -> None:
        log = Log(3)
        log.add(0.0, [1], [1])
        log.clear()
        assert (len(log), list(log)) == (0, [])
