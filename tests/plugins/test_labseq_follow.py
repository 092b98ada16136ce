"""Another control system leads, over TCP and on a serial line."""

from __future__ import annotations

import sys
import threading
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any, ClassVar

import pytest
from hypothesis import given, strategies as st
from labseq_follow.answers import Asked, Form
from labseq_follow.leader import serial_leader, tcp_leader
from labseq_follow.protocol import Dialogue, Splitter
from labseq_follow.settings import SerialLeaderSettings, TcpLeaderSettings

from labseq.config.document import Document
from labseq.guard import StopFlag
from labseq.plugin import ConfigError, Context, Device, DeviceError, DeviceTimeoutError, StopRequested
from labseq.sequencer.clock import RealClock
from labseq.testing import DeviceContract
from labseq.testing.contracts.hardware import Factory, Wait
from labseq.testing.fakes import FakeClock, RecordingSimulation

from .labseq_follow_rig import PtyPeer, led, listening

on_a_pty = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no ptys")


class LeaderContract(DeviceContract):
    values: ClassVar[list[str]] = ["state", "is_connected"]  # pyright: ignore[reportIncompatibleVariableOverride]

    def waits(self) -> Mapping[str, Wait[Device]]:
        def wait(device: Any) -> None:
            device.wait_for("go", 0.05)

        return {"wait_for('go')": Wait(0.05, lambda _: None, wait)}


class TestTcp(LeaderContract):
    @pytest.fixture
    def factory(self) -> Factory[Device]:
        return partial(tcp_leader, TcpLeaderSettings(port=0))


@on_a_pty
class TestSerial(LeaderContract):
    @pytest.fixture
    def factory(self) -> Generator[Factory[Device]]:
        peer = PtyPeer()
        yield partial(serial_leader, SerialLeaderSettings(port=peer.port))
        peer.leave()


class TestSimulated(LeaderContract):
    @pytest.fixture
    def factory(self) -> Factory[Device]:
        return partial(tcp_leader, TcpLeaderSettings(leader="simulated"))


def test_go_is_answered_by_busy_and_then_by_the_result() -> None:
    with led() as (device, peer):
        assert device.report("ready", {"shot": 0}) == "", "there was no `go`"
        assert peer.ask("go run 17") == "busy", "although no step waits for it"
        assert peer.ask("state?") == "state busy"
        assert device.report("ready", {"shot": 0}) == "", "no step has waited for it"
        assert device.wait_for("go", 20.0) == "run 17"
        assert device.report("ready", {"shot": 12, "success": True, "filling": 0.98666}) == "ready"
        assert peer.hear() == "ready shot=12 success=1 filling=0.9867"
        peer.say("go")
        assert device.wait_for("go", 20.0) == ""
        assert [peer.hear(), peer.ask("go")] == ["busy", "failed reason=busy"]
        assert device.report("failed", {"reason": "camera: no frame\nwithin 1 s", "shot": 13}) == "failed"
        assert peer.hear() == r"failed shot=13 reason=camera: no frame\nwithin 1 s"


def test_it_reports_its_state_at_any_time() -> None:
    with led() as (device, peer):
        assert peer.ask("state?") == "state idle"
        waiting = threading.Thread(target=device.wait_for, args=("go", 20.0))
        waiting.start()
        while peer.ask("state?") != "state waiting":
            pass
        peer.say("go")
        assert peer.hear() == "busy"
        waiting.join()
        assert peer.ask("state?") == "state busy"
        assert (device.read("state"), device.read("is_connected")) == ("busy", True)
        assert peer.ask("hello") == "hello labseq 3 deadline=10"


