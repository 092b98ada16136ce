"""The Spectrum driver streams: what is rendered in time is played, and what is not is an error."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from labseq import TransientError
from labseq.motion.rendering import render
from labseq.testing.fakes import FakeClock


class CreepingClock(FakeClock):
    """Some time passes with every look at it, as while samples are rendered."""

    creep_s = 0.0

    def now(self) -> float:
        self._now_s += self.creep_s
        return super().now()


def test_programs_are_streamed_beyond_what_card_and_ring_hold(driver: Any) -> None:
    with driver("fifo", fill=1e-3) as lab:
        program = lab.program(16)
        rendered = render(program, lab.rate_hz).samples
        lab.tweezers.prepare(program)
        filled_s = lab.card._machine.fifo._handed / 4 / lab.rate_hz
        assert filled_s < 0.6 * program.total_duration_s
        lab.tweezers.play()
        lab.tweezers.wait(1.0)
        assert np.array_equal(lab.samples(0)[: rendered.shape[1]], rendered[0])
        assert np.array_equal(lab.samples(1)[: rendered.shape[1]], rendered[1])


@pytest.mark.parametrize("fill_s", [1e-3, 8e-3, 20e-3])
@pytest.mark.parametrize("share", [0.2, 0.7])
def test_a_card_is_kept_supplied_when_that_takes_most_of_the_time(
    driver: Any, fill_s: float, share: float
) -> None:
    """Each chunk takes two looks at the clock: for room, and to hand it over."""
    clock = CreepingClock()
    with driver("fifo", clock=clock, fill=fill_s) as lab:
        program = lab.program(100)
        lab.tweezers.prepare(program)
        lab.tweezers.play()
        clock.creep_s = share * 2**18 / lab.rate_hz / 2
        lab.tweezers.wait(5.0)
        clock.creep_s = 0.0
        rendered = render(program, lab.rate_hz).samples
        assert np.array_equal(lab.samples(0)[: rendered.shape[1]], rendered[0])


def test_data_that_is_withheld_is_an_underrun_and_ends_in_the_safe_state(driver: Any) -> None:
    with driver("fifo", fill=1e-3) as lab:
        lab.tweezers.prepare(lab.program(16))
        lab.tweezers.play()
        lab.clock.sleep(0.1)  # nobody feeds the card
        with pytest.raises(TransientError, match="underrun"):
            lab.tweezers.wait(1.0)
        assert lab.card.outputs_on == (False, False)
        lab.play(lab.program(1))


@pytest.mark.parametrize("creep_s", [1e-3, 3e-3, 10e-3])
def test_an_underrun_in_the_middle_of_feeding_is_an_underrun(driver: Any, creep_s: float) -> None:
    clock = CreepingClock()
    with driver("fifo", clock=clock, fill=1e-3) as lab:
        lab.tweezers.prepare(lab.program(40))
        lab.tweezers.play()
        clock.creep_s = creep_s
        with pytest.raises(TransientError, match="underrun"):
            lab.tweezers.wait(5.0)
        clock.creep_s = 0.0
        assert lab.card.outputs_on == (False, False)
        assert not lab.card.running


def test_what_an_underrun_cut_short_is_not_played_on(driver: Any) -> None:
    with driver("fifo", fill=1e-3) as lab:
        lab.tweezers.prepare(lab.program(16))
        lab.tweezers.play()
        lab.clock.sleep(0.1)
        with pytest.raises(TransientError):
            lab.tweezers.wait(1.0)
        lab.card.forget(lab.clock.now() + 1.0)
        lab.clock.sleep(0.1)
        assert not lab.card.played(0)
        program = lab.program(1)
        rendered = render(program, lab.rate_hz).samples
        lab.play(program)
        assert np.array_equal(lab.samples(0)[: rendered.shape[1]], rendered[0])
