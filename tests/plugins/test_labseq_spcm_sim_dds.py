"""The DDS of the simulated Spectrum card: values, lists, queue, triggers and timer."""

from __future__ import annotations

import ctypes
import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from labseq_spcm_sim import M4I6631, CardModel, LogEntry, SimulatedCard, ToneSpan, registers as r
from labseq_spcm_sim.card import LIST_PARAM, Log, list_writes
from labseq_spcm_sim.setup import DDS_TIMER_STEP_S, DDS_TRIGGER_DELAY_S
from numpy.typing import NDArray

from labseq.testing.fakes import FakeClock


class Synthesizer:
    """The DDS of a bench: the trigger comes from the card, the outputs are on."""

    def __init__(self, bench) -> None:
        s = bench.spcm
        self.bench = bench
        self.s = s
        bench.outputs()
        bench.external_trigger()
        bench.card.card_mode(s.SPC_REP_STD_DDS)
        self.dds = s.DDS(bench.card)
        self.dds.reset()

    def block(self, source: int | None = None, period_s: float | None = None, **core: float) -> None:
        """One block for core 0."""
        if source is not None:
            self.dds.trg_src(source)
        if period_s is not None:
            self.dds.trg_timer(period_s)
        for name, value in core.items():
            getattr(self.dds[0], name)(value)
        self.dds.exec_at_trg()

    def start(self, *commands: int) -> None:
        self.dds.write_to_card()
        self.bench.card.start(self.s.M2CMD_CARD_ENABLETRIGGER, *commands)

    def tone(self):
        """What core 0 does in the last span."""
        return self.bench.sim.played(0)[-1].tones[0]


def test_a_block_waits_in_the_shadow_registers_for_its_trigger(bench):
    synthesizer = Synthesizer(bench)
    synthesizer.block(freq=80e6, amp=0.1, phase=90.0)
    synthesizer.block(freq_slope=5e9)
    synthesizer.block(freq=90e6, freq_slope=0.0)
    assert synthesizer.dds.queue_cmd_count() == 0
    assert bench.card.get_i(synthesizer.s.SPC_DDS_NUM_QUEUED_CMD_IN_SW) == 6
    synthesizer.start()
    assert synthesizer.dds.queue_cmd_count() == 3  # the first block is in the shadow registers
    assert bench.sim.played(0) == []
    bench.sim.trigger()
    start_s = bench.clock.now() + DDS_TRIGGER_DELAY_S
    bench.clock.sleep(1e-3)
    (span,) = bench.sim.played(0)
    assert (span.start_s, span.end_s) == (pytest.approx(start_s, abs=1e-12), bench.clock.now())
    assert span.amplitude_v == 0.5
    assert span.tones[0].frequency_hz == pytest.approx(80e6, abs=0.15)
    assert span.tones[0].amplitude == pytest.approx(0.1, abs=1e-4)
    assert span.tones[0].phase_rad == pytest.approx(np.pi / 2)
    assert synthesizer.dds.queue_cmd_count() == 2
    bench.sim.trigger()
    bench.clock.sleep(1e-3)
    bench.sim.trigger()
    bench.clock.sleep(1e-3)
    _, ramp, end = bench.sim.played(0)
    assert ramp.tones[0].frequency_slope == pytest.approx(5e9, rel=1e-6)
    assert ramp.tones[0].after(ramp.end_s - ramp.start_s).frequency_hz == pytest.approx(85e6, rel=1e-6)
    assert end.tones[0].frequency_hz == pytest.approx(90e6, abs=0.15)


def test_the_phase_goes_on_where_only_frequency_or_slope_change(bench):
    synthesizer = Synthesizer(bench)
    synthesizer.block(freq=80e6, amp=0.5)
    synthesizer.block(freq_slope=1e9)
    synthesizer.block(freq=81e6, freq_slope=0.0)
    synthesizer.start()
    for _ in range(3):
        bench.sim.trigger()
        bench.clock.sleep(123e-6)
    spans = bench.sim.played(0)
    for before, after in itertools.pairwise(spans):
        end = before.tones[0].after(before.end_s - before.start_s)
        assert np.exp(1j * end.phase_rad) == pytest.approx(np.exp(1j * after.tones[0].phase_rad), abs=1e-6)


