"""What goes wrong with a radio, by a radio that really does it."""

from __future__ import annotations

import os
import queue
import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from labseq_soapy import link, soapysdr
from labseq_soapy.soapysdr import SoapyError
from labseq_soapy.streamer import Streamer, repeated
from labseq_soapy_sim import Fault, Ring

from labseq import DeviceError, TransientError
from labseq.errors import StopRequested

from .labseq_soapy_rig import another_labseq, depth, made, opened, recorded, until


def raised(kind: type[Exception], call: Callable[[], object]) -> Callable[[], bool]:
    """Whether a call raises this by now; anything else it raises is an error."""

    def condition() -> bool:
        try:
            call()
        except kind:
            return True
        return False

    return condition


class TestOpening:
    @pytest.mark.parametrize(
        ("arguments", "text"),
        [
            (
                "fault=absent",
                "cannot be opened: .*no such radio; `SoapySDRUtil --find` lists the radios",
            ),
            ("channels=1", r"it has 1 channel\(s\) that transmit; expected 2, one for each AOD"),
            (
                "coerce_rate=1000000",
                "makes 1000000 samples per second; expected 1200000: choose a sample_rate",
            ),
        ],
    )
    def test_tells_what_is_wrong_with_the_radio(self, arguments: str, text: str) -> None:
        rig = made(arguments=arguments)
        with pytest.raises(DeviceError, match=text):
            rig.tweezers.open()
        rig.tweezers.close()

    def test_a_radio_that_another_program_has_says_that_it_is_busy(self, tmp_path: Path) -> None:
        folder = f"folder={tmp_path}"
        with opened(arguments=folder), pytest.raises(DeviceError, match="the device is busy"):
            made(arguments=folder).tweezers.open()

    def test_tells_the_range_of_the_gain(self) -> None:
        with pytest.raises(DeviceError, match="a gain of 70 dB; channel 1 has 0 to 60 dB"):
            made(column_gain=70.0).tweezers.open()

    def test_without_the_library_the_error_says_how_to_install_it(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(soapysdr, "_NAMES", {"linux": ("libNoSuchRadio.so",)})
        soapysdr.library.cache_clear()
        with pytest.raises(SoapyError, match=r"the library SoapySDR cannot be loaded .*libsoapysdr0.8"):
            soapysdr.library()

    def test_without_a_compiler_tells_what_to_install(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        rig = made()
        monkeypatch.setenv("LABSEQ_CACHE", str(tmp_path))
        monkeypatch.setenv("CXX", "no-such-compiler")
        for use in (rig.tweezers.warm, rig.tweezers.open):
            with pytest.raises(DeviceError, match=r"no C\+\+ compiler here; .* g\+\+ libsoapysdr-dev"):
                use()

    def test_what_takes_long_is_done_before_the_radio_is_opened(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        rig = made()
        monkeypatch.setenv("LABSEQ_CACHE", str(tmp_path))
        rig.tweezers.warm()
        assert list(tmp_path.rglob("libcapture.so"))
        monkeypatch.setenv("CXX", "no-such-compiler")
        rig.tweezers.open()
        rig.tweezers.close()


class TestUnderflow:
    def test_while_the_array_is_on_asks_for_the_shot_again_and_is_counted(self) -> None:
        with opened() as rig:
            rig.tweezers.start()
            rig.ring.set_fault(Fault.UNDERFLOW)
            until(raised(TransientError, rig.tweezers.check_interlocks))
            rig.tweezers.check_interlocks()
            rig.tweezers.ramp(0.5, 0.001)
            assert rig.described("underflows") == 1

    def test_in_the_dark_harms_nobody(self) -> None:
        with opened() as rig:
            rig.ring.set_fault(Fault.UNDERFLOW)
            until(lambda: rig.described("underflows") == 1)
            rig.tweezers.check_interlocks()
            rig.tweezers.start()

    def test_is_reported_when_the_streaming_process_really_is_held_up(self) -> None:
        with opened(arguments="patience=0.3") as rig:
            rig.tweezers.start()
            pid = _process(rig)
            os.kill(pid, signal.SIGSTOP)
            until(lambda: not rig.ring.is_playing)
            os.kill(pid, signal.SIGCONT)
            until(raised(TransientError, rig.tweezers.check_interlocks))


class TestRampBrokenOff:
    """By a stop request: whatever the depth is then, it is not the one that was asked for."""

    def test_downwards_is_no_dark_array_for_the_safe_state(self) -> None:
        with opened() as rig:
            rig.tweezers.start()
            _break_off(rig, 0.0)
            with rig.clock.stop.held():
                rig.tweezers.safe_state()
            assert not rig.ring.latest(100).any()
            assert rig.described("depth") == 0.0

    def test_is_made_up_for_when_the_array_is_started(self) -> None:
        with opened() as rig:
            rig.tweezers.start()
            before = np.abs(rig.ring.latest(100)).max()
            _break_off(rig, 0.5)
            _break_off(rig, 1.0)
            with rig.clock.stop.held():
                rig.tweezers.start()
            assert np.abs(rig.ring.latest(100)).max() == pytest.approx(before)


def test_a_radio_may_take_long_to_open_but_then_its_silence_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link, "SILENT_S", 0.0)
    with opened() as rig, pytest.raises(DeviceError, match=r"its streaming process .* hangs"):
        rig.tweezers.check_interlocks()


class TestDeadStream:
    def test_ends_the_run_with_what_the_radio_said(self) -> None:
        with opened() as rig:
            rig.tweezers.start()
            rig.ring.set_fault(Fault.STREAM_ERROR)
            until(raised(DeviceError, rig.tweezers.check_interlocks))
            with pytest.raises(DeviceError, match=r"writing to the stream: the stream failed \(-2\)"):
                rig.tweezers.start()
            rig.tweezers.safe_state()

    def test_is_noticed_when_the_radio_takes_no_more_samples(self) -> None:
        with opened() as rig:
            rig.tweezers.start()
            rig.ring.set_fault(Fault.STALL)
            with pytest.raises(DeviceError, match="took no samples for 2 s; the array is dark"):
                rig.tweezers.ramp(0.5, 0.1)

    def test_of_a_process_that_was_killed_can_be_opened_anew(self) -> None:
        with opened() as rig:
            rig.tweezers.start()
            os.kill(_process(rig), signal.SIGKILL)
            until(raised(DeviceError, rig.tweezers.check_interlocks))
            with pytest.raises(
                DeviceError, match=r"its streaming process ended with code -9.*the array is dark"
            ):
                rig.tweezers.ramp(0.5, 0.1)
            assert not rig.ring.is_playing
            rig.tweezers.safe_state()
            rig.tweezers.close()
            rig.tweezers.open()
            rig.tweezers.start()
            assert rig.ring.is_playing

    def test_ramps_down_when_its_process_is_asked_to_end_by_a_signal(self, tmp_path: Path) -> None:
        with opened(arguments=f"folder={tmp_path},record=10000000") as rig:
            rig.tweezers.start()
            os.kill(_process(rig), signal.SIGTERM)
            until(raised(DeviceError, rig.tweezers.check_interlocks))
            with pytest.raises(DeviceError, match="asked to end by a signal"):
                rig.tweezers.start()
        assert_ramped_down(tmp_path)


class TestLabseqGone:
    def test_killed_while_the_array_is_on_it_is_ramped_down(self, tmp_path: Path) -> None:
        with another_labseq(tmp_path) as labseq:
            labseq.kill()
            ring = Ring(tmp_path)
            until(lambda: not ring.is_playing)
        assert_ramped_down(tmp_path)

    def test_hung_while_the_array_is_on_it_is_ramped_down(self, tmp_path: Path) -> None:
        with another_labseq(tmp_path, patience=0.3) as labseq:
            ring = Ring(tmp_path)
            os.kill(labseq.pid, signal.SIGSTOP)
            until(lambda: not ring.is_playing)
            assert_ramped_down(tmp_path)

    def test_killed_with_hold_the_light_stays_until_the_next_labseq_ends_it(self, tmp_path: Path) -> None:
        with another_labseq(tmp_path, on_exit="hold") as labseq:
            ring = Ring(tmp_path)
            labseq.kill()
            labseq.wait()
            until(lambda: any(_alone()))
            assert ring.is_playing
            assert np.abs(ring.latest(100)).max() > 0.1
        with opened(arguments=f"folder={tmp_path},record=10000000", on_exit="hold") as rig:
            assert not any(_alone())
            assert not rig.ring.latest(100).any()
            rig.tweezers.start()


class Sink:
    """A stream that takes everything and keeps the latest."""

    def __init__(self) -> None:
        self.latest = np.zeros(0, np.float32)

    def write(self, samples: np.ndarray, start: int, timeout_s: float) -> int:
        self.latest = samples[:, 2 * start :].copy()
        return self.latest.shape[1] // 2

    def underflows(self) -> int:
        return 0


def test_a_command_that_comes_while_the_light_is_ramped_down_does_not_turn_it_on() -> None:
    sink, inbox = Sink(), queue.SimpleQueue[dict[str, Any]]()
    loop = repeated(np.ones((2, 160), np.float32))
    inbox.put({"do": "loop", "id": 1, "loop": loop, "fade_s": 0.0})
    inbox.put({"do": "ramp", "id": 2, "depth": 1.0, "duration_s": 0.0})
    inbox.put({"do": "end"})
    inbox.put({"do": "ramp", "id": 3, "depth": 1.0, "duration_s": 0.0})
    commands = SimpleNamespace(inbox=inbox, closed=False, last_s=float("inf"))
    setup = SimpleNamespace(ramp_s=0.1, hold=False, max_wait_s=5.0)
    posted: list[Any] = []
    streamer = Streamer(cast("Any", sink), cast("Any", setup), 1.2e6, cast("Any", commands), posted.append)
    streamer.run()
    assert not sink.latest[:, -2:].any()
    assert {"done": 3} not in posted


def test_a_loop_that_cannot_be_read_ends_the_stream_by_a_ramp() -> None:
    with opened() as rig:
        rig.tweezers.start()
        assert rig.tweezers._link is not None
        rig.tweezers._link._send({"do": "loop", "id": 99, "file": "none.npy", "fade_s": 0.0})
        until(raised(DeviceError, rig.tweezers.check_interlocks))
        with pytest.raises(DeviceError, match=r"a loop cannot be read: .*none\.npy.*; the array is dark"):
            rig.tweezers.check_interlocks()


def test_a_radio_that_is_not_there_is_refused_by_the_library() -> None:
    made()
    with pytest.raises(SoapyError, match="no match"):
        soapysdr.Radio("driver=capture,serial=none")


def assert_ramped_down(folder: Path) -> None:
    """What both outputs were sent goes to nothing in a linear ramp of 10 ms."""
    for channel in (0, 1):
        samples = recorded(folder, channel)
        assert not samples[-1000:].any()
        lit = np.flatnonzero(samples)
        full = slice(int(lit[0]) + 20_000, int(lit[-1]) - 20_000)
        course = depth(samples, 80, full)
        falling = course[full.stop :]
        assert not np.isnan(falling).any(), "a phase jumped"
        known = falling[np.abs(samples[full.stop :]) > 0.02]
        assert np.abs(np.diff(known)).max() < 20 / (0.01 * 1.2e6)


def _process(rig: Any) -> int:
    return int(rig.tweezers._link.pid)


def _break_off(rig: Any, depth: float) -> None:
    """Begin a ramp of 10 s; the operator stops the run."""
    rig.clock.stop.request()
    with pytest.raises(StopRequested):
        rig.tweezers.ramp(depth, 10.0)


def _alone() -> list[Path]:
    return list((Path(os.environ["LABSEQ_STATE"]) / "soapy").glob("*.alone"))
