"""The simulated Spectrum card under the real ``spcm``: identity, registers, errors, installation."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import threading
from dataclasses import replace

import pytest
from hypothesis import given, settings, strategies as st
from labseq_spcm.simulator import M4I6631, SimulatedCard, install, installed, registers, uninstall

from labseq import DeviceError
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


def test_values_are_read_back(bench):
    units = bench.spcm.units
    bench.outputs()
    clock = bench.spcm.Clock(bench.card)
    assert clock.sample_rate(625 * units.MHz, return_unit=units.MHz) == 625 * units.MHz
    assert bench.card.card_mode(bench.spcm.SPC_REP_STD_SINGLERESTART) == bench.spcm.SPC_REP_STD_SINGLERESTART
    assert bench.card.loops(7) == 7
    assert bench.card.get_i(bench.spcm.SPC_AMP1) == 500
    assert bench.card.active_channels() == 2


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
        ("SPC_SEQMODE_MAXSEGMENTS", 3),
        ("SPC_SEQMODE_SEGMENTSIZE", 160),
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


def test_an_unknown_register_and_one_that_can_only_be_read_are_told_apart(bench):
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


def test_a_numpy_integer_reaches_the_card_and_a_value_over_32_bits_does_too(bench):
    import numpy as np

    bench.card.set_i(bench.spcm.SPC_LOOPS, np.int64(3))
    assert bench.card.loops() == 3
    assert bench.card.loops(2**32 - 1) == 2**32 - 1


def test_a_32_bit_read_of_a_larger_value_is_refused(bench):
    import ctypes

    import spcm_core

    bench.card.loops(2**32 - 1)
    out = ctypes.c_int32(5)
    handle, loops = bench.card.handle(), bench.spcm.SPC_LOOPS
    assert spcm_core.spcm_dwGetParam_i32(handle, loops, ctypes.byref(out)) == bench.spcm.ERR_EXCEEDSINT32
    assert out.value == 5


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


def test_several_cards_live_side_by_side(bench):
    other = SimulatedCard(bench.clock, serial_number=777)
    with installed(other) as name, bench.spcm.Card(name) as card:
        assert name != bench.name
        card.loops(5)
        assert (card.sn(), bench.card.loops(), card.loops()) == (777, 1, 5)


def test_a_card_in_use_cannot_be_opened_again_until_it_is_closed(bench):
    again = bench.spcm.Card(bench.name)
    with pytest.raises(bench.spcm.SpcmDeviceNotFound):
        again.open()
    again._closed = True  # else its destructor stops a card that it never had
    bench.card.close()
    bench.card = bench.spcm.Card(bench.name).open()
    assert bench.card.sn() == 12345


def test_a_card_of_another_type_tells_its_own_name(bench):
    other = SimulatedCard(bench.clock, model=replace(M4I6631, name="M4i.6622-x8", card_type=0x76622))
    with installed(other) as name, bench.spcm.Card(name) as card:
        assert (card.product_name(), card.card_type()) == ("M4i.6622-x8", 0x76622)


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
    uninstall("simulated, but never there")


def test_a_fault_of_the_simulator_is_told_and_not_swallowed(bench, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(bench.sim, "write", lambda *_: 1 / 0)
        with pytest.raises(bench.spcm.SpcmException, match="fault of the simulator: ZeroDivisionError"):
            bench.card.loops(3)


FAKE_VENDOR = """
import ctypes, types
from labseq.testing.fakes import FakeClock
from labseq_spcm.simulator import SimulatedCard, installed, vendor_library_found
from labseq_spcm.simulator.library import Library

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
