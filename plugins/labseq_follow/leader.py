"""The device that a leader speaks through."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from labseq.plugin import (
    ConfigError,
    Context,
    Device,
    DeviceError,
    DeviceTimeoutError,
    format_quantity,
    one_of,
    wait_for,
)
from labseq_follow.dialogue import GO, VERSION, About, Dialogue, Splitter, encoded
from labseq_follow.links import Link
from labseq_follow.serial_line import SerialLink
from labseq_follow.settings import SIMULATED, LeaderSettings, SerialLeaderSettings, TcpLeaderSettings
from labseq_follow.tcp import TcpLink

LOADING_S: Final = 0.25
"""How long atoms load in a simulated lab with a real leader (ours): five times the world's own time."""
VALUES: Final = ("state", "is_connected")


def tcp_leader(settings: TcpLeaderSettings, context: Context) -> LeaderDevice:
    """Another control system leads, over TCP: it says `go`, and is told `ready` or `failed`."""
    is_simulated = settings.leader == SIMULATED
    return LeaderDevice(settings, context, None if is_simulated else TcpLink(settings, context.name))


def serial_leader(settings: SerialLeaderSettings, context: Context) -> LeaderDevice:
    """Another control system leads, on a serial line: it says `go`, and is told `ready` or `failed`."""
    is_simulated = settings.leader == SIMULATED
    return LeaderDevice(settings, context, None if is_simulated else SerialLink(settings, context.name))