def test_the_phase_jumps_or_shifts_as_it_is_set(bench):
    for behaviour, expected_deg in ((0, 90.0), (1, 90.0 - 30.0)):
        synthesizer = Synthesizer(bench)
        synthesizer.dds.phase_behaviour(behaviour)
        synthesizer.block(freq=0.0, amp=0.5, phase=30.0)
        synthesizer.block(phase=90.0)
        synthesizer.start()
        bench.sim.trigger()
        bench.clock.sleep(1e-3)
        before = synthesizer.tone()
        bench.sim.trigger()
        bench.clock.sleep(1e-3)
        start_rad = before.phase_rad if behaviour else 0.0
        shift_deg = np.degrees(synthesizer.tone().phase_rad - start_rad)
        assert shift_deg == pytest.approx(expected_deg, abs=0.1)
        bench.card.stop()


def test_each_block_carries_the_timer_that_leads_to_the_next_event(bench):
    synthesizer = Synthesizer(bench)
    timer, card = synthesizer.s.SPCM_DDS_TRG_SRC_TIMER, synthesizer.s.SPCM_DDS_TRG_SRC_CARD
    synthesizer.block(timer, 100e-6, freq=80e6, amp=0.5)
    synthesizer.block(timer, 300e-6, freq=81e6)
    synthesizer.block(card, freq=82e6)
    synthesizer.block(amp=0.0)
    synthesizer.start()
    bench.clock.sleep(1e-3)
    assert bench.sim.played(0) == []
    bench.sim.trigger()
    bench.clock.sleep(1e-3)
    lengths_s = [span.end_s - span.start_s for span in bench.sim.played(0)]
    assert lengths_s[:2] == pytest.approx([100e-6, 300e-6], abs=DDS_TIMER_STEP_S)
    bench.sim.trigger()
    bench.clock.sleep(1e-3)
    assert len(bench.sim.played(0)) == 3
    assert bench.sim.played(0)[-1].end_s < bench.clock.now() - 0.9e-3
    assert not bench.card.get_i(r.SPC_DDS_STATUS) & r.SPCM_DDS_STAT_QUEUE_UNDERRUN


def test_the_trigger_count_is_one_short_but_its_differences_are_right(bench):
    synthesizer = Synthesizer(bench)
    for _ in range(4):
        synthesizer.block(freq=80e6)
    synthesizer.start()
    counts: list[int] = []
    for _ in range(4):
        bench.sim.trigger()
        counts.append(bench.card.get_i(r.SPC_DDS_TRG_COUNT))
    assert counts == [0, 1, 2, 3]


def test_a_trigger_before_the_block_is_there_sets_the_underrun_flag(bench):
    synthesizer = Synthesizer(bench)
    synthesizer.block(freq=80e6, amp=0.5)
    synthesizer.start()
    bench.sim.trigger()
    assert not synthesizer.dds.status() & r.SPCM_DDS_STAT_QUEUE_UNDERRUN
    bench.sim.trigger()
    assert synthesizer.dds.status() & r.SPCM_DDS_STAT_QUEUE_UNDERRUN


def test_the_timer_without_a_block_sets_the_underrun_flag_and_ticks_on(bench):
    synthesizer = Synthesizer(bench)
    timer = synthesizer.s.SPCM_DDS_TRG_SRC_TIMER
    synthesizer.block(timer, 1e-3, freq=80e6, amp=0.5)
    synthesizer.start()
    bench.sim.trigger()
    start_s = bench.clock.now() + DDS_TRIGGER_DELAY_S
    bench.clock.sleep(10.5e-3)
    assert synthesizer.dds.status() & r.SPCM_DDS_STAT_QUEUE_UNDERRUN
    synthesizer.block(freq=90e6)
    synthesizer.dds.write_to_card()
    bench.clock.sleep(1e-3)
    assert bench.sim.played(0)[-1].start_s == pytest.approx(start_s + 11e-3, abs=1e-7)


def test_the_software_trigger_burns_what_is_queued(bench):
    synthesizer = Synthesizer(bench)
    bench.card.set_i(r.SPC_TRIG_ORMASK, r.SPC_TMASK_SOFTWARE)
    for hz in (80e6, 81e6, 82e6):
        synthesizer.block(freq=hz, amp=0.5)
    synthesizer.start()
    bench.clock.sleep(1e-6)
    assert synthesizer.tone().frequency_hz == pytest.approx(82e6, abs=0.15)
    assert synthesizer.dds.status() & r.SPCM_DDS_STAT_QUEUE_UNDERRUN


def test_a_force_advances_by_one_step_whatever_the_mask(bench):
    synthesizer = Synthesizer(bench)
    bench.card.set_i(r.SPC_TRIG_ORMASK, r.SPC_TMASK_NONE)
    for hz in (80e6, 81e6):
        synthesizer.block(freq=hz, amp=0.5)
    synthesizer.start(r.M2CMD_CARD_FORCETRIGGER)
    bench.clock.sleep(1e-6)
    assert synthesizer.tone().frequency_hz == pytest.approx(80e6, abs=0.15)
    bench.card.cmd(r.M2CMD_CARD_FORCETRIGGER)
    bench.clock.sleep(1e-6)
    assert synthesizer.tone().frequency_hz == pytest.approx(81e6, abs=0.15)