def test_at_the_deadline_it_answers_by_itself_and_a_late_ready_is_not_sent() -> None:
    now_s = 0.0
    with led() as (device, peer):
        vars(device._link)["now"] = lambda: now_s
        peer.say("go")
        device.wait_for("go", 20.0)
        now_s = 11.0
        assert [peer.hear(), peer.hear()] == ["busy", "failed reason=deadline"]
        assert peer.ask("go") == "failed reason=busy", "the moves may still go on"
        assert device.report("ready", {"shot": 3}) == "late"
        assert peer.ask("state?") == "state idle"
        events = device.new_events()
        assert any("not over at the deadline" in text for text in events)
        assert any("`go` came while labseq was busy" in text for text in events)


def test_a_go_that_no_step_waits_for_is_answered_at_the_deadline() -> None:
    with led(deadline=0.05) as (device, peer):
        assert [peer.ask("go"), peer.hear()] == ["busy", "failed reason=deadline"]
        assert peer.ask("state?") == "state idle"
        assert any("no step waited" in text for text in device.new_events())


def test_a_timeout_says_whether_a_leader_is_connected() -> None:
    silent = r"'go' within 10 ms on 127.0.0.1:\d+, and no leader"
    with listening() as device, pytest.raises(DeviceTimeoutError, match=silent):
        device.wait_for("go", 0.01)
    with led() as (device, _):
        with pytest.raises(DeviceTimeoutError, match="the leader has connected"):
            device.wait_for("go", 0.01)
        with pytest.raises(DeviceError, match="unknown signal 'start'; expected 'go'"):
            device.wait_for("start", 0.01)


def test_a_stop_request_ends_the_wait() -> None:
    stop, ends = StopFlag(), list[BaseException]()

    def wait() -> None:
        try:
            device.wait_for("go", 600.0)
        except StopRequested as error:
            ends.append(error)

    with led(Context("leader", clock=RealClock(stop))) as (device, peer):
        waiting = threading.Thread(target=wait)
        waiting.start()
        while peer.ask("state?") != "state waiting":
            pass
        stop.request()
        waiting.join()
        assert len(ends) == 1
        assert peer.ask("state?") == "state idle"


@contextmanager
def on_a_line() -> Generator[tuple[Any, PtyPeer]]:
    peer = PtyPeer()
    device = serial_leader(SerialLeaderSettings(port=peer.port), Context("leader"))
    device.open()
    try:
        assert peer.hear() == "hello labseq 3 deadline=10"
        yield device, peer
    finally:
        device.close()
        peer.leave()


@on_a_pty
def test_a_serial_line_speaks_the_same() -> None:
    with on_a_line() as (device, peer):
        peer.say("go 5")
        assert device.wait_for("go", 20.0) == "5"
        assert peer.hear() == "busy"
        assert device.report("ready", {"shot": 0, "success": False, "filling": 0.5}) == "ready"
        assert peer.hear() == "ready shot=0 success=0 filling=0.5"
        assert peer.ask("state?") == "state idle"
        assert device.describe()["address"] == peer.port


@on_a_pty
def test_a_serial_port_is_opened_alone() -> None:
    with on_a_line() as (_, peer):
        second = serial_leader(SerialLeaderSettings(port=peer.port), Context("second"))
        with pytest.raises(DeviceError, match=f"cannot open {peer.port}: another program has it open"):
            second.open()


def test_a_port_that_is_taken_is_reported() -> None:
    with listening() as first:
        port = int(first.describe()["address"].rpartition(":")[2])
        second = tcp_leader(TcpLeaderSettings(port=port), Context("leader"))
        with pytest.raises(DeviceError, match=f"cannot listen on 127.0.0.1 port {port}: .*another 'port'"):
            second.open()
        second.close()


def test_only_this_computer_may_connect_unless_others_are_allowed() -> None:
    document = Document.parse("leader: {host: 0.0.0.0}", "p.yaml")
    with pytest.raises(ConfigError) as caught:
        document.validate(TcpLeaderSettings, ("leader",))
    assert str(caught.value).startswith("p.yaml:1:16: host is '0.0.0.0', which other computers can reach")
    assert TcpLeaderSettings(host="0.0.0.0", allow_remote=True).host == "0.0.0.0"
    for host in ("127.0.0.1", "127.1.2.3", "::1", "localhost"):
        assert TcpLeaderSettings(host=host).host == host


