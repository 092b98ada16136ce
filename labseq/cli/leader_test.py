"""`labseq leader-test`: leads a run like a control system, both correctly and with errors."""

from __future__ import annotations

import math
import socket
import textwrap
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar

import labseq_client
from labseq_client import VERSION, Leader

from labseq.console.report import Column, aligned, reporting, table
from labseq.console.text import plural, time_text
from labseq.errors import ConfigError, DeviceError

N_QUESTIONS: Final = 200
"""Number of requests for the state, to time the connection without a shot."""
N_CHECKED: Final = 2
"""Number of shots that are led with errors."""
MIN_SHOTS: Final = N_CHECKED + 1
MAX_WAIT_S: Final = 5.0
"""Longest time for an answer that does not need a shot."""
NO_TOKEN: Final = "error the first line must be"  # noqa: S105 - an answer
Connection = TypeVar("Connection")


@dataclass(frozen=True, slots=True)
class Contact:
    """Address and token of a run that waits for a leader.

    Attributes:
        token: Content of the run's file `leader.token`.
    """

    host: str
    port: int
    token: str

    @property
    def hello(self) -> bytes:
        """The first line that a control system sends."""
        return f"hello {self.token} version={VERSION}\n".encode()

    def leader(self) -> Leader:
        """Lead with the client, like a control system."""
        return _once_free(lambda: Leader(self.host, self.port, self.token))

    def peer(self, *begin: bytes, pause_s: float = 0.0) -> Peer:
        """Connect without the client, and send something in parts."""
        peer = Peer(socket.create_connection((self.host, self.port), MAX_WAIT_S))
        for part in begin:
            peer.send(part)
            time.sleep(pause_s)
        return peer

    def leading_peer(self) -> Peer:
        """Lead without the client."""

        def lead() -> Peer:
            peer = self.peer(self.hello)
            answer = peer.hear()
            if not answer.startswith("hello"):
                peer.close()
                raise labseq_client.LabseqError(answer.removeprefix("error "))
            return peer

        return _once_free(lead)


def _once_free(lead: Callable[[], Connection]) -> Connection:
    """Lead as soon as the run has noticed that the last connection of this command was closed."""
    end_s = time.monotonic() + MAX_WAIT_S
    while True:
        try:
            return lead()
        except labseq_client.LabseqError as error:
            if "another leader" not in str(error) or time.monotonic() > end_s:
                raise
            time.sleep(0.02)


class Peer:
    """A connection that may send anything. Closes at the end of a `with` block."""

    def __init__(self, link: socket.socket) -> None:
        self._link = link
        self._lines = link.makefile("rb")

    def send(self, data: bytes) -> None:
        """Send bytes."""
        self._link.sendall(data)

    def hear(self, more_s: float = 0.0) -> str:
        """The next line, "closed" if the connection was closed, or "no answer" if none came in time."""
        self._link.settimeout(MAX_WAIT_S + more_s)
        try:
            line = self._lines.readline()
        except ConnectionError:
            line = b""
        except OSError:  # a timeout, in this call or an earlier one
            return "no answer"
        return line.decode("ascii", "backslashreplace").strip() if line else "closed"

    def ask(self, line: bytes) -> str:
        """Send a line, and hear the answer."""
        self.send(line + b"\n")
        return self.hear()

    def await_waiting(self, more_s: float) -> str:
        """Wait until the run waits for `go` or no shot can be in progress, and return its state."""
        end_s = time.monotonic() + MAX_WAIT_S + more_s
        while (state := self.ask(b"state?")) in ("state busy", "state idle") and time.monotonic() < end_s:
            time.sleep(0.02)
        return state

    def close(self) -> None:
        """Close the connection."""
        self._lines.close()
        self._link.close()

    def __enter__(self) -> Peer:
        """The connection itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close it."""
        self.close()


