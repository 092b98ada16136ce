"""Waiting for a real device, on real and on virtual clocks."""

from __future__ import annotations

import threading

import pytest

from labseq.drivers.waiting import SLICE_S
from labseq.guard import StopFlag
from labseq.plugin import StopRequested, wait_for
from labseq.roles import NeverStopped
from labseq.sequencer.clock import RealClock
from labseq.testing.fakes import FakeClock


class StopsAt(NeverStopped):
    """A clock on which a stop is asked for at the nth look."""

    def __init__(self, n: int) -> None:
        self.n_looks = 0
        self._n = n

    def check(self) -> None:
        self.n_looks += 1
        if self.n_looks == self._n:
            raise StopRequested


def test_it_looks_until_something_comes() -> None:
    answers = iter([None, None, 0])
    assert wait_for(lambda _timeout_s: next(answers), 10.0, RealClock(StopFlag())) == 0


def test_another_thread_ends_the_wait() -> None:
    came = threading.Event()
    threading.Thread(target=came.set).start()
    assert wait_for(lambda timeout_s: came.wait(timeout_s) or None, 10.0, NeverStopped())


def test_no_single_wait_is_longer_than_a_stop_request_may_take() -> None:
    asked_s = list[float]()
    wait_for(asked_s.append, 0.03, NeverStopped())
    assert 0 < SLICE_S <= 0.05
    assert all(0 <= timeout_s <= SLICE_S for timeout_s in asked_s)


def test_it_looks_once_more_when_the_time_is_up() -> None:
    asked_s = list[float]()
    wait_for(asked_s.append, 0.01, NeverStopped())
    assert asked_s[-1] == 0.0


def test_a_wait_in_vain_passes_on_a_virtual_clock() -> None:
    clock = FakeClock()
    assert wait_for(lambda _timeout_s: None, 0.01, clock) is None
    assert clock.now() == 0.01


def test_a_stop_request_is_seen_before_each_look() -> None:
    clock, asked_s = StopsAt(3), list[float]()
    with pytest.raises(StopRequested):
        wait_for(asked_s.append, 10.0, clock)
    assert len(asked_s) == clock.n_looks - 1 == 2