def test_exec_now_needs_a_block_at_trigger_before_it_and_write_to_card_after_it(bench):
    synthesizer = Synthesizer(bench)
    bench.card.start(r.M2CMD_CARD_ENABLETRIGGER)
    with pytest.raises(synthesizer.s.SpcmException, match="the setup isn't valid"):
        synthesizer.dds.exec_now()
    synthesizer.block(freq=80e6, amp=0.5)
    synthesizer.dds.write_to_card()
    bench.sim.trigger()
    synthesizer.dds[0].freq(85e6)
    synthesizer.dds.exec_now()
    bench.clock.sleep(1e-4)
    assert synthesizer.tone().frequency_hz == pytest.approx(80e6, abs=0.15)
    synthesizer.dds.write_to_card()
    bench.clock.sleep(1e-4)
    assert synthesizer.tone().frequency_hz == pytest.approx(85e6, abs=0.15)


def test_a_trigger_that_overtakes_the_dma_finds_nothing(bench):
    synthesizer = Synthesizer(bench)
    bench.card.start(r.M2CMD_CARD_ENABLETRIGGER)
    synthesizer.dds.data_transfer_mode(r.SPCM_DDS_DTM_DMA)
    synthesizer.block(freq=80e6, amp=0.5)
    synthesizer.dds.write_to_card()
    bench.sim.trigger()
    assert synthesizer.dds.status() & r.SPCM_DDS_STAT_QUEUE_UNDERRUN
    bench.clock.sleep(1e-3)
    bench.sim.trigger()
    bench.clock.sleep(1e-3)
    assert synthesizer.tone().frequency_hz == pytest.approx(80e6, abs=0.15)


def test_a_queue_that_is_too_full_loses_blocks_and_says_so(bench):
    synthesizer = Synthesizer(bench)
    for _ in range(4100):
        synthesizer.block(freq=80e6)
    synthesizer.dds.write_to_card()
    assert synthesizer.dds.status() & r.SPCM_DDS_STAT_QUEUE_OVERRUN
    assert synthesizer.dds.queue_cmd_count() == synthesizer.dds.queue_cmd_max() - 1


def test_cores_play_on_the_channel_that_they_are_connected_to(bench):
    synthesizer = Synthesizer(bench)
    synthesizer.dds.cores_on_channel(1, 0xF00)
    for core in (0, 8, 20):
        synthesizer.dds[core].freq(80e6 + 1e6 * core)
        synthesizer.dds[core].amp(0.2)
    synthesizer.dds.exec_at_trg()
    synthesizer.start(r.M2CMD_CARD_FORCETRIGGER)
    bench.clock.sleep(1e-3)
    cores = [[tone.core for tone in bench.sim.played(channel)[0].tones] for channel in (0, 1)]
    assert cores == [[0], [8, 20]]


def test_the_output_has_the_tones_and_clips_where_they_add_up_to_more_than_full_scale(bench):
    synthesizer = Synthesizer(bench)
    for core in (0, 1):
        synthesizer.dds[core].freq(80e6 + 20e6 * core)
        synthesizer.dds[core].amp(0.7)
    synthesizer.dds.exec_at_trg()
    synthesizer.start(r.M2CMD_CARD_FORCETRIGGER)
    bench.clock.sleep(1e-4)
    volts = bench.sim.played(0)[0].volts(1.25e9)
    spectrum = np.abs(np.fft.rfft(volts))
    frequency_hz = np.fft.rfftfreq(len(volts), 1 / 1.25e9)
    for hz in (80e6, 100e6):
        near = np.abs(frequency_hz - hz) < 2e5
        assert spectrum[near].max() > 0.25 * spectrum.max()
    assert np.max(np.abs(volts)) == 0.5


def test_amplitude_ramps_reach_what_they_should(bench):
    synthesizer = Synthesizer(bench)
    synthesizer.block(freq=80e6, amp=0.0, amp_slope=5000.0)
    synthesizer.block(amp=0.5, amp_slope=0.0)
    synthesizer.start()
    bench.sim.trigger()
    bench.clock.sleep(100e-6)
    bench.sim.trigger()
    bench.clock.sleep(100e-6)
    ramp, _ = bench.sim.played(0)
    assert ramp.tones[0].after(100e-6).amplitude == pytest.approx(0.5, abs=0.02)


