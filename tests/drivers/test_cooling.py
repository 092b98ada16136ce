"""Waiting until a sensor is cold, and stays so."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given, strategies as st

from labseq.drivers.camera import LOOK_S
from labseq.plugin import DeviceTimeoutError, StopRequested
from labseq.plugin.camera import Cooling, settle
from labseq.testing.fakes import FakeClock

COOLING = Cooling(203.15, tolerance_k=1.0, steady_s=5.0, timeout_s=100.0)


def wait(temperature_at: Callable[[float], float], cooling: Cooling = COOLING) -> float:
    """How long it takes."""
    clock = FakeClock()
    clock.sleep(1000.0)
    settle(cooling, lambda: temperature_at(clock.now() - 1000.0), clock, "camera")
    return clock.now() - 1000.0


def test_time_counts_from_when_it_is_within_the_tolerance() -> None:
    assert wait(lambda t: 293.15 - 9.0 * min(t, 10.0)) == 15.0


def test_an_overshoot_begins_the_count_again() -> None:
    assert wait(lambda _t: 203.15) == 5.0
    assert wait(lambda t: 201.0 if 3.0 <= t < 20.0 else 203.0) == 25.0


@given(st.floats(0.0, 90.0))
def test_it_is_seen_within_a_look_of_being_steady(cold_s: float) -> None:
    assert cold_s + 5.0 <= wait(lambda t: 203.15 if t >= cold_s else 293.15) <= cold_s + 5.0 + LOOK_S


def test_a_sensor_that_stays_warm_times_out_with_its_temperature() -> None:
    with pytest.raises(
        DeviceTimeoutError, match=r"^camera: .*-69.0 degC .*-70.0 degC within 0.5 K"
    ) as caught:
        wait(lambda _t: 204.15, Cooling(203.15, tolerance_k=0.5, timeout_s=100.0))
    assert caught.value.timeout_s == 100.0


def test_a_stop_request_ends_the_wait() -> None:
    clock = FakeClock()

    def read_k() -> float:
        clock.stop.request()
        return 293.15

    with pytest.raises(StopRequested):
        settle(COOLING, read_k, clock, "camera")