@dataclass(frozen=True, slots=True)
class Check:
    """A test case that the run must refuse or survive, with the run's answers.

    Attributes:
        expected: How its answers must begin.
        came: The actual answers.
    """

    name: str
    ok: bool
    expected: Sequence[str]
    came: Sequence[str]

    @classmethod
    def of(cls, name: str, expected: Sequence[str], came: Sequence[str]) -> Check:
        """Compare answers with the expected beginnings."""
        pairs = zip(came, expected, strict=True)
        return cls(name, all(answer.startswith(begin) for answer, begin in pairs), expected, came)


CHECKS: Final[Sequence[Column[Check]]] = (
    Column("check", lambda check: check.name),
    Column("", lambda check: "ok" if check.ok else "FAILED"),
    Column("answers", lambda check: ", ".join(textwrap.shorten(answer, 60) for answer in check.came)),
)


@dataclass(frozen=True, slots=True)
class LeaderReport:
    """The answers of a run to its leading control system, with times in seconds.

    Attributes:
        deadline_s: Longest time from `go` to the end of a shot.
        state_s: Time from each `state?` to its answer.
        busy_s: Time from each `go` to `busy`.
        end_s: Time from each `go` to `ready` or `failed`.
        failed: Reasons of the shots that failed.
    """

    address: str
    deadline_s: float
    checks: Sequence[Check]
    state_s: Sequence[float]
    busy_s: Sequence[float]
    end_s: Sequence[float]
    failed: Sequence[str]
    ok: bool

    def as_text(self) -> list[str]:
        """The checks, and a histogram of each kind of answer."""
        lines = table(self.checks, CHECKS)
        for name, times in (("state?", self.state_s), ("go to busy", self.busy_s), ("go to end", self.end_s)):
            if times:
                lines += ["", *histogram(name, times)]
        lines += [f"a shot failed: {reason}" for reason in self.failed]
        if not self.end_s:
            lines += ["", "no shot was taken; give --shots N to take N shots and time their answers"]
        return lines


def histogram(name: str, times_s: Sequence[float], n_bins: int = 8) -> list[str]:
    """Draw a histogram of response times, with bins that grow by a constant factor.

    Example:
        >>> for line in histogram("state?", [0.001, 0.001, 0.002], n_bins=2):
        ...     print(line)
        state?: 3 answers, median 1 ms, 99 % within 2 ms
          1.41 ms  ##############################  2
             2 ms  ###############                 1
    """
    ordered = sorted(times_s)
    first, last = ordered[0], ordered[-1]
    steps = math.log(last / first) / n_bins or 1.0
    counts = [0] * n_bins
    for taken_s in ordered:
        counts[min(n_bins - 1, int(math.log(taken_s / first) / steps))] += 1
    bars = [
        (f"  {_short(first * math.exp(steps * (k + 1)))}", "#" * math.ceil(30 * n / max(counts)), str(n))
        for k, n in enumerate(counts)
    ]
    quantiles = f"median {_short(_quantile(ordered, 0.5))}, 99 % within {_short(_quantile(ordered, 0.99))}"
    return [f"{name}: {plural(len(ordered), 'answer')}, {quantiles}", *aligned(bars, right=[0, 2])]


def _short(duration_s: float) -> str:
    return time_text(float(f"{duration_s:.3g}"))


def _quantile(ordered: Sequence[float], share: float) -> float:
    return ordered[math.ceil(share * len(ordered)) - 1]


