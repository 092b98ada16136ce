"""The Spectrum driver against the cards' manual: start of a stream, underrun, errors, reference clock."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings
from labseq_spcm_sim import M4I6631, registers as r
from labseq_spcm_sim.card import SimulatedCard
from labseq_spcm_sim.machine import Machine
from labseq_spcm_sim.modes import Fifo

from labseq.motion.rendering import render
from labseq.plugin import Context, DeviceError, DeviceTimeoutError, TransientError

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
            with pytest.raises(
                DeviceTimeoutError, match=rf"{text}, and was not started; use `mode: sequence`"
            ):
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


class TestReferenceClock:
    """Manual p. 115."""

    def test_the_rate_that_the_pll_makes_is_the_one_that_is_rendered(self, driver: Any) -> None:
        with driver(sample_rate=249.9e6, reference_clock=10e6) as lab:
            assert lab.rate_hz == 250e6
            program = lab.program(1)
            lab.play(program)
            rendered = render(program, 250e6).samples[0]
            assert np.array_equal(lab.samples(0)[: len(rendered)], rendered)

    def test_a_rate_that_the_pll_misses_by_far_is_refused(self, driver: Any) -> None:
        coarse = replace(M4I6631, reference_divider=1)
        with (
            pytest.raises(DeviceError, match="sample rate in Hz was set to 624000000, and the card reads 62"),
            driver(model=coarse, sample_rate=624e6, reference_clock=10e6),
        ):
            pass

    @pytest.mark.parametrize("signal_hz", [0.0, 100e6])
    def test_a_clock_that_is_not_there_is_reported_when_the_card_is_opened(
        self, driver: Any, signal_hz: float
    ) -> None:
        model = replace(M4I6631, reference_hz=signal_hz)
        with (
            pytest.raises(
                DeviceError, match="the clock is not locked; connect the clock that reference_clock"
            ),
            driver(model=model, reference_clock=10e6),
        ):
            pass

    def test_the_pll_locks_when_the_card_is_opened_and_not_in_a_shot(self, driver: Any) -> None:
        with driver(reference_clock=10e6) as lab:
            assert lab.clock.now() >= 0.2
            start_s = lab.clock.now()
            lab.play(lab.program(1))
            assert lab.clock.now() - start_s < 0.1

    @pytest.mark.parametrize(
        ("rate_hz", "reference_hz", "text"),
        [
            (
                624e6,
                10e6,
                "(nearest multiples: 620 MHz, 630 MHz); set sample_rate: 640 MHz, which also",
            ),
            (625e6, 10e6, "set sample_rate: 640 MHz"),
            (624e6, 100e6, "(nearest multiples: 600 MHz, 700 MHz); set sample_rate: 600 MHz"),
            (640e6, 10e6, ""),
            (624e6, None, ""),
        ],
    )
    def test_check_names_the_nearest_whole_multiples(
        self, rate_hz: float, reference_hz: float | None, text: str
    ) -> None:
        settings = SpcmSettings(card="simulated", sample_rate=rate_hz, reference_clock=reference_hz)
        warnings = SpcmMobileTweezers(settings, Context("awg")).warnings()
        assert [text in warning for warning in warnings] == [True] * bool(text)
