"""The simulated Spectrum card: its place beside the vendor's library, and what the simulation receives."""

from __future__ import annotations

import itertools
import mmap
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from labseq_spcm_sim import M4I6631
from labseq_spcm_sim.library import CardOutputs
from labseq_spcm_sim.modes import Buffer, Fifo
from numpy.typing import NDArray

from labseq.model import RfSamples, RfSpan

BUS = M4I6631.bus_bytes_per_s
Samples = NDArray[np.int16]


def test_the_real_package_opens_the_card_and_knows_it(bench: Any) -> None:
    assert str(bench.card) == "Card: M4i.6631-x8 sn 12345"
    assert bench.card.card_type() == bench.spcm.TYP_M4I6631_X8
    assert bench.card.num_channels() == 2
    assert bench.card.max_sample_value() == 32767
    again = bench.spcm.Card(bench.name)
    with pytest.raises(bench.spcm.SpcmDeviceNotFound):
        again.open()
    again._closed = True  # else its destructor stops a card that it never had
    bench.card.close()
    bench.card = bench.spcm.Card(bench.name).open()
    assert bench.card.sn() == 12345


def test_a_fault_of_the_simulator_is_reported(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(bench.sim, "write", lambda *_: 1 / 0)
        with pytest.raises(bench.spcm.SpcmException, match="fault of the simulator: ZeroDivisionError"):
            bench.card.loops(3)


SIDE_BY_SIDE = """
import ctypes, types
from labseq.testing.fakes import FakeClock
from labseq_spcm_sim import SimulatedCard, installed, registers, vendor_library_found
from labseq_spcm_sim.library import Library

real = SimulatedCard(FakeClock(), serial_number=1)  # plays the real card, in a library of its own
seen = []

class Vendor(Library):
    def _dwsetparam_i64(self, handle, register, value):
        seen.append(register)
        return self._write(handle, register, value)

vendor = Vendor(None)
vendor.cards["/dev/spcm0"] = real
load = ctypes.cdll.LoadLibrary
ours = types.SimpleNamespace(**vendor.functions)
ctypes.cdll.LoadLibrary = lambda name: ours if name.startswith("libspcm") else load(name)
import spcm
before = spcm.Card("/dev/spcm0").open()
simulated = SimulatedCard(FakeClock(), serial_number=2)
with installed(simulated) as name:
    assert vendor_library_found()
    assert before.sn() == 1
    before.close()
    import spcm, spcm_core
    with spcm.Card("/dev/spcm0") as first, spcm.Card(name) as second:
        assert (first.sn(), second.sn()) == (1, 2)
        handle = second.handle()
        second.loops(5)
        assert (first.loops(), second.loops()) == (1, 5)
        second.set_d(spcm.SPC_AMP0, 500.0)
        assert second.get_d(spcm.SPC_AMP0) == 500.0
        try:
            first.set_i(spcm.SPC_AMP0, 9999)
        except spcm.SpcmException as error:
            assert "9999" in str(error)
with spcm.Card("/dev/spcm0") as first:
    assert first.sn() == 1
code = spcm_core.spcm_dwSetParam_i64(handle, spcm.SPC_LOOPS, 3)
assert code == spcm.ERR_INVALIDHANDLE  # closed, but still ours: it never reaches the vendor's library
assert spcm.SPC_LOOPS not in seen
print("done")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="the substitute for the vendor's library is for cdll")
def test_real_and_simulated_cards_work_in_one_process() -> None:
    command = [sys.executable, "-c", SIDE_BY_SIDE]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.stdout, done.returncode) == ("done\n", 0), done.stderr


@given(
    st.lists(st.floats(1e-7, 1e-4), min_size=1, max_size=20),
    st.integers(0, 60),
    st.sampled_from([1024, 16 * 1024, 2**20]),
)
def test_looking_more_often_changes_nothing(pauses_s: list[float], n_frames: int, room_bytes: int) -> None:
    """The flow of bytes depends on time alone, not on how often its state is read."""
    ring = mmap.mmap(-1, 8192)
    address = np.frombuffer(ring, np.int16).ctypes.data

    def stream() -> Fifo:
        fifo = Fifo(Buffer(address, 8192, 0), 4, 625e6, room_bytes, BUS)
        fifo.hand_over(n_frames * 128)
        fifo.switch_dma(on=True, now_s=0.0)
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


def joined(spans: list[RfSpan]) -> Samples:
    """The samples of spans that follow one another without a gap."""
    sampled = [span for span in spans if isinstance(span, RfSamples)]
    assert len(sampled) == len(spans)
    for before, after in itertools.pairwise(sampled):
        assert after.start_s == pytest.approx(before.end_s, abs=1e-12)
    return np.concatenate([span.samples for span in sampled])


@pytest.mark.parametrize(("mode", "row_channel"), [("replay", 1), ("sequence", 1), ("fifo", 0)])
def test_samples_are_reported_in_pieces_that_fit_together_rows_first(
    driver: Any, mode: str, row_channel: int
) -> None:
    with driver(mode) as lab:
        lab.play(lab.program(1))
        expected = [lab.samples(channel) for channel in (row_channel, 1 - row_channel)]
        start_s = lab.card.played(0)[0].start_s
        outputs = CardOutputs(lab.card, row_channel)
        received: tuple[list[RfSpan], list[RfSpan]] = ([], [])
        for until_s in (start_s - 1e-3, start_s + 0.61234567e-3, start_s + 0.7e-3, start_s + 1.0):
            for axis, spans in zip(received, outputs.played(until_s), strict=True):
                axis += spans
        for axis, samples in zip(received, expected, strict=True):
            np.testing.assert_array_equal(joined(axis), samples)
        assert outputs.played(start_s + 2.0) == ([], [])
        assert lab.card.played(0) == []
