"""What goes wrong with a radio, by a radio that really does it."""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labseq_soapy import link, static_tweezers
from labseq_soapy.access import marker_of
from labseq_soapy_sim import Fault, Ring, read_trace
from labseq_soapy_stream import soapysdr
from labseq_soapy_stream.soapysdr import SoapyError
from labseq_soapy_stream.streamer import raise_priority

from labseq import DeviceError, TransientError
from labseq.errors import StopRequested

from .labseq_soapy_rig import (
    SMALL,
    Rig,
    assert_ramped_down,
    made,
    opened,
    recorded,
    until,
)


def raised(kind: type[Exception], call: Callable[[], object]) -> Callable[[], bool]:
    """Whether a call raises this by now; anything else it raises is an error."""

    def condition() -> bool:
        try:
            call()
        except kind:
            return True
        return False

    return condition


def link_of(rig: Rig) -> Any:
    return rig.tweezers._link


@pytest.mark.parametrize(
    ("arguments", "chosen", "text"),
    [
        ("fault=absent", {}, "no such radio; `SoapySDRUtil --find`"),
        ("channels=1", {}, r"1 channel\(s\) that transmit, not 2"),
        ("coerce_rate=1000000", {}, "1000000 samples per second, not 1200000; choose a sample_rate"),
        ("speed=1", {"column_gain": 70.0}, "70 dB; channel 1 has 0 to 60 dB"),
        ("speed=1", {"antenna": "RX2"}, "there is no antenna RX2"),
        ("fault=inactive", {}, r"starting the stream: STREAM_ERROR \(-2\)"),
        ("detune=13000", {}, "local oscillator to 100028000 Hz, not 100015000 Hz"),
    ],
)
def test_a_wrong_radio_is_refused_with_what_is_wrong_and_stays_off(
    tmp_path: Path, arguments: str, chosen: dict[str, Any], text: str
) -> None:
    rig = made(arguments=f"folder={tmp_path},{arguments}", **chosen)
    with pytest.raises(DeviceError, match=text):
        rig.tweezers.open()
    rig.tweezers.close()
    assert not (tmp_path / "ring").exists() or not Ring(tmp_path).is_transmitting


def test_a_radio_that_another_program_has_is_busy(tmp_path: Path) -> None:
    folder = f"folder={tmp_path}"
    with opened(arguments=folder), pytest.raises(DeviceError, match="the device is busy"):
        made(arguments=folder).tweezers.open()


def test_without_the_library_the_error_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soapysdr, "_NAMES", {"linux": ("libNoSuchRadio.so",)})
    soapysdr.library.cache_clear()
    with pytest.raises(SoapyError, match=r"the library SoapySDR cannot be loaded .*libsoapysdr0.8"):
        soapysdr.library()


DISTURBANCES = [
    (Fault.UNDERFLOW, "underflows", "ran out of samples"),
    (Fault.LOST_PACKET, "sequence_errors", "missed packets"),
    (Fault.LATE_PACKET, "late_packets", "missed packets"),
]


@pytest.mark.parametrize(("fault", "count", "did"), DISTURBANCES)
def test_a_disturbance_asks_for_the_shot_again_if_the_array_is_on_and_many_in_a_minute_end_the_run(
    fault: Fault, count: str, did: str
) -> None:
    with opened(max_disturbances=1) as rig:

        def disturb(n: int) -> None:
            rig.ring.set_fault(fault)
            until(lambda: rig.tweezers.poll()[count] == n)

        disturb(1)
        rig.tweezers.check_interlocks()  # harmless in the dark
        rig.tweezers.start()
        once = re.escape(f"{did} 1 time(s) while the array was on")
        for n, pause_s in ((2, 0.0), (3, 61.0)):
            rig.clock.sleep(pause_s)
            disturb(n)
            with pytest.raises(TransientError, match=once):
                rig.tweezers.check_interlocks()
            rig.tweezers.check_interlocks()
            rig.tweezers.ramp(0.5, 0.001)
        disturb(4)
        with pytest.raises(
            DeviceError, match=rf"{did} 1 time\(s\) .* 2 disturbances within a minute; max_.* allows 1"
        ):
            rig.tweezers.check_interlocks()
        names = "underflows", "sequence_errors", "late_packets"
        assert rig.tweezers.poll() == {name: 4 if name == count else 0 for name in names}
        rig.tweezers.safe_state()
        assert not rig.ring.latest(100).any()


