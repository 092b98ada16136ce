"""The DDS registers of the simulated Spectrum card: ranges, rounding, masks that snap, time."""

from __future__ import annotations

import ctypes

import pytest
from hypothesis import given, strategies as st
from labseq_spcm.simulator import SimulatedCard, registers as r

from labseq.testing.fakes import FakeClock


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


@pytest.mark.parametrize(
    ("register", "bad"),
    [
        (r.SPC_DDS_TRG_TIMER, 30.0),
        (r.SPC_DDS_TRG_TIMER, 80e-9),
        (r.SPC_DDS_CORE0_FREQ, 700e6),
        (r.SPC_DDS_CORE0_FREQ, float("nan")),
        (r.SPC_DDS_CORE0_AMP, 1.01),
        (r.SPC_DDS_CORE0_PHASE, float("inf")),
        (r.SPC_DDS_CORE0_FREQ_SLOPE, 1e15),
        (r.SPC_DDS_FREQ_RAMP_STEPSIZE, 5000),
    ],
)
def test_dds_values_out_of_range_are_refused_not_clamped(bench, register, bad):
    before = bench.sim.read(register)
    assert bench.sim.write(register, bad) == r.ERR_VALUE
    bench.sim.take_error()
    assert bench.sim.read(register) == before


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
