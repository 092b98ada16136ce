import threading
import time

import pytest

from labseq.errors import StopRequested
from labseq.guard import StopFlag
from labseq.sequencer.clock import PacedClock, RealClock, VirtualClock


def test_virtual_time_passes_only_by_waiting():
    clock = VirtualClock(StopFlag())
    start = time.monotonic()
    clock.sleep(3600.0)
    assert clock.now() == 3600.0
    clock.sleep(-1.0)
    assert clock.now() == 3600.0
    assert time.monotonic() - start < 60.0


@pytest.mark.parametrize("kind", [RealClock, VirtualClock, PacedClock])
def test_a_stop_request_ends_every_wait(kind):
    stop = StopFlag()
    stop.request(15)
    stop.request(2)  # the first signal decides the exit code
    clock = kind(stop)
    with pytest.raises(StopRequested) as caught:
        clock.sleep(1000.0)
    assert caught.value.signal_number == 15
    with pytest.raises(StopRequested):
        clock.check()


def test_a_stop_request_ends_a_wait_that_is_under_way():
    stop = StopFlag()
    raised = threading.Event()

    def wait() -> None:
        with pytest.raises(StopRequested):
            RealClock(stop).sleep(1000.0)
        raised.set()

    thread = threading.Thread(target=wait)
    thread.start()
    stop.request()
    thread.join(30.0)
    assert raised.is_set()


def test_while_devices_are_made_safe_waits_finish():
    stop = StopFlag()
    stop.request()
    clock = VirtualClock(stop)
    with stop.held():
        clock.sleep(0.005)
        clock.check()
        RealClock(stop).sleep(0.001)
    assert clock.now() == 0.005
    assert stop.is_set
    with pytest.raises(StopRequested):
        clock.check()


def test_paced_time_passes_in_real_time():
    clock = PacedClock(StopFlag())
    start = time.monotonic()
    clock.sleep(0.02)
    assert clock.now() == 0.02
    assert time.monotonic() - start >= 0.02