@pytest.mark.parametrize("arguments", ["time=1", "time=0", "time=2", "delay=0.3"])
def test_both_outputs_start_at_one_time_of_the_radio_s_clock_or_it_is_said_that_they_do_not(
    arguments: str,
) -> None:
    with opened(arguments=arguments) as rig:
        rig.tweezers.start()
        rows_s, columns_s = rig.ring["start_s"]
        assert (rows_s == columns_s) == (arguments == "time=1")
        assert rig.described("notes") == ([] if arguments == "time=1" else [static_tweezers.APART])


@pytest.mark.skipif(sys.platform != "linux", reason="priorities of Linux")
def test_the_process_has_real_time_priority_or_the_reason_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def real_time(*args: Any) -> link.Link:
        name, clock, setup, log, environment, _ = args
        return link.Link(name, clock, setup, log, environment, ["--real-time"])

    monkeypatch.setattr(static_tweezers, "Link", real_time)
    with opened() as rig:
        notes, scheduler = rig.described("notes"), os.sched_getscheduler(link_of(rig).pid)
    allowed = scheduler == os.SCHED_FIFO
    assert allowed or ["operation not permitted" in note for note in notes] == [True]
    assert not (allowed and notes)

    def refuse(*_: Any) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert raise_priority() == "operation not permitted"


def break_off(rig: Rig, depth: float) -> None:
    """Begin a ramp of 10 s; the operator stops the run."""
    rig.clock.stop.request()
    with pytest.raises(StopRequested):
        rig.tweezers.ramp(depth, 10.0)


def test_after_a_ramp_that_was_broken_off_the_depth_is_not_taken_for_the_one_that_was_requested() -> None:
    with opened() as rig:
        rig.tweezers.start()
        before = np.abs(rig.ring.latest(100)).max()
        break_off(rig, 0.5)
        until(lambda: bool(np.abs(rig.ring.latest(100)).max() < 0.999 * before))
        break_off(rig, 1.0)
        with rig.clock.stop.held():
            rig.tweezers.start()
        assert np.abs(rig.ring.latest(100)).max() == pytest.approx(before)
        break_off(rig, 0.0)
        with rig.clock.stop.held():
            rig.tweezers.safe_state()
        assert not rig.ring.latest(100).any()
        assert rig.described("depth") == 0.0


def test_a_radio_may_take_long_to_open_but_then_its_silence_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link, "SILENT_S", 0.0)
    with opened() as rig, pytest.raises(DeviceError, match=r"its streaming process .* hangs"):
        rig.tweezers.check_interlocks()


def test_a_broken_stream_ends_the_run_with_what_the_radio_reported() -> None:
    with opened() as rig:
        rig.tweezers.start()
        rig.ring.set_fault(Fault.STREAM_ERROR)
        until(raised(DeviceError, rig.tweezers.check_interlocks))
        with pytest.raises(DeviceError, match=r"STREAM_ERROR \(-2\); the array is dark"):
            rig.tweezers.start()
        rig.tweezers.safe_state()


def test_after_its_process_was_killed_the_radio_can_be_opened_again() -> None:
    with opened() as rig:
        rig.tweezers.start()
        assert os.getpgid(link_of(rig).pid) != os.getpgid(0), "Ctrl-C in a terminal is for labseq alone"
        os.kill(link_of(rig).pid, signal.SIGKILL)
        until(raised(DeviceError, rig.tweezers.check_interlocks))
        text = r"its streaming process ended with code -9.*the array is dark"
        with pytest.raises(DeviceError, match=text):
            rig.tweezers.ramp(0.5, 0.1)
        assert not rig.ring.is_playing
        assert rig.ring.is_transmitting, "its local oscillator leaks"
        rig.tweezers.safe_state()
        assert not rig.ring.is_transmitting
        rig.tweezers.close()
        rig.tweezers.open()
        rig.tweezers.start()
        assert rig.ring.is_playing


def test_a_radio_that_is_gone_with_its_process_is_not_safe(tmp_path: Path) -> None:
    with opened(arguments=f"folder={tmp_path}") as rig:
        rig.tweezers.start()
        link = link_of(rig)
        link._setup = replace(link._setup, device="driver=none")
        os.kill(link.pid, signal.SIGKILL)
        until(raised(DeviceError, rig.tweezers.check_interlocks))
        for call in (rig.tweezers.safe_state, rig.tweezers.close):
            with pytest.raises(DeviceError, match=r"'driver=none' cannot be opened again: .* by hand"):
                call()
        rig.tweezers.close()


def test_a_radio_that_was_unplugged_is_not_safe(tmp_path: Path) -> None:
    with opened(arguments=f"folder={tmp_path}") as rig:
        rig.tweezers.start()
        rig.ring.set_fault(Fault.GONE)
        until(raised(DeviceError, rig.tweezers.check_interlocks))
        for call in (rig.tweezers.safe_state, rig.tweezers.close):
            with pytest.raises(DeviceError, match=r"cannot be opened again: .*no such radio.* by hand"):
                call()


