"""The Spectrum driver against the cards' manual: start of a stream, underrun, errors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from labseq_spcm_sim import M4I6631, registers as r
from labseq_spcm_sim.card import SimulatedCard
from labseq_spcm_sim.machine import Machine
from labseq_spcm_sim.modes import Fifo

from labseq.plugin import DeviceError, DeviceTimeoutError, TransientError

STREAMED = ["fifo", "stream"]


class TestStartOfAStream:
    """Manual p. 104 to 110: fill, hand over, start the transfer, wait for its first block, start the card."""

    @pytest.mark.parametrize("n_batches", [1, 60])
    def test_the_transfer_has_its_first_block_before_the_card_is_started(
        self, driver: Any, n_batches: int
    ) -> None:
        with driver("fifo") as lab:
            lab.card.log.clear()
            lab.play(lab.program(n_batches))
            log = list(lab.card.log)
            started = [e.time_s for e in log if e.register == r.SPC_M2CMD and e.value & r.M2CMD_CARD_START]
            (dma,) = [n for n, e in enumerate(log) if e.value == r.M2CMD_DATA_STARTDMA]
            handed = sum(e.value for e in log[:dma] if e.register == r.SPC_DATA_AVAIL_CARD_LEN)
            assert handed == 1 << (20 if n_batches == 1 else 22), "the program, or as much as the ring takes"
            assert started[0] >= log[dma].time_s + (1 << 20) / M4I6631.bus_bytes_per_s

    @pytest.mark.parametrize(
        ("mode", "text"), [("fifo", "fetched 0 of 1048576 bytes"), ("stream", "fetched 0 of 65536 bytes")]
    )
    def test_a_card_that_fetches_nothing_is_reported_within_a_second(
        self, driver: Any, mode: str, text: str
    ) -> None:
        stuck = replace(M4I6631, bus_bytes_per_s=1.0)
        with driver(mode, model=replace(M4I6631)) as lab:
            lab.card._machine.model = stuck
            start_s = lab.clock.now()
            with pytest.raises(DeviceTimeoutError, match=rf"{text}, and was not started; use mode: replay"):
                lab.play(lab.program(1))
            assert lab.clock.now() - start_s < 1.1

    @pytest.mark.parametrize("mode", STREAMED)
    def test_a_card_that_keeps_a_page_of_its_memory_for_itself_is_started(
        self, driver: Any, mode: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        switch_dma = Fifo.switch_dma

        def smaller(fifo: Any, on: bool, now_s: float) -> None:
            fifo._room -= 4096
            switch_dma(fifo, on, now_s)

        monkeypatch.setattr(Fifo, "switch_dma", smaller)
        with driver(mode, fill=1e-3) as lab:
            lab.play(lab.program(60))


@pytest.fixture
def not_ready(monkeypatch: pytest.MonkeyPatch) -> None:
    """After an underrun the cards report M2STAT_DATA_OVERRUN, and not that they are ready."""
    status = Machine._status
    monkeypatch.setattr(
        Machine,
        "_status",
        lambda machine: status(machine) & ~(r.M2STAT_CARD_READY if machine.underrun else 0),
    )


@pytest.mark.usefixtures("not_ready")
class TestUnderrun:
    def test_of_a_program_ends_it_also_if_the_card_is_not_ready_then(self, driver: Any) -> None:
        with driver("fifo", fill=1e-3) as lab:
            lab.tweezers.prepare(lab.program(60))
            lab.tweezers.play()
            lab.clock.sleep(0.1)
            with pytest.raises(TransientError, match="underrun"):
                lab.tweezers.wait(1.0)

    def test_of_a_stream_in_silence_is_counted_also_if_the_card_is_not_ready_then(self, driver: Any) -> None:
        with driver("stream") as lab:
            lab.tweezers.settle()
            lab.clock.sleep(1e-3)
            lab.card.hold_up(25e-3)
            lab.clock.sleep(30e-3)
            lab.play(lab.program(2))
            assert lab.tweezers.describe()["silent_underruns"] == 1


@pytest.mark.parametrize("mode", ["replay", "stream"])
def test_an_error_for_which_the_library_has_no_text_is_named(
    driver: Any, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    take_error = SimulatedCard.take_error
    monkeypatch.setattr(SimulatedCard, "take_error", lambda card: replace(take_error(card), text=""))
    with driver(mode) as lab:
        lab.tweezers.settle()
        lab.card.break_down("without a text")
        lab.clock.sleep(10e-3)
        with pytest.raises(DeviceError, match=r": ERR_(LASTERR|INTERNAL_ERROR) \(0x[0-9a-f]+\)$"):
            lab.tweezers.prepare(lab.program(1))
