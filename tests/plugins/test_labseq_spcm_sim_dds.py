"""The DDS of the simulated Spectrum card: values, lists, queue, triggers and timer."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from labseq_spcm_sim import SimulatedCard, Tone, ToneSpan, registers as r
from labseq_spcm_sim.setup import DDS_TRIGGER_DELAY_S

from labseq.testing.fakes import FakeClock

FREQ, FREQ_SLOPE, AMP = r.SPC_DDS_CORE0_FREQ, r.SPC_DDS_CORE0_FREQ_SLOPE, r.SPC_DDS_CORE0_AMP
AMP_SLOPE, PHASE = r.SPC_DDS_CORE0_AMP_SLOPE, r.SPC_DDS_CORE0_PHASE
SOURCE, TIMER, CMD = r.SPC_DDS_TRG_SRC, r.SPC_DDS_TRG_TIMER, r.SPC_DDS_CMD
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


def test_a_queue_that_is_too_full_loses_blocks_and_reports_it() -> None:
    card = Synthesizer()
    for _ in range(4100):
        card.block({FREQ: 80e6})
    card.send()
    assert card.status() & OVERRUN
    assert card.read(r.SPC_DDS_QUEUE_CMD_COUNT)[1] == card.read(r.SPC_DDS_QUEUE_CMD_MAX)[1] - 1


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