def test_a_call_of_the_radio_that_does_not_return_is_noticed_and_the_transmitters_are_switched_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(link, "END_S", 0.1)
    with opened(arguments=f"folder={tmp_path},record=1") as rig:
        rig.tweezers.start()
        rig.ring.set_fault(Fault.HANG)
        monkeypatch.setattr(link, "SILENT_S", 1.0)
        until(raised(DeviceError, rig.tweezers.check_interlocks))
        with pytest.raises(DeviceError, match="hangs, as it sent nothing"):
            rig.tweezers.safe_state()
    assert [name for _, name, *_ in read_trace(tmp_path)][-4:] == ["open", "gain", "gain", "close"]
    assert not Ring(tmp_path).is_transmitting


def end_by_a_signal(rig: Rig) -> None:
    os.kill(link_of(rig).pid, signal.SIGTERM)


def hang(rig: Rig) -> None:
    """labseq sends nothing any more."""
    link_of(rig)._closing.set()


@pytest.mark.parametrize(
    ("end", "text"),
    [(end_by_a_signal, "asked to end by a signal"), (hang, "labseq sent nothing for 0.3 s")],
)
def test_the_light_is_ramped_down_by_a_signal_and_when_labseq_hangs(
    tmp_path: Path, end: Callable[[Rig], None], text: str
) -> None:
    with opened(arguments=f"folder={tmp_path},record=10000000", patience=0.3) as rig:
        rig.tweezers.start()
        until(lambda: bool(np.count_nonzero(recorded(tmp_path)) > 100_000))
        end(rig)
        until(raised(DeviceError, rig.tweezers.check_interlocks))
        with pytest.raises(DeviceError, match=text):
            rig.tweezers.start()
    assert_ramped_down(tmp_path)


def test_left_on_after_the_run_the_light_stays_until_the_next_labseq_ends_it(tmp_path: Path) -> None:
    marker = marker_of(f"{SMALL['device']},folder={tmp_path},record=10000000")
    with opened(arguments=f"folder={tmp_path},record=10000000", after_run="on") as rig:
        assert not rig.tweezers.leave_on(), "it was not on"
        rig.tweezers.start()
        script = rig.tweezers.emergency()
        assert script is not None, "until then the watchdog switches it off"
        # it has buffered 20 ms, and has played a little while that was written
        assert 0.03 * (1 - 1e-6) < script.arguments["ramp_s"] < 0.06, "also what the radio has buffered"
        assert rig.tweezers.leave_on()
        assert rig.tweezers.emergency() is None
        rig.tweezers.safe_state()
        rig.tweezers.close()
        ring, number = Ring(tmp_path), marker.read_text("ascii")
        assert np.abs(ring.latest(100)).max() > 0.1
    until(lambda: ring.is_playing)
    assert marker.read_text("ascii") == number
    n_lit = np.count_nonzero(recorded(tmp_path))
    until(lambda: bool(np.count_nonzero(recorded(tmp_path)) > n_lit + 50_000))
    with opened(arguments=f"folder={tmp_path},record=10000000") as rig:
        assert not marker.exists()
        assert not rig.ring.latest(100).any()
        rig.tweezers.start()
        assert not rig.tweezers.leave_on(), "after_run is off by default"


def test_a_loop_that_cannot_be_read_ends_the_stream_by_a_ramp() -> None:
    with opened() as rig:
        rig.tweezers.start()
        link_of(rig)._send({"do": "loop", "id": 99, "file": "none.npy", "fade_s": 0.0})
        until(raised(DeviceError, rig.tweezers.check_interlocks))
        with pytest.raises(DeviceError, match=r"a loop cannot be read: .*none\.npy.*; the array is dark"):
            rig.tweezers.check_interlocks()


@pytest.mark.parametrize(
    ("loop", "source", "why"),
    [
        ("lo", "", r"not locked \(lo_locked 0, lo_locked 1\); can it tune to `local_oscillator`\?"),
        ("ref", "external", r"not locked \(ref_locked\); .*`clock_source: external`"),
        ("ref", "", ""),
    ],
)
def test_a_radio_that_is_not_locked_fails_its_self_test(loop: str, source: str, why: str) -> None:
    with opened(device=f"simulated,unlocked={loop}", clock_source=source) as rig:
        if not why:  # its own clock has no reference
            rig.tweezers.self_test()
            return
        with pytest.raises(DeviceError, match=why):
            rig.tweezers.self_test()
