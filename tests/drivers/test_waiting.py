"""Waiting for a real device, on real and on virtual clocks."""

from __future__ import annotations

import threading

import pytest

from labseq.drivers.serial_port import SLICE_S
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


def test_what_comes_is_handed_on_at_once() -> None:
    clock = FakeClock()
    assert wait_for(lambda _timeout_s: "a frame", 10.0, clock) == "a frame"
    assert clock.sleeps == []


def test_it_looks_until_something_comes() -> None:
    answers = iter([None, None, 7])
    assert wait_for(lambda _timeout_s: next(answers), 10.0, RealClock(StopFlag())) == 7


def test_what_is_false_but_not_none_came() -> None:
    assert wait_for(lambda _timeout_s: 0, 10.0, FakeClock()) == 0


def test_another_thread_ends_the_wait() -> None:
    came = threading.Event()
    threading.Thread(target=came.set).start()
    assert wait_for(lambda timeout_s: came.wait(timeout_s) or None, 10.0, NeverStopped())


def test_no_single_wait_is_longer_than_a_stop_request_may_take() -> None:
    asked_s = list[float]()
    wait_for(asked_s.append, 0.03, NeverStopped())
    assert 0 < SLICE_S <= 0.05
    assert all(0 <= timeout_s <= SLICE_S for timeout_s in asked_s)


def test_a_timeout_of_0_looks_once() -> None:
    asked_s = list[float]()
    assert wait_for(asked_s.append, 0.0, NeverStopped()) is None
    assert asked_s == [0.0]


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


def test_after_a_stop_request_nothing_is_asked_of_the_device() -> None:
    stop, asked_s = StopFlag(), list[float]()
    stop.request()
    with pytest.raises(StopRequested):
        wait_for(asked_s.append, 10.0, RealClock(stop))
    assert asked_s == []