def test_a_simulated_leader_loads_and_sends_go_on_the_clock_of_the_session() -> None:
    clock = FakeClock()
    simulation = RecordingSimulation()
    device = tcp_leader(
        TcpLeaderSettings(leader="simulated", simulated_go_delay=0.4, deadline=2.0),
        Context("leader", clock=clock, simulation=simulation),
    )
    device.open()
    assert device.wait_for("go", 10.0) == "1"
    assert clock.now() == 0.4
    assert [str(call) for call in simulation.calls.of("simulation.load")] == ["simulation.load(0.0, 0.4)"]
    assert device.report("ready", {"shot": 0}) == "ready"
    assert device.wait_for("go", 10.0) == "2"
    clock.sleep(3.0)
    assert device.report("ready", {"shot": 1}) == "late"
    with pytest.raises(DeviceTimeoutError, match="the simulated leader sends 'go' after 400 ms"):
        device.wait_for("go", 0.1)


def test_loading_needs_a_simulated_lab() -> None:
    with pytest.raises(ConfigError, match="'loads' is for a simulated lab"):
        tcp_leader(TcpLeaderSettings(loads=True), Context("leader"))


SENT = ["go", "go x=1", '{"go": 1', "set x=1", "gog", "abort", "done"]
EVENTS = st.lists(st.sampled_from([*SENT, "take", "report", "pass", "leave", "ask"]), max_size=40)


@given(EVENTS)
def test_each_go_gets_exactly_one_answer(events: list[str]) -> None:
    dialogue, now_s, n_go_signals, n_lost, said = Dialogue(1.0), 0.0, 0, 0, list[str]()
    dialogue.connected("a leader", Asked(Form.TEXT, each_image=True))
    for event in events:
        now_s += 1.5 if event == "pass" else 0.1
        said += dialogue.overdue(now_s)
        n_answers = sum(line.startswith(("ready", "failed")) for line in said)
        if "go" in event and event != "gog":
            n_go_signals += 1
            said += dialogue.receive_line(event, now_s)
        elif event in ("gog", "abort", "set x=1"):
            said += dialogue.receive_line(event, now_s)
        elif event == "take" and dialogue.take(now_s) is not None:
            dialogue.take_values()
        elif event == "ask":
            said += dialogue.request("your", {"step": "science"}, "done", now_s)
        elif event == "done":
            said += dialogue.receive_line("done", now_s)
            dialogue.end_request(now_s)
        elif event == "report":
            said += dialogue.report("ready", {"shot": 0}, now_s)[1]
            assert not dialogue.is_aborted, "an abort is for one shot"
        elif event == "leave":
            n_lost += n_go_signals - n_lost - n_answers  # a leader that leaves gives up its answer
            dialogue.lost("it left")
            dialogue.connected("another leader", Asked(Form.TEXT))
    said += dialogue.end()
    assert sum(line.startswith(("ready", "failed")) for line in said) == n_go_signals - n_lost


@given(st.lists(st.binary(max_size=12), max_size=8), st.integers(1, 7))
def test_lines_come_out_as_they_went_in_however_they_are_cut(lines: list[bytes], size: int) -> None:
    kept = [line.replace(b"\n", b"") for line in lines]
    data = b"".join(line + b"\n" for line in kept) + b"half"
    splitter = Splitter()
    pieces = [data[i : i + size] for i in range(0, len(data), size)]
    found = [line for piece in pieces for line in splitter.feed(piece)]
    assert found == [line.decode("utf-8", "backslashreplace") for line in kept]
    assert splitter.rest() == "half"
    assert splitter.feed(b"x" * 4001) == []
    assert splitter.feed(b"\nx\n") == [None, "x"], "too long, and the next line is not"