def play_leader(host: str, port: int, token_file: Path | None, shots: int, *, as_json: bool) -> int:
    """Lead a run like a control system, and print a report.

    Args:
        shots: Number of shots to take, also 0.

    Returns:
        The exit code: 0 if the run answered as it must and no shot failed, else 3.

    Raises:
        ConfigError: The token cannot be read.
        DeviceError: No run listens there, it does not answer, or another control system leads it.
    """
    with reporting(as_json=as_json) as show:
        contact = Contact(host, port, _token(token_file))
        try:
            result = _play(contact, shots)
        except (OSError, labseq_client.LabseqError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            hint = "run a sequence with a step 'wait: {for: go}' there, and disconnect its control system"
            raise DeviceError(f"{host}:{port}", f"{reason}; {hint}") from error
        show(result)
    return 0 if result.ok else DeviceError.exit_code


def _token(file: Path | None) -> str:
    try:
        return labseq_client.own_token() if file is None else file.read_text("ascii").strip()
    except (OSError, UnicodeError) as error:
        text = f"the leader's token cannot be read: {error}"
        raise ConfigError(
            f"{text}; copy leader.token from labseq's computer, and give its path with --token"
        ) from error


def _play(contact: Contact, shots: int) -> LeaderReport:
    with contact.leader() as leader:  # before anything else, because another control system may lead
        deadline_s = leader.deadline_s
        state_s = [_timed(leader.state) for _ in range(N_QUESTIONS)]
    checks = [*_newcomers(contact), *_as_leader(contact, deadline_s)]
    busy_s, end_s, failed = list[float](), list[float](), list[str]()
    if shots:
        checks += _in_shots(contact, deadline_s)
        with contact.leader() as leader:
            for _ in range(shots - N_CHECKED):
                begin_s = time.perf_counter()
                busy_s.append(_timed(leader.go))
                answer = leader.wait()
                end_s.append(time.perf_counter() - begin_s)
                failed += [] if answer.is_ready else [answer.reason]
    ok = all(check.ok for check in checks) and not failed
    address = f"{contact.host}:{contact.port}"
    return LeaderReport(address, deadline_s, checks, state_s, busy_s, end_s, failed, ok)


def _timed(call: Callable[[], object]) -> float:
    begin_s = time.perf_counter()
    call()
    return time.perf_counter() - begin_s


def _newcomers(contact: Contact) -> list[Check]:
    """Check connections that must be refused because of their first bytes."""
    firsts = (
        ("a wrong token", b"hello " + b"0" * len(contact.token) + b"\n", [NO_TOKEN, "closed"]),
        ("garbage instead of a token", bytes(range(128, 256)) + b"\n", [NO_TOKEN, "closed"]),
        ("the request of a web page", b"POST / HTTP/1.1\r\nHost: labseq\r\n\r\n", [NO_TOKEN, "closed"]),
        ("a first line without end", b"x" * 300, [NO_TOKEN, "closed"]),
        ("another version", f"hello {contact.token} version=999\n".encode(), ["error version is", "closed"]),
        ("a connection that sends nothing", b"", ["closed"]),
    )
    checks: list[Check] = []
    for name, begin, expected in firsts:
        with contact.peer(begin) as peer:
            checks.append(Check.of(name, expected, [peer.hear() for _ in expected]))
    return checks


def _as_leader(contact: Contact, deadline_s: float) -> list[Check]:
    """Check errors that the run must refuse or survive while it is led. None of them begins a shot."""
    with contact.peer(contact.hello[:8], contact.hello[8:20], contact.hello[20:], pause_s=0.2) as slow:
        checks = [Check.of("a slow connection", ["hello"], [slow.hear()])]
        with contact.peer(contact.hello) as second:
            came = [second.hear(), second.hear()]
        checks.append(Check.of("two leaders", ["error another leader", "closed"], came))
        slow.await_waiting(deadline_s)
        for name, line in (
            ("rubbish", b"\xff\x00 rubbish"),
            ("a line that is too long", b"go " + b"x" * 9000),
        ):
            came = [slow.ask(line), slow.ask(b"state?")]
            checks.append(Check.of(name, ["error", "state waiting"], came))
    return checks


def _in_shots(contact: Contact, deadline_s: float) -> list[Check]:
    """Check two shots that are led with errors."""
    with contact.leading_peer() as leader:
        came = [leader.ask(b"go leader-test"), leader.ask(b"go too early"), leader.hear(deadline_s)]
        end = "failed shot" if came[-1].startswith("failed shot") else "ready"
        early = Check.of("go before the end of a shot", ["busy", "failed reason=busy", end], came)
        leader.await_waiting(deadline_s)
        left = leader.ask(b"go leader-test")
    with contact.leading_peer() as leader:
        came = [left, leader.await_waiting(deadline_s)]
    return [early, Check.of("a leader that leaves during a shot", ["busy", "state waiting"], came)]
