"""What a leader does wrong: no crash, one answer, a line in the log."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
from contextlib import suppress
from typing import Any

import pytest
from labseq_follow.leader import LeaderDevice, serial_leader
from labseq_follow.relay import Relay, can_relay
from labseq_follow.settings import SerialLeaderSettings
from labseq_follow.tcp import MAX_NEWCOMERS

from labseq.plugin import Context, DeviceError, DeviceTimeoutError, TransientError

from .labseq_follow_rig import MAX_WAIT_S, PtyPeer, TcpPeer, led, listening, token_file

on_a_pty = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no ptys")


def log(device: LeaderDevice) -> str:
    return "\n".join(device.new_events())


@pytest.mark.parametrize(
    ("noise", "answer"),
    [
        (b"Go!\n", "error what is 'Go!'? expected go, set, abort, state? or hello"),
        (b"\xff\x00\x80\n", r"error what is '\xff\x00\x80'? expected go, set, abort, state? or hello"),
        (b"x" * 10_000 + b"\n", "error the line is too long"),
    ],
    ids=["words", "bytes", "very long"],
)
def test_unknown_lines_are_answered_but_no_errors_and_no_empty_lines(noise: bytes, answer: str) -> None:
    with led() as (device, peer):
        peer.send(noise)
        assert peer.hear() == answer
        peer.send(b"error what is 'hello'?\n\r\n\n")
        for piece in (b"g", b"o 1", b"7\r", b"\n"):
            peer.send(piece)
        assert device.wait_for("go", 20.0) == "17"
        assert peer.hear() == "busy"
        assert "the leader sent 'error what is" in log(device)


def test_half_a_line_and_then_nothing_is_no_go() -> None:
    with led() as (device, peer):
        peer.send(b"go 1")
        peer.leave()
        again = reconnect(device)
        assert again.ask("state?") == "state idle"
        again.leave()
        assert "did not end, and was dropped" in log(device)


def refusal(device: LeaderDevice) -> str:
    """The log, once it has the refusal that the peer has already seen."""
    text = ""
    while "was refused" not in text:
        text += log(device)
    return text


def token() -> str:
    return token_file().read_text().strip()


def reconnect(device: LeaderDevice) -> TcpPeer:
    """Connect after the last leader left; until labseq has seen that, it turns others away."""
    while True:
        peer = TcpPeer(device.describe()["address"])
        if peer.hear().startswith("hello"):
            return peer
        peer.leave()


POST = (
    "POST /go HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: http://example.org\r\n"
    "Content-Type: text/plain\r\n\r\ngo\nhello\ngo\n"
)


@pytest.mark.parametrize(
    ("sent", "quoted"),
    [
        (POST, r"its first line is 'POST /go HTTP/1.1\r'"),
        ("go\n", "its first line is 'go'"),
        ("hello\ngo\n", "its first line is 'hello'"),
        (f"hello {'0' * 32}\ngo\n", "its first line is 'hello 0"),
        (f"hello {'0' * 32} version=4\ngo\n", "its first line is 'hello 0"),
        ("x" * 500, "its first line is 'xxx"),
    ],
    ids=["web page", "go", "no token", "wrong token", "wrong version and token", "no end"],
)
def test_without_the_token_nothing_starts(sent: str, quoted: str) -> None:
    with listening() as device:
        stranger = TcpPeer(device.describe()["address"], token="")
        stranger.send(sent.encode())
        assert stranger.hear() == "error the first line must be 'hello' and the token"
        assert stranger.hear() == ""
        stranger.leave()
        peer = reconnect(device)
        assert peer.ask("state?") == "state idle"
        with pytest.raises(DeviceTimeoutError):
            device.wait_for("go", 0.01)
        assert quoted in log(device)
        peer.leave()


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("version=2", "version is 2; this labseq speaks version=3"),
        ("form=json", "version is missing; this labseq speaks version=3"),
        ("version=3 form=xml", "form is xml; expected text or json"),
        (
            "version=3 colour=red",
            "'colour=red' in hello; expected version=3 and form=text, form=json, images=each or shots=all",
        ),
    ],
)
def test_a_hello_that_asks_for_what_is_not_spoken_is_refused_with_the_reason(words: str, reason: str) -> None:
    with listening() as device:
        stranger = TcpPeer(device.describe()["address"], f"{token()} {words}")
        assert [stranger.hear(), stranger.hear()] == [f"error {reason}", ""]
        stranger.leave()
        assert reason in refusal(device)
    with led() as (_, peer):
        assert peer.ask(f"hello {words}") == f"error {reason}"
        assert peer.ask("state?") == "state idle", "in the form that it had"
        assert peer.ask(f"hello {token()} version=3 form=json").startswith(
            '{"answer": "hello", "protocol": 3'
        )
        assert peer.ask("state?") == '{"answer": "state", "state": "idle"}'


def test_a_token_that_goes_on_is_refused() -> None:
    with listening() as device:
        stranger = TcpPeer(device.describe()["address"], f"{token()}x")
        assert stranger.hear() == "error the first line must be 'hello' and the token"
        stranger.leave()


@pytest.mark.skipif(not can_relay(), reason="this system cannot share a socket with a process in this way")
def test_go_is_answered_while_the_run_is_too_busy_to_look() -> None:
    with led() as (device, peer):
        with device._changed:
            assert peer.ask("go 1") == "busy"
            peer.say("go 2")
        assert peer.hear() == "failed reason=busy", "the answer was for one shot"
        assert device.wait_for("go", 20.0) == "1"
        device.report("ready", {"shot": 0})
        assert peer.hear() == "ready shot=0"
        with device._changed:
            assert peer.ask("go 3") == "busy", "also when it follows at once"


def test_where_no_process_can_share_the_socket_the_run_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("labseq_follow.tcp.can_relay", lambda: False)
    with led() as (device, peer):
        assert peer.ask("\x06soon\x06go 0").startswith("error what is"), "as the process would mark it"
        assert [peer.ask("go 1"), peer.ask("go 2")] == ["busy", "failed reason=busy"]
        assert device.wait_for("go", 20.0) == "1"
        peer.leave()
        again = reconnect(device)
        assert again.ask("state?") == "state busy"
        again.leave()


def test_a_relay_that_is_killed_is_a_leader_that_left() -> None:
    with led() as (device, peer):
        relay: Any = device._link._relay  # pyright: ignore[reportAttributeAccessIssue]
        if relay is not None:
            relay._process.kill()
            assert peer.hear() == ""
            again = reconnect(device)
            assert again.ask("go") == "busy"
            again.leave()


def test_200_silent_connections_neither_lead_nor_keep_the_leader_out() -> None:
    with listening() as device:
        strangers = [TcpPeer(device.describe()["address"], token="") for _ in range(200)]
        peer = reconnect(device)
        peer.say("go")
        assert device.wait_for("go", 20.0) == ""
        assert peer.hear() == "busy"
        link: Any = device._link
        assert len(link._newcomers) <= MAX_NEWCOMERS
        for stranger in strangers:
            stranger.leave()
        peer.leave()
        assert len(device.new_events()) < 20


@pytest.mark.skipif(os.name != "posix", reason="modes of files")
def test_the_token_is_made_for_this_user_alone_and_one_that_others_can_read_is_refused() -> None:
    with listening() as device:
        assert device.describe()["token_file"] == str(token_file())
        assert token_file().stat().st_mode & 0o777 == 0o600
    token_file().chmod(0o644)
    hint = re.escape(f"other users can read the token in {token_file()}; run 'chmod 600 {token_file()}'")
    with pytest.raises(DeviceError, match=hint), listening():
        pass
    token_file().chmod(0o600)
    token_file().write_text("short")
    with pytest.raises(DeviceError, match="no token; expected 16 to 100"), listening():
        pass
    token_file().unlink()
    os.mkfifo(token_file())
    with pytest.raises(DeviceError, match="not an ordinary file"), listening():
        pass


def test_a_second_leader_is_turned_away_with_a_line_that_says_so() -> None:
    with led() as (device, peer):
        second = TcpPeer(device.describe()["address"])
        second.send(b"go\n")
        assert second.hear() == "error another leader is connected; one at a time"
        assert second.hear() == ""
        second.leave()
        assert peer.ask("state?") == "state idle"
        assert "was refused" in log(device)


def test_after_a_disconnect_the_shot_goes_on_and_its_result_is_sent_to_no_other() -> None:
    with led() as (device, peer):
        peer.say("go")
        device.wait_for("go", 20.0)
        assert peer.hear() == "busy"
        peer.leave()
        again = reconnect(device)
        assert again.ask("go") == "failed reason=busy"
        assert device.report("ready", {"shot": 0}) == "gone"
        assert again.ask("state?") == "state idle"
        again.say("go")
        device.wait_for("go", 20.0)
        assert again.hear() == "busy"
        again.leave()
        assert "its result will not be sent" in log(device)


def test_a_go_whose_leader_left_before_a_step_waited_is_forgotten() -> None:
    with led() as (device, peer):
        assert [peer.ask("hello")[:5], peer.ask("go"), peer.ask("state?")] == ["hello", "busy", "state busy"]
        peer.leave()
        again = reconnect(device)
        assert again.ask("state?") == "state idle"
        again.leave()


def test_at_its_end_labseq_answers_and_closes_the_connection() -> None:
    with listening() as device:
        peer = TcpPeer(device.describe()["address"])
        assert [peer.hear()[:5], peer.ask("go"), peer.ask("state?")] == ["hello", "busy", "state busy"]
        device.close()
        assert [peer.hear(), peer.hear()] == ["failed reason=labseq ends", ""]
        peer.leave()


def test_one_that_reads_nothing_counts_as_gone() -> None:
    with led() as (device, peer):
        link: Any = device._link
        link._leader.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        with pytest.raises(OSError, match=r"timed out|reset|Broken pipe|closed"):
            link.send(b"x" * 100_000_000)
        with pytest.raises(OSError, match=r"Broken pipe|reset|aborted|no leader"):
            link.send(b"ready\n")  # not sent, after half a line
        peer.leave()
        again = reconnect(device)
        assert again.ask("state?") == "state idle"
        again.leave()


def test_a_fault_of_its_own_is_reported_to_the_step_that_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    with listening() as device:
        monkeypatch.setattr(device._link, "poll", lambda: 1 / 0)
        with pytest.raises(DeviceError, match=r"it no longer listens: ZeroDivisionError"):
            device.wait_for("go", 20.0)


KILLED = """
from labseq.plugin import Context
from labseq_follow.leader import tcp_leader
from labseq_follow.settings import TcpLeaderSettings
device = tcp_leader(TcpLeaderSettings(port=0), Context("leader"))
device.open()
print(device.describe()["address"], flush=True)
device.wait_for("go", 600.0)
device.wait_for("go", 600.0)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
def test_if_labseq_is_killed_the_connection_closes() -> None:
    with subprocess.Popen([sys.executable, "-c", KILLED], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        peer = TcpPeer(process.stdout.readline().strip())
        assert [peer.hear()[:5], peer.ask("go")] == ["hello", "busy"]
        process.send_signal(signal.SIGKILL)
        with suppress(ConnectionError):  # or it was reset
            assert peer.hear() == ""
        peer.leave()


@on_a_pty
def test_a_serial_line_that_breaks_is_reported_and_the_shot_goes_on() -> None:
    peer = PtyPeer()
    device = serial_leader(SerialLeaderSettings(port=peer.port), Context("leader"))
    device.open()
    assert peer.hear()[:5] == "hello"
    peer.say("go")
    device.wait_for("go", 20.0)
    peer.leave()
    while device.read("is_connected"):
        pass
    assert device.report("ready", {"shot": 0}) == "gone"
    assert "unplugged?" in log(device)
    device.safe_state()
    device.close()


def test_another_leader_cannot_reply_for_one_that_left() -> None:
    with led(light="asked") as (device, peer):
        device.light_off(0)
        peer.leave()
        while device.read("is_connected"):
            pass
        other = TcpPeer(device.describe()["address"])
        assert other.hear().startswith("hello")
        assert other.ask("dark") == "error labseq has not asked for 'dark'"
        with pytest.raises(TransientError, match="its imaging light may be on: the leader left"):
            device.check_interlocks()
        assert other.ask("go") == "busy"
        device.wait_for("go", MAX_WAIT_S)
        device.take_values()
        device.check_interlocks()
        other.leave()


def test_a_shot_that_begins_while_a_leader_connects_does_not_disturb_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The thread of the shots tells the process beside the run what to answer; the socket comes first."""
    device: LeaderDevice
    serve = Relay.serve

    def interrupted(self: Relay, leader: socket.socket) -> None:
        other = threading.Thread(target=device._link.expect, args=[b"busy\n"])
        other.start()
        other.join(0.2)  # it ends here only if it does not wait
        serve(self, leader)

    monkeypatch.setattr(Relay, "serve", interrupted)
    with listening() as device:
        peer = TcpPeer(device.describe()["address"])
        assert peer.hear().startswith("hello labseq 3")
        assert peer.ask("go") == "busy"
        peer.leave()
