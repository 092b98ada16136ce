"""For the tests of the Spectrum plugin: a simulated card, opened by the real ``spcm`` or by the driver."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings
from labseq_spcm_sim import M4I6631, CardModel, Faults, SimulatedCard, installed
from numpy.typing import NDArray

from labseq.motion import tone_program
from labseq.plugin import Context, MotionSpec, Plan, ToneProgram
from labseq.testing.fakes import FakeClock


class OpenCard:
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


@pytest.fixture
def bench() -> Iterator[OpenCard]:
    """A bench with an open card, which is closed whatever the test leaves behind."""
    clock = FakeClock()
    sim = SimulatedCard(clock)
    with installed(sim) as name:
        bench = OpenCard(clock, sim, name)
        yield bench
        sim.take_error()
        bench.card.close()


RATE_HZ = 250e6
"""Sample rate of the driver's tests, which is enough and renders fast."""


@dataclass
class Lab:
    """The driver, open, on a simulated card.

    Attributes:
        tweezers: The driver.
        card: The card.
        clock: The clock of both.
        motion: How the tweezers move.
        settings: Those of the driver.
    """

    tweezers: SpcmMobileTweezers
    card: SimulatedCard
    clock: FakeClock
    motion: MotionSpec
    settings: SpcmSettings = field(default_factory=SpcmSettings)

    @property
    def rate_hz(self) -> float:
        return float(self.tweezers.describe()["sample_rate_hz"])

    def program(self, n_batches: int = 2) -> ToneProgram:
        batches: list[Any] = [
            ([(0, 0), (0, 3), (0, 7)], [(0, 2), (0, 6), (0, 8)]),
            ([(2, 1), (4, 1)], [(3, 1), (7, 1)]),
        ]
        plan = Plan.from_batches([batches[n % 2] for n in range(n_batches)])
        return tone_program(plan, motion=self.motion)

    def play(self, program: ToneProgram) -> None:
        duration_s = self.tweezers.prepare(program)
        self.tweezers.play()
        self.tweezers.wait(duration_s + 1.0)

    def samples(self, channel: int) -> NDArray[np.int16]:
        """From the first span to the last, with the silence between them."""
        spans = self.card.played(channel)
        starts = [round((span.start_s - spans[0].start_s) * self.rate_hz) for span in spans]
        samples = np.zeros(starts[-1] + spans[-1].n_samples, np.int16)
        for start, span in zip(starts, spans, strict=True):
            samples[start : start + span.n_samples] = span.values()
        return samples

    def written(self, register: int) -> list[float]:
        return [entry.value for entry in self.card.log if entry.register == register]


@contextmanager
def open_driver(
    mode: str = "replay",
    motion: MotionSpec | None = None,
    model: CardModel = M4I6631,
    clock: FakeClock | None = None,
    named: str = "",
    card_faults: Faults = Faults(),  # noqa: B008 - frozen
    **settings: Any,
) -> Generator[Lab]:
    """Within the block the driver is open on a simulated card; ``named`` is its model in the settings."""
    clock = clock or FakeClock()
    card = SimulatedCard(clock, model=model, faults=card_faults)
    motion = motion or MotionSpec()
    with installed(card) as name:
        given = {"card": name, "mode": mode, "sample_rate": RATE_HZ, "model": named, **settings}
        chosen = SpcmSettings.model_validate(given)
        context = Context("mobile_tweezers", clock=clock, motion=motion)
        tweezers = SpcmMobileTweezers(chosen, context)
        tweezers.open()
        try:
            yield Lab(tweezers, card, clock, motion, chosen)
        finally:
            tweezers.close()


@pytest.fixture(scope="session")
def driver() -> Callable[..., AbstractContextManager[Lab]]:
    """``with driver(mode, **settings) as lab``: see :func:`open_driver`."""
    return open_driver
