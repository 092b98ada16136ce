"""The sensor of a simulated camera: when its exposures are, and when its frames can be read."""

from __future__ import annotations

import threading

import pytest
from hypothesis import given, strategies as st
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation

from labseq.plugin import Context, SensorMode
from labseq.plugin.camera import Series, SimulatedSensor
from labseq.roles import WHOLE_SENSOR
from labseq.testing.fakes import Calls, FakeClock, RecordingSimulation

READOUT_S = 5e-3


class Bench:
    """A sensor in a dark simulation, on a virtual clock."""

    def __init__(self) -> None:
        self.clock = FakeClock()
        self.calls = Calls(self.clock)
        self.sensor = SimulatedSensor(RecordingSimulation(self.calls), self.clock)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_a_frame_is_due_after_exposure_and_read_out(bench: Bench) -> None:
    bench.clock.sleep(1.0)
    bench.sensor.arm(Series(1, 0.045, "software"), WHOLE_SENSOR, READOUT_S)
    begun = bench.sensor.expose()
    assert bench.clock.now() == 1.0
    taken = bench.sensor.take(0.1)
    assert taken is begun
    assert taken is not None
    assert (taken.t_start_s, taken.exposure_s) == (1.0, 0.045)
    assert bench.clock.now() == pytest.approx(1.05)


def test_a_frame_may_come_late_and_waits_until_it_is_read(bench: Bench) -> None:
    bench.sensor.arm(Series(1, 0.045, "software"), WHOLE_SENSOR, READOUT_S)
    bench.sensor.expose(late_s=2.0)
    assert bench.sensor.take(1.0) is None
    assert bench.clock.now() == 1.0
    assert bench.sensor.take(2.0) is not None
    assert bench.clock.now() == pytest.approx(2.05)
    assert bench.sensor.take(0.3) is None
    assert bench.clock.now() == pytest.approx(2.35)


@given(st.integers(1, 6), st.floats(1e-3, 1.0), st.floats(0.0, 0.1), st.floats(0.0, 5.0))
def test_with_the_internal_trigger_exposures_follow_read_outs(
    n_frames: int, exposure_s: float, readout_s: float, asked_s: float
) -> None:
    bench = Bench()
    bench.clock.sleep(3.0)
    bench.sensor.arm(Series(n_frames, exposure_s, "internal"), WHOLE_SENSOR, readout_s)
    bench.clock.sleep(asked_s)  # whenever the exposures are asked for
    for _ in range(n_frames):
        assert bench.sensor.expose() is not None
    starts_s = [3.0 + k * (exposure_s + readout_s) for k in range(n_frames)]
    assert [call.args[0] for call in bench.calls] == pytest.approx(starts_s)
    for _ in range(n_frames):
        assert bench.sensor.take(100.0) is not None
    assert bench.clock.now() == pytest.approx(max(3.0 + asked_s, starts_s[-1] + exposure_s + readout_s))


def test_no_more_exposures_than_armed_for(bench: Bench) -> None:
    assert bench.sensor.expose() is None
    bench.sensor.arm(Series(2, 0.01, "software"), WHOLE_SENSOR, READOUT_S)
    assert [bench.sensor.expose() is None for _ in range(3)] == [False, False, True]
    assert len([call.args[0] for call in bench.calls]) == 2


def test_a_trigger_that_was_not_seen_counts_as_an_exposure_and_leaves_the_world_in_the_dark(
    bench: Bench,
) -> None:
    bench.sensor.arm(Series(2, 0.01, "software"), WHOLE_SENSOR, READOUT_S)
    bench.sensor.skip()
    assert [call.args[0] for call in bench.calls] == []
    assert [bench.sensor.expose() is None for _ in range(2)] == [False, True]


def test_arming_and_clearing_drop_frames(bench: Bench) -> None:
    series = Series(2, 0.01, "software")
    bench.sensor.arm(series, WHOLE_SENSOR, READOUT_S)
    bench.sensor.expose()
    bench.sensor.arm(series, WHOLE_SENSOR, READOUT_S)
    assert bench.sensor.take(1.0) is None
    bench.sensor.expose()
    bench.sensor.clear()
    assert bench.sensor.take(1.0) is None
    assert bench.sensor.expose() is None


def test_frames_are_taken_in_the_mode_of_the_series(bench: Bench) -> None:
    mode = SensorMode((0, 0, 100, 60), 2)
    bench.sensor.arm(Series(1, 0.01, "software"), mode, READOUT_S)
    frame = bench.sensor.expose()
    assert frame is not None
    assert frame.image.shape == mode.frame_shape((512, 512)) == (50, 30)


def test_another_thread_may_expose() -> None:
    clock = FakeClock()
    world = VirtualSimulation(SimulationSettings(), Context("simulation", clock=clock))
    world.open()
    sensor = SimulatedSensor(world, clock)
    sensor.arm(Series(20, 1e-3, "internal"), WHOLE_SENSOR, READOUT_S)
    n_begun = list[int]()

    def expose() -> None:
        n = 0
        while sensor.expose() is not None:
            n += 1
        n_begun.append(n)

    threads = [threading.Thread(target=expose) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(n_begun) == 20
    starts_s = [frame.t_start_s for frame in iter(lambda: sensor.take(1.0), None)]
    assert starts_s == pytest.approx([k * 6e-3 for k in range(20)])