def test_a_stop_silences_and_a_new_start_begins_in_silence(bench):
    synthesizer = Synthesizer(bench)
    synthesizer.block(freq=80e6, amp=0.5)
    synthesizer.start(r.M2CMD_CARD_FORCETRIGGER)
    bench.clock.sleep(1e-3)
    bench.card.stop()
    stopped_s = bench.clock.now()
    bench.card.start(r.M2CMD_CARD_ENABLETRIGGER)
    bench.clock.sleep(1e-3)
    assert [span.end_s for span in bench.sim.played(0)] == [stopped_s]


def test_a_reset_while_running_ends_the_tones_and_keeps_what_was_played(bench):
    synthesizer = Synthesizer(bench)
    synthesizer.block(freq=80e6, amp=0.5)
    synthesizer.start(r.M2CMD_CARD_FORCETRIGGER)
    bench.clock.sleep(1e-3)
    synthesizer.dds.reset()
    reset_s = bench.clock.now()
    bench.clock.sleep(1e-3)
    assert [span.end_s for span in bench.sim.played(0)] == [reset_s]


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


@pytest.mark.parametrize(
    ("channel", "asked", "got", "other"),
    [
        (0, 1, 0xFF, 1 << 20),
        (0, 0xFFFFFF, 0xFFFFF, 1 << 20),
        (1, 0xF00, 0x100F00, 0xFF0FF),
        (1, 0, 1 << 20, 0xFFFFF),
        (1, 0x3, 1 << 20, 0xFFFFF),
    ],
)
def test_masks_that_the_chip_cannot_make_are_snapped_without_a_word(bench, channel, asked, got, other):
    dds = bench.spcm.DDS(bench.card)
    dds.cores_on_channel(channel, asked)
    assert dds.get_cores_on_channel(channel) == got
    assert dds.get_cores_on_channel(1 - channel) == other


@given(st.floats(83.2e-9, 27.48), st.floats(0, 625e6), st.floats(-1e12, 1e12))
def test_inexact_dds_values_are_rounded_and_read_back(timer_s, frequency_hz, slope):
    card = SimulatedCard(FakeClock())
    for register, value, step in (
        (r.SPC_DDS_TRG_TIMER, timer_s, 6.4e-9),
        (r.SPC_DDS_CORE0_FREQ, frequency_hz, 0.291038305),
        (r.SPC_DDS_CORE0_FREQ_SLOPE + 20, slope, 2775.5575616),
    ):
        assert card.write(register, value) == 0
        assert card.read(register)[1] == pytest.approx(value, abs=0.5001 * step)


def test_smaller_ramp_steps_make_finer_slopes(bench):
    bench.card.set_d(r.SPC_DDS_FREQ_RAMP_STEPSIZE, 1000.0)
    bench.card.set_d(r.SPC_DDS_CORE0_FREQ_SLOPE, 100.0)
    assert bench.card.get_d(r.SPC_DDS_CORE0_FREQ_SLOPE) == pytest.approx(100.0, abs=1.5)


def test_a_register_list_is_carried_out_up_to_the_first_refusal(bench):
    from spcm_core import ST_LIST_PARAM

    entries = (ST_LIST_PARAM * 3)()
    for entry, (register, amplitude) in zip(entries, ((0, 0.1), (1, 2.0), (2, 0.3)), strict=True):
        entry.lReg, entry.lType, entry.dValue = r.SPC_DDS_CORE0_AMP + register, 1, amplitude
    with pytest.raises(bench.spcm.SpcmException, match=r"value 2\.0 not allowed"):
        bench.card.set_ptr(r.SPC_REGISTER_LIST, entries, ctypes.sizeof(entries))
    got = [bench.card.get_d(r.SPC_DDS_CORE0_AMP + core) for core in range(3)]
    assert got == pytest.approx([0.1, 0.0, 0.0], abs=1e-4)


@pytest.mark.parametrize(("by_dma", "call_s"), [(False, 200 / 400e3), (True, 0.0)])
def test_writing_to_the_card_takes_its_time_in_single_mode_and_the_background_by_dma(bench, by_dma, call_s):
    dds = bench.spcm.DDS(bench.card)
    dds.data_transfer_mode(int(by_dma))
    for _ in range(100):
        dds[0].freq(80e6)
        dds[0].amp(0.1)
        dds.exec_at_trg()
    start_s = bench.clock.now()
    dds.write_to_card()
    assert bench.clock.now() - start_s == pytest.approx(call_s, abs=1e-9)
