"""The DDS of the simulated Spectrum card: values, lists, queue, triggers and timer."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from labseq_spcm_sim import M4I6631, SimulatedCard, Tone, ToneSpan, registers as r
from labseq_spcm_sim.card import LIST_PARAM, list_writes
from labseq_spcm_sim.setup import DDS_TIMER_STEP_S, DDS_TRIGGER_DELAY_S

from labseq.testing.fakes import FakeClock

FREQ, FREQ_SLOPE, AMP = r.SPC_DDS_CORE0_FREQ, r.SPC_DDS_CORE0_FREQ_SLOPE, r.SPC_DDS_CORE0_AMP
AMP_SLOPE, PHASE = r.SPC_DDS_CORE0_AMP_SLOPE, r.SPC_DDS_CORE0_PHASE
SOURCE, TIMER, CMD = r.SPC_DDS_TRG_SRC, r.SPC_DDS_TRG_TIMER, r.SPC_DDS_CMD
BY_TIMER, BY_CARD = r.SPCM_DDS_TRG_SRC_TIMER, r.SPCM_DDS_TRG_SRC_CARD
UNDERRUN, OVERRUN = r.SPCM_DDS_STAT_QUEUE_UNDERRUN, r.SPCM_DDS_STAT_QUEUE_OVERRUN


class Synthesizer(SimulatedCard):
    """A card in DDS mode with its outputs on at 1 V."""

    def __init__(self) -> None:
        self.clock = FakeClock()
        super().__init__(self.clock)
        setup = {
            r.SPC_CARDMODE: r.SPC_REP_STD_DDS,
            r.SPC_ENABLEOUT0: 1,
            r.SPC_ENABLEOUT1: 1,
            r.SPC_M2CMD: r.M2CMD_CARD_WRITESETUP,
            r.SPC_DDS_DATA_TRANSFER_MODE: r.SPCM_DDS_DTM_DMA,
        }
        assert self.write_all(setup.items()) == r.ERR_OK
        self.clock.sleep(0.02)

    def block(self, writes: dict[int, float]) -> None:
        assert self.write_all([*writes.items(), (CMD, r.SPCM_DDS_CMD_EXEC_AT_TRG)]) == r.ERR_OK

    def send(self) -> None:
        """Send all blocks to the card, and wait until they have arrived."""
        self.write(CMD, r.SPCM_DDS_CMD_WRITE_TO_CARD)
        self.clock.sleep(1e-3)

    def start(self, *blocks: dict[int, float]) -> None:
        for block in blocks:
            self.block(block)
        self.send()
        assert self.write(r.SPC_M2CMD, r.M2CMD_CARD_START) == r.ERR_OK

    def force(self, then_s: float = 1e-3) -> float:
        """Force a trigger, and let some time pass; returns when the output changed."""
        out_s = self.clock.now() + DDS_TRIGGER_DELAY_S
        self.write(r.SPC_M2CMD, r.M2CMD_CARD_FORCETRIGGER)
        self.clock.sleep(then_s)
        return out_s

    def spans(self, channel: int = 0) -> list[ToneSpan]:
        spans = self.played(channel)
        assert all(isinstance(span, ToneSpan) for span in spans)
        return spans  # pyright: ignore[reportReturnType]

    def tone(self) -> Tone:
        """What core 0 does in the last span."""
        return self.spans()[-1].tones[0]

    def status(self) -> int:
        return int(self.read(r.SPC_DDS_STATUS)[1])


def test_it_takes_nothing_before_its_mode_is_written_to_the_card() -> None:
    card = SimulatedCard(FakeClock())
    card.write(r.SPC_CARDMODE, r.SPC_REP_STD_DDS)
    for command, taken in ((r.M2CMD_CARD_STOP, 0.0), (r.M2CMD_CARD_WRITESETUP, 80e6)):
        card.write(r.SPC_M2CMD, command)
        assert card.write(FREQ, 80e6) == r.ERR_OK, "it is lost without a report"
        assert card.read(FREQ)[1] == pytest.approx(taken, abs=1)


def test_a_block_waits_in_the_shadow_registers_for_its_trigger() -> None:
    card = Synthesizer()
    card.start({FREQ: 80e6, AMP: 0.1, PHASE: 90.0}, {FREQ_SLOPE: 5e9}, {FREQ: 90e6, FREQ_SLOPE: 0.0})
    assert card.read(r.SPC_DDS_QUEUE_CMD_COUNT)[1] == 3  # the first block is in the shadow registers
    assert card.status() == r.SPCM_DDS_STAT_WAITING_FOR_TRG
    assert card.spans() == []
    out_s = card.force()
    (span,) = card.spans()
    assert (span.start_s, span.end_s) == (pytest.approx(out_s, abs=1e-12), card.clock.now())
    assert span.amplitude_v == 1.0
    assert card.tone().frequency_hz == pytest.approx(80e6, abs=0.15)
    assert card.tone().amplitude == pytest.approx(0.1, abs=1e-4)
    assert card.tone().phase_rad == pytest.approx(np.pi / 2)
    card.force()
    card.force()
    _, ramp, end = card.spans()
    assert ramp.tones[0].frequency_slope == pytest.approx(5e9, rel=1e-6)
    assert ramp.tones[0].after(ramp.end_s - ramp.start_s).frequency_hz == pytest.approx(85e6, rel=1e-6)
    assert end.tones[0].frequency_hz == pytest.approx(90e6, abs=0.15)
    for before, after in itertools.pairwise(card.spans()):  # the phase goes on
        last = before.tones[0].after(before.end_s - before.start_s)
        assert np.exp(1j * last.phase_rad) == pytest.approx(np.exp(1j * after.tones[0].phase_rad), abs=1e-6)


def test_each_block_carries_the_timer_that_leads_to_the_next_event() -> None:
    card = Synthesizer()
    card.start(
        {SOURCE: BY_TIMER, TIMER: 100e-6, FREQ: 80e6, AMP: 0.5},
        {SOURCE: BY_TIMER, TIMER: 300e-6, FREQ: 81e6},
        {SOURCE: BY_CARD, FREQ: 82e6},
        {AMP: 0.0},
    )
    card.clock.sleep(1e-3)
    assert card.spans() == []
    card.force()
    lengths_s = [span.end_s - span.start_s for span in card.spans()]
    assert lengths_s[:2] == pytest.approx([100e-6, 300e-6], abs=DDS_TIMER_STEP_S)
    card.force()
    assert len(card.spans()) == 3
    assert card.spans()[-1].end_s < card.clock.now() - 0.9e-3
    assert not card.status() & UNDERRUN


def test_the_trigger_count_is_one_short_and_a_trigger_without_a_block_is_an_underrun() -> None:
    card = Synthesizer()
    card.start(*[{FREQ: 80e6}] * 3)
    counts: list[float] = []
    for _ in range(3):
        card.force()
        counts.append(card.read(r.SPC_DDS_TRG_COUNT)[1])
    assert counts == [0, 1, 2]
    assert not card.status() & UNDERRUN
    card.force()
    assert card.status() & UNDERRUN


def test_the_timer_without_a_block_sets_the_underrun_flag_and_ticks_on() -> None:
    card = Synthesizer()
    card.start({SOURCE: BY_TIMER, TIMER: 1e-3, FREQ: 80e6, AMP: 0.5})
    out_s = card.force(10.5e-3)
    assert card.status() & UNDERRUN
    card.block({FREQ: 90e6})
    card.send()
    assert card.spans()[-1].start_s == pytest.approx(out_s + 11e-3, abs=1e-7)


def test_a_block_can_be_triggered_only_when_all_of_it_has_arrived() -> None:
    card = Synthesizer()
    assert card.write(r.SPC_M2CMD, r.M2CMD_CARD_START) == r.ERR_OK
    card.write_all([(FREQ, 80e6)] * 1000)
    card.block({AMP: 0.5})
    card.write(CMD, r.SPCM_DDS_CMD_WRITE_TO_CARD)
    card.clock.sleep(1001 / 10e6 + 20e-6 - 1e-6)
    assert card.status() == 0
    card.force(2e-6)
    assert card.status() == UNDERRUN | r.SPCM_DDS_STAT_WAITING_FOR_TRG
    card.force()
    assert card.tone().frequency_hz == pytest.approx(80e6, abs=0.15)


def test_a_queue_that_is_too_full_loses_blocks_and_reports_it() -> None:
    card = Synthesizer()
    for _ in range(4100):
        card.block({FREQ: 80e6})
    card.send()
    assert card.status() & OVERRUN
    assert card.read(r.SPC_DDS_QUEUE_CMD_COUNT)[1] == card.read(r.SPC_DDS_QUEUE_CMD_MAX)[1] - 1


def test_an_amplitude_ramp_ends_at_full_scale() -> None:
    card = Synthesizer()
    card.start({FREQ: 80e6, AMP_SLOPE: 5000.0})
    card.force(500e-6)
    tone = card.tone()
    assert tone.after(100e-6).amplitude == pytest.approx(0.5, abs=0.02)
    assert tone.after(300e-6).amplitude == 1.0
    card.block({AMP_SLOPE: 0.0})
    card.send()
    card.force()
    assert card.tone().amplitude == 1.0


def test_a_stop_or_a_reset_silences_and_keeps_what_was_played() -> None:
    card = Synthesizer()
    card.start({FREQ: 80e6, AMP: 0.5})
    card.force()
    card.write(r.SPC_M2CMD, r.M2CMD_CARD_STOP)
    stopped_s = card.clock.now()
    card.start()
    card.clock.sleep(1e-3)
    assert [span.end_s for span in card.spans()] == [stopped_s]
    card.block({FREQ: 80e6, AMP: 0.5})
    card.send()
    card.force()
    card.write(CMD, r.SPCM_DDS_CMD_RESET)
    reset_s = card.clock.now()
    card.clock.sleep(1e-3)
    assert [span.end_s for span in card.spans()] == [stopped_s, reset_s]


@pytest.mark.parametrize(
    ("channel", "mask", "found", "other"),
    [
        (0, 1, 0xFF, 1 << 20),
        (0, 0xFFFFFF, 0xFFFFF, 1 << 20),
        (1, 0xF00, 0x100F00, 0xFF0FF),
        (1, 0x3, 1 << 20, 0xFFFFF),
    ],
)
def test_masks_that_the_chip_cannot_make_are_snapped_without_a_report(
    channel: int, mask: int, found: int, other: int
) -> None:
    card, registers = Synthesizer(), (r.SPC_DDS_CORES_ON_CH0, r.SPC_DDS_CORES_ON_CH1)
    assert card.write(registers[channel], mask) == r.ERR_OK
    assert [card.read(registers[one])[1] for one in (channel, 1 - channel)] == [found, other]


@settings(max_examples=30)
@given(st.floats(83.2e-9, 27.48), st.floats(0, 625e6), st.floats(-1e12, 1e12))
def test_inexact_values_are_rounded_and_read_back(timer_s: float, frequency_hz: float, slope: float) -> None:
    card = Synthesizer()
    for register, value, step in (
        (TIMER, timer_s, 6.4e-9),
        (FREQ, frequency_hz, 0.291038305),
        (FREQ_SLOPE + 20, slope, 2775.5575616),
    ):
        assert card.write(register, value) == 0
        assert card.read(register)[1] == pytest.approx(value, abs=0.5001 * step)


def test_smaller_ramp_steps_make_finer_slopes() -> None:
    card = Synthesizer()
    card.write(r.SPC_DDS_FREQ_RAMP_STEPSIZE, 1000)
    card.write(FREQ_SLOPE, 100.0)
    assert card.read(FREQ_SLOPE)[1] == pytest.approx(100.0, abs=1.5)


@pytest.mark.parametrize(
    ("register", "value", "code"),
    [
        (FREQ, -1.0, r.ERR_VALUE),
        (FREQ, float("nan"), r.ERR_VALUE),
        (AMP + 1, 1.5, r.ERR_VALUE),
        (PHASE, float("inf"), r.ERR_VALUE),
        (TIMER, 1e-9, r.ERR_VALUE),
        (FREQ + M4I6631.n_dds_cores, 80e6, r.ERR_REG),
        (r.SPC_DDS_NUM_CORES, 3.0, r.ERR_NOWRITEALLOWED),
        (CMD, r.SPCM_DDS_CMD_EXEC_NOW, r.ERR_FNCNOTSUPPORTED),
    ],
)
def test_a_list_is_carried_out_up_to_the_first_refusal(register: int, value: float, code: int) -> None:
    card = Synthesizer()
    entries = np.zeros(3, LIST_PARAM)
    for entry, (one, wanted) in zip(entries, ((AMP, 0.25), (register, value), (AMP + 2, 0.25)), strict=True):
        entry["register"], entry["type"], entry["value"] = one, 1, np.float64(wanted).view(np.int64)
    assert card.write_all(list_writes(entries)) == code
    card.take_error()
    found = [card.read(AMP + core)[1] for core in (0, 2)]
    assert found == pytest.approx([0.25, 0.0], abs=1e-4)