class LeaderDevice(Device):
    """Lets another control system lead; implements ``labseq.LeaderLink``.

    A thread of its own listens, and keeps the deadline while a shot goes on. It knows no commands; its
    values are ``state`` ("idle", "waiting", "busy") and ``is_connected``.

    Args:
        settings: Deadline, and what a simulated lab does.
        context: Name, clock and the simulated world.
        link: The line to the leader; None for a simulated one that says `go` by itself.

    Raises:
        ConfigError: Atoms shall load, but no lab is simulated.
    """

    def __init__(self, settings: LeaderSettings, context: Context, link: Link | None) -> None:
        if settings.loads and context.simulation is None:
            raise ConfigError("'loads' is for a simulated lab, and this one is real; take it out")
        self._settings = settings
        self._name = context.name or "leader"
        self._clock = context.clock
        self._world = context.simulation
        self._link = link
        self._now: Callable[[], float] = context.clock.now if link is None else time.monotonic
        self._changed = threading.Condition()  # its lock guards everything below
        self._dialogue = Dialogue(settings.deadline)
        self._splitter = Splitter()
        self._n_gos = 0
        self._is_open = False
        self._failure: BaseException | None = None
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def deadline_s(self) -> float:
        """Longest time from `go` to its answer, in seconds."""
        return self._settings.deadline

    def open(self) -> None:
        """Let a leader connect.

        Raises:
            DeviceError: The line cannot be opened.
        """
        if self._is_open:
            return
        self._dialogue = Dialogue(self._settings.deadline)
        self._splitter = Splitter()
        self._failure = None
        if self._link is not None:
            self._link.open()
            self._ending.clear()
            self._thread = threading.Thread(target=self._listen, name=f"labseq {self._name}", daemon=True)
            self._thread.start()
        self._is_open = True

    def close(self) -> None:
        """Answer a leader that waits for an answer, and let it go; legal in any state."""
        if not self._is_open:
            return
        self._is_open = False
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
        with self._changed:
            self._say(self._dialogue.end())
        if self._link is not None:
            self._link.close()

    def safe_state(self) -> None:
        """Nothing to do: it switches nothing, and the leader is told why when all devices are safe."""

    def command(self, name: str, **arguments: Any) -> None:
        """Refuse: it knows no commands.

        Raises:
            DeviceError: Always.
        """
        self.check_command(name, **arguments)

    def check_command(self, name: str, **arguments: Any) -> None:
        """Refuse: it knows no commands.

        Raises:
            DeviceError: Always.
        """
        del arguments
        hint = f"a step `wait: {{for: {GO}, timeout: 10 s}}` waits for the leader"
        raise DeviceError(self._name, f"unknown command '{name}'; it has none: {hint}")

    def read(self, name: str) -> bool | str:
        """Read "state" or "is_connected".

        Raises:
            DeviceError: Not open, or an unknown value.
        """
        self._check_open()
        if name not in VALUES:
            raise DeviceError(self._name, f"unknown value '{name}'; expected {one_of(VALUES)}")
        return self._dialogue.state if name == "state" else self._dialogue.is_connected

    def wait_for(self, signal: str, timeout_s: float) -> str:
        """Wait for `go`, and tell the leader that labseq is busy; see ``labseq.LeaderLink``.

        Raises:
            DeviceError: Not open, or another signal.
            DeviceTimeoutError: It did not come in time.
            StopRequested: The operator asked the run to stop.
        """
        self._check_open()
        if signal != GO:
            raise DeviceError(self._name, f"unknown signal '{signal}'; expected '{GO}'")
        if self._link is None:
            return self._go_by_itself(timeout_s)
        self._dialogue.is_waiting = True
        try:
            text = wait_for(self._take, timeout_s, self._clock)
        finally:
            self._dialogue.is_waiting = False
        if text is None:
            there = "nobody has connected" if not self._dialogue.is_connected else "the leader is connected"
            what = f"no '{GO}' within {format_quantity(timeout_s, 'time')} on {self._link.address}; {there}"
            raise DeviceTimeoutError(self._name, f"{what}; see 'timeout' of the wait", timeout_s)
        if self._settings.loads:
            self._load(LOADING_S)
        return text

    def report(self, state: str, about: About) -> str:
        """Answer a `go`; see ``labseq.LeaderLink``.

        Raises:
            DeviceError: Not open.
        """
        self._check_open()
        with self._changed:
            told, lines = self._dialogue.report(state, about, self._now())
            is_said = self._say(lines)
        return told if is_said or told != state else "gone"

    def new_events(self) -> Sequence[str]:
        """What happened since the last call."""
        with self._changed:
            return self._dialogue.new_events()

    def describe(self) -> Mapping[str, Any]:
        """Address, version of the protocol, deadline."""
        address = SIMULATED if self._link is None else self._link.address
        return {"model": "leader", "address": address, "protocol": VERSION, "deadline_s": self.deadline_s}

    # What the line tells, in the thread that listens.

    def connected(self, who: str) -> None:
        """A leader is there."""
        with self._changed:
            self._splitter = Splitter()
            self._say(self._dialogue.connected(who))

    def came(self, data: bytes) -> None:
        """It said something."""
        with self._changed:
            for line in self._splitter.feed(data):
                if line is None:
                    self._dialogue.note("a line of the leader was too long, and was dropped")
                    self._say(["error the line is too long"])
                else:
                    self._say(self._dialogue.receive_line(line, self._now()))
            self._changed.notify_all()

    def lost(self, reason: str) -> None:
        """It is gone."""
        with self._changed:
            if rest := self._splitter.rest():
                self._dialogue.note(f"the leader's last line, '{rest[:40]!a}', did not end, and was dropped")
            self._dialogue.lost(reason)

    def note(self, text: str) -> None:
        """Something for the log."""
        with self._changed:
            self._dialogue.note(text)

    def _listen(self) -> None:
        assert self._link is not None
        try:
            while not self._ending.is_set():
                self._link.serve(self)
                with self._changed:
                    self._say(self._dialogue.overdue(self._now()))
        except Exception as error:  # noqa: BLE001 - told to whoever waits for a leader next
            self._failure = error

    def _take(self, longest_s: float) -> str | None:
        with self._changed:
            self._check_open()
            if self._failure is not None:
                raise DeviceError(self._name, f"it does not listen any more: {self._failure!r}")
            taken = self._dialogue.take(self._now())
            if taken is None:
                self._changed.wait(longest_s)
                taken = self._dialogue.take(self._now())
            if taken is None:
                return None
            text, lines = taken
            self._say(lines)
            return text

    def _go_by_itself(self, timeout_s: float) -> str:
        """What the simulated leader does: it loads atoms, and says `go`."""
        after_s = self._settings.simulated_go_delay
        if after_s > timeout_s:
            self._clock.sleep(timeout_s)
            what = f"the simulated leader says '{GO}' after {format_quantity(after_s, 'time')}"
            raise DeviceTimeoutError(self._name, f"{what}; see 'simulated_go_delay'", timeout_s)
        self._load(after_s)
        self._n_gos += 1
        self._dialogue.receive_line(f"{GO} {self._n_gos}", self._now())
        text = self._take(0.0)
        assert text is not None
        return text

    def _load(self, duration_s: float) -> None:
        """Load the simulated lab as the leader would have, unless this shot has atoms already."""
        start_s = self._clock.now()
        self._clock.sleep(duration_s)
        world = self._world
        if world is not None and ((truth := world.truth()) is None or not truth.any()):
            world.load(start_s, duration_s)

    def _say(self, lines: Sequence[str]) -> bool:
        """Send lines; whether the leader got them."""
        if self._link is None:
            return True
        try:
            for line in lines:
                self._link.send(encoded(line))
        except OSError as error:
            self._dialogue.note(f"the leader could not be told '{lines[0]}': {error}")
            return False
        return True

    def _check_open(self) -> None:
        if not self._is_open:
            raise DeviceError(self._name, "not open; call open() first")
