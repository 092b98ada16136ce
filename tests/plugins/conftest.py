"""A bench for the tests of the Spectrum plugin: a simulated card, opened by the real ``spcm``."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from labseq_spcm.simulator import SimulatedCard, installed

from labseq.testing.fakes import FakeClock


class Bench:
    """One simulated card, the real ``spcm`` package, and a virtual clock.

    Attributes:
        clock: The virtual clock.
        sim: The simulated card.
        name: Its device name.
        spcm: The vendor's package.
        card: Its ``Card``, open.
    """

    def __init__(self, clock: FakeClock, sim: SimulatedCard, name: str) -> None:
        self.clock = clock
        self.sim = sim
        self.name = name
        self.spcm: Any = importlib.import_module("spcm")
        self.card: Any = self.spcm.Card(name).open()

    def outputs(self, amplitude_mv: int = 500) -> Any:
        """Both channels on, at an amplitude; waits until the relay has settled."""
        channels = self.spcm.Channels(self.card, card_enable=3)
        channels.enable(True)
        channels.amp(amplitude_mv * self.spcm.units.mV)
        self.clock.sleep(0.02)
        return channels

    def external_trigger(self) -> None:
        """Ext0, rising edge, 1.5 V."""
        s = self.spcm
        self.card.set_i(s.SPC_TRIG_ORMASK, s.SPC_TMASK_EXT0)
        self.card.set_i(s.SPC_TRIG_EXT0_MODE, s.SPC_TM_POS)
        self.card.set_i(s.SPC_TRIG_EXT0_LEVEL0, 1500)

    def upload(self, samples: np.ndarray, sample_rate_hz: float = 625e6) -> None:
        """Send samples, int16 (n_channels, n), to the memory and wait for the transfer."""
        self.card.set_i(self.spcm.SPC_SAMPLERATE, int(sample_rate_hz))
        transfer = self.spcm.DataTransfer(self.card)
        transfer.memory_size(samples.shape[1])
        transfer.allocate_buffer(samples.shape[1])
        transfer.buffer[:] = samples
        transfer.start_buffer_transfer(self.spcm.M2CMD_DATA_STARTDMA, self.spcm.M2CMD_DATA_WAITDMA)


@pytest.fixture
def bench() -> Iterator[Bench]:
    """A bench with an open card, which is closed whatever the test leaves behind."""
    clock = FakeClock()
    sim = SimulatedCard(clock)
    with installed(sim) as name:
        bench = Bench(clock, sim, name)
        yield bench
        sim.take_error()
        bench.card.close()
