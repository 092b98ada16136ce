"""The simulated radio under the driver's calls, in virtual time: buffers, underflows, tuning."""

from __future__ import annotations

import queue
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from labseq_soapy_sim import Fault, Ring, SimulatedDevice
from labseq_soapy_stream.messages import Setup
from labseq_soapy_stream.output import BLOCK, Samples
from labseq_soapy_stream.radio import Stream, open_radio, read_back, set_up
from labseq_soapy_stream.soapysdr import SoapyError
from labseq_soapy_stream.streamer import Streamer, repeated

from labseq.testing.fakes import FakeClock

NOISE: Samples = np.random.default_rng(1).standard_normal((2, 2 * BLOCK), np.float32)


@dataclass
class Bench:
    """An active stream, and what is behind it."""

    clock: FakeClock
    radio: SimulatedDevice
    stream: Stream
    ring: Ring

    def write(self, n: int, timeout_s: float = 0.0) -> int:
        return self.stream.write(NOISE[:, : 2 * n], 0, timeout_s)


@contextmanager
def streaming(folder: Path, *, lo_offset_hz: float = 0.0) -> Generator[Bench]:
    """A radio that was opened, set up and activated at 1.2 MS/s; closed after the block."""
    setup = Setup(
        device=f"driver=capture,speed=1,patience=0,buffer=0.02,folder={folder}",
        channels=(0, 1),
        rate_hz=1.2e6,
        oscillator_hz=100e6,
        antenna="",
        clock_source="",
        ramp_s=0.0,
        max_wait_s=1.0,
        marker="",
        stream="",
        lo_offset_hz=lo_offset_hz,
        bandwidth_hz=None,
        gain_db=(12.1, None),
    )
    clock = FakeClock()
    radio = open_radio(lambda arguments: SimulatedDevice(arguments, clock), setup)
    assert isinstance(radio, SimulatedDevice)
    stream = set_up(radio, setup)
    read_back(radio, setup)
    stream.activate()
    yield Bench(clock, radio, stream, Ring(folder))
    stream.close()
    radio.close()


def test_the_buffer_fills_to_the_sample_and_is_played_from_the_start_time_on(tmp_path: Path) -> None:
    with streaming(tmp_path) as bench:
        assert [bench.write(20_000) for _ in range(3)] == [16_384, 24_000 - 16_384, 0]
        assert bench.write(1, timeout_s=0.05) == 0
        assert bench.clock.now() == pytest.approx(0.05), "it waits as long as it may, and no longer"
        bench.clock.sleep(0.06)  # the start was after 0.1 s
        assert bench.write(20_000) == pytest.approx(12_000, abs=1)
        assert bench.write(1200, timeout_s=1.0) == 1200
        assert bench.clock.now() == pytest.approx(0.111, abs=1e-5)
        assert bench.stream.starts_together
        assert np.array_equal(bench.ring.latest(1200), NOISE[:, :2400].view(np.complex64))


def test_an_underflow_is_reported_once_until_there_are_samples_again(tmp_path: Path) -> None:
    with streaming(tmp_path) as bench:
        bench.write(1200)
        bench.clock.sleep(0.1)
        assert not bench.stream.errors()
        bench.clock.sleep(0.002)
        for _ in range(2):
            assert bench.stream.errors(0.1) == {"underflows": 1}
            assert not bench.stream.errors(0.1)
            assert bench.write(1200) == 1200
            bench.clock.sleep(0.0011)


def test_a_shift_of_the_samples_keeps_their_zero_where_it_was_asked_for(tmp_path: Path) -> None:
    with streaming(tmp_path, lo_offset_hz=200e3) as bench:
        assert bench.radio.component_hz(1, "RF") == 100.2e6
        assert bench.radio.get("Frequency", 1) == 100e6


def test_a_setting_is_rounded_to_what_the_radio_has(tmp_path: Path) -> None:
    with streaming(tmp_path) as bench:
        assert bench.radio.get("Gain", 0) == 12.0
        bench.radio.set("Gain", 0, 99.0)
        assert bench.radio.get("Gain", 0) == 60.0
        with pytest.raises(SoapyError, match="there is no channel 2"):
            bench.radio.set("Gain", 2, 1.0)


def streamer(bench: Bench, *messages: dict[str, Any]) -> tuple[Streamer, list[Any]]:
    """A streamer that receives these messages, and what it posts."""
    inbox, posted = queue.SimpleQueue[dict[str, Any]](), list[Any]()
    for message in messages:
        inbox.put(message)
    setup = SimpleNamespace(ramp_s=0.1, max_wait_s=5.0)
    commands = SimpleNamespace(inbox=inbox, closed=False, last_s=float("inf"), setup=setup)
    return Streamer(bench.stream, 1.2e6, cast("Any", commands), posted.append), posted


def test_a_radio_that_takes_no_more_samples_is_noticed(tmp_path: Path) -> None:
    with streaming(tmp_path) as bench:
        bench.ring.set_fault(Fault.STALL)
        with pytest.raises(SoapyError, match="the radio took no samples for 2 s"):
            streamer(bench)[0].run()
        assert 2.0 <= bench.clock.now() < 2.2


def test_a_command_that_comes_while_the_light_is_ramped_down_does_not_turn_it_on(tmp_path: Path) -> None:
    with streaming(tmp_path) as bench:
        stream, posted = streamer(
            bench,
            {"do": "loop", "id": 1, "loop": repeated(np.ones((2, 160), np.float32)), "fade_s": 0.0},
            {"do": "ramp", "id": 2, "depth": 1.0, "duration_s": 0.0},
            {"do": "end"},
            {"do": "ramp", "id": 3, "depth": 1.0, "duration_s": 0.0},
        )
        stream.run()
        assert bench.ring["sent"] >= 0.1 * 1.2e6
        assert not bench.ring.latest(1).any()
        assert {"done": 3} not in posted


def test_a_radio_that_is_closed_before_its_stream_is_an_error(tmp_path: Path) -> None:
    with streaming(tmp_path) as bench, pytest.raises(SoapyError, match="before its stream"):
        bench.radio.close()
