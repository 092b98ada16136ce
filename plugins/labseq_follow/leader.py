"""The device for an external control system that starts the shots while labseq follows."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from labseq.plugin import (
    ConfigError,
    Context,
    Device,
    DeviceError,
    DeviceTimeoutError,
    LabseqError,
    ShotAbortedError,
    TransientError,
    format_quantity,
    wait_for,
)
from labseq.plugin.leader import GO, check_signal, load_atoms
from labseq.plugin.messages import one_of
from labseq_follow.answers import VERSION
from labseq_follow.links import Event, Link, SerialLink, SimulatedLink
from labseq_follow.protocol import UNANSWERED, About, Dialogue, Splitter, encoded
from labseq_follow.settings import SIMULATED, LinkSettings, SerialLeaderSettings, TcpLeaderSettings
from labseq_follow.tcp import TcpLink

LOADING_S: Final = 0.25
"""Loading time in a simulated lab with a real control system, five times the simulation's own time."""
VALUES: Final = ("state", "is_connected")


def tcp_leader(settings: TcpLeaderSettings, context: Context) -> LeaderDevice:
    """The device for an external control system that connects over TCP."""
    return LeaderDevice(settings, context, TcpLink(settings, context.name))


def serial_leader(settings: SerialLeaderSettings, context: Context) -> LeaderDevice:
    """The device for an external control system on a serial line."""
    return LeaderDevice(settings, context, SerialLink(settings, context.name))


class LeaderDevice(Device):
    """Receives the start signal `go`, and answers with the result.

    Implements ``labseq.plugin.LeaderDialogue``. A thread receives, and keeps the deadline of a shot.
    The device has no commands. Its values are ``state`` ("idle", "waiting", "busy") and ``is_connected``.

    Args:
        settings: Deadline, and options for a simulated lab.
        context: Name, clock and simulation.
        link: The connection to a real control system.

    Raises:
        ConfigError: The settings load atoms, but no lab is simulated.
    """

    any_thread = True  # an abort is checked between a frame and its moves, where another thread costs 0.1 ms

    def __init__(self, settings: LinkSettings, context: Context, link: Link) -> None:
        if settings.loads and context.simulation is None:
            raise ConfigError("'loads' is for a simulated lab, but this lab is real; remove it")
        self._settings = settings
        self._context = context
        self._name = context.name or "leader"
        self._link = SimulatedLink(settings, context) if settings.leader == SIMULATED else link
        self._changed = threading.Condition()  # its lock guards everything below
        self._is_open = False
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self._begin()

    def _begin(self) -> None:
        """Forget everything of the last connection."""
        self._dialogue = Dialogue(self._settings.deadline, self._context.grid.shape)
        self._splitter = Splitter()
        self._failure: BaseException | None = None
        self._check: Callable[[Mapping[str, str]], object] | None = None
        self._is_in_shot = False

    @property
    def asks_for_light(self) -> bool:
        """Whether labseq asks the control system to switch the imaging light."""
        return self._settings.light == "asked"

    @property
    def deadline_s(self) -> float:
        """Longest time from `go` to its answer, in seconds."""
        return self._settings.deadline

    def open(self) -> None:
        """Let the control system connect.

        Raises:
            DeviceError: The connection cannot be opened.
        """
        if self._is_open:
            return
        self._begin()
        self._link.open()
        self._ending.clear()
        if self._link.listens:
            self._thread = threading.Thread(target=self._listen, name=f"labseq {self._name}", daemon=True)
            self._thread.start()
        self._is_open = True

    def close(self) -> None:
        """Answer a pending `go`, and disconnect. Legal in any state."""
        if not self._is_open:
            return
        self._is_open = False
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
        self._handle(("came", self._link.finish()))
        with self._changed:
            self._send(self._dialogue.end())
        self._link.close()

    def safe_state(self) -> None:
        """Do nothing, because it switches nothing, and the answer is sent when all devices are safe."""

    def check_command(self, name: str, **arguments: Any) -> None:
        """Refuse every command, because it has none.

        Raises:
            DeviceError: Always.
        """
        del arguments
        hint = f"a step `wait: {{for: {GO}, timeout: 10 s}}` waits for the start signal"
        raise DeviceError(self._name, f"unknown command '{name}'; the device has none, but {hint}")

    command = check_command

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
        """Wait for `go`, which the receiving thread has answered, see ``labseq.plugin.LeaderLink``.

        Raises:
            DeviceError: Not open, or another signal.
            DeviceTimeoutError: `go` did not come in time.
            StopRequested: The operator asked the run to stop.
        """
        self._check_open()
        check_signal(signal, self._name)
        self._dialogue.is_waiting = True
        try:
            if simulated := self._link.arrange_go(timeout_s):
                self._handle(("came", simulated))
            text = wait_for(self._take, timeout_s, self._context.clock)
        finally:
            self._dialogue.is_waiting = False
        if text is None:
            what = f"no '{GO}' within {format_quantity(timeout_s, 'time')} on {self._link.address}"
            connected = "the" if self._dialogue.is_connected else "no"
            text = f"{what}, and {connected} leader has connected; see 'timeout' of the wait"
            raise DeviceTimeoutError(self._name, text, timeout_s)
        if self._settings.loads and not simulated:
            load_atoms(self._context, LOADING_S)
        return text

    def check_interlocks(self) -> None:
        """End the shot if the control system has aborted it.

        Raises:
            ShotAbortedError: The control system has aborted the shot.
        """
        if self._dialogue.is_aborted:
            raise ShotAbortedError("the leader aborted the shot", self._name)
        self._await_dark()

    def expect_values(self, check: Callable[[Mapping[str, str]], object]) -> None:
        """Check the values of `set` with this function, see ``labseq.plugin.LeaderDialogue``."""
        self._check = check

    def take_values(self) -> Mapping[str, str]:
        """The values that were sent for the shot that begins, see ``labseq.plugin.LeaderDialogue``."""
        with self._changed:
            self._is_in_shot = True
            return self._dialogue.take_values()

    def take_turn(self, step: str, timeout_s: float, shot: int) -> str:
        """Let the control system do a step of its own, see ``labseq.plugin.LeaderDialogue``.

        Raises:
            TransientError: No control system is connected, or it left, aborted the shot, or was too slow.
        """
        self._request("your", {"step": step, "shot": shot, "timeout_s": timeout_s}, "done", timeout_s)
        try:
            self._await_reply(f"its step '{step}' is not done", timeout_s)
        finally:
            with self._changed:
                self._dialogue.end_request(self._link.now())
        return self._dialogue.reply

    def light_on(self, exposure_s: float, shot: int) -> None:
        """Ask the control system to turn the imaging light on, see ``labseq.plugin.LeaderDialogue``.

        Raises:
            TransientError: As in :meth:`take_turn`.
        """
        limit_s = self._settings.light_timeout
        self._request("light", {"exposure_s": exposure_s, "shot": shot}, "lit", limit_s)
        self._await_reply("its imaging light is not on", limit_s)

    def light_off(self, shot: int) -> None:
        """Ask it to turn the light off. ``check_interlocks`` waits until the light is off.

        Raises:
            TransientError: No control system is connected.
        """
        if self._dialogue.awaited != UNANSWERED:  # otherwise it left before the light was on
            self._request("dark", {"shot": shot}, "dark", self._settings.light_timeout)

    def report_image(self, about: About) -> None:
        """Send an image, if the control system wants each image."""
        with self._changed:
            if lines := self._dialogue.image(about):
                self._send(lines)

    def report(self, state: str, about: About) -> str:
        """Answer a `go`, see ``labseq.plugin.LeaderLink``.

        Raises:
            DeviceError: Not open.
        """
        self._check_open()
        with self._changed:
            self._is_in_shot = False
            answered, lines = self._dialogue.report(state, about, self._link.now())
            is_sent = self._send(lines)
        return answered if is_sent or answered != state else "gone"

    def new_events(self) -> Sequence[str]:
        """Messages since the last call."""
        with self._changed:
            return self._dialogue.log.new_events()

    def describe(self) -> Mapping[str, Any]:
        """Address, version of the protocol, deadline, and the file with the token."""
        address, deadline_s = self._link.address, self.deadline_s
        about = {"model": "leader", "address": address, "protocol": VERSION, "deadline_s": deadline_s}
        return about | ({"token_file": str(file)} if (file := self._link.token_file) else {})

    def _listen(self) -> None:
        try:
            while not self._ending.is_set():
                for event in self._link.poll():
                    self._handle(event)
                self._check_set()
                with self._changed:
                    self._send(self._dialogue.overdue(self._link.now()))
        except Exception as error:  # noqa: BLE001 - reported to the next step that waits
            self._failure = error

    def _handle(self, event: Event) -> None:
        with self._changed:
            match event:
                case "connected", who, asked:
                    self._splitter = Splitter()
                    self._send(self._dialogue.connected(who, asked))
                case "came", data:
                    self._receive(data)
                case "lost", reason:
                    if rest := self._splitter.rest():
                        text = f"the leader's last line, '{rest[:40]!a}', did not end, and was dropped"
                        self._dialogue.log.note(text)
                    self._dialogue.lost(reason)
                    self._changed.notify_all()
                case "note", text:
                    self._dialogue.log.note(text)

    def _receive(self, data: bytes) -> None:
        for line in self._splitter.feed(data):
            if line is None:
                self._dialogue.log.note("a line of the leader was too long, and was dropped")
                self._send([self._dialogue.error("the line is too long")])
            else:
                self._send(self._dialogue.receive_line(line, self._link.now()))
        self._changed.notify_all()

    def _check_set(self) -> None:
        """Check the values of a `set`, but not during a shot, which this would delay by milliseconds."""
        values = self._dialogue.unchecked
        if values is None or self._check is None or self._is_in_shot:
            return
        reason = ""
        try:
            self._check(values)
        except LabseqError as error:
            reason = str(error)
        with self._changed:
            if self._dialogue.unchecked is values:  # otherwise a shot has begun with them in the meantime
                self._send(self._dialogue.check_set(reason))

    def _request(self, word: str, facts: About, reply: str, longest_s: float) -> None:
        """Send the control system a request that requires a reply."""
        self._check_open()
        if reply != "dark":
            self._await_dark()
        with self._changed:
            if self._link.listens and not self._dialogue.can_be_asked:
                raise self._unanswered(f"the leader of this shot is not connected and cannot answer '{word}'")
            self._send(self._dialogue.request(word, facts, reply, self._link.now()))
        if simulated := self._link.arrange_reply(reply, longest_s):
            self._handle(("came", simulated))

    def _await_dark(self) -> None:
        """Wait until the imaging light is off, if labseq has asked for that."""
        if self._dialogue.awaited in ("dark", UNANSWERED):
            self._await_reply("its imaging light may be on", self._settings.light_timeout)

    def _await_reply(self, otherwise: str, timeout_s: float) -> None:
        """Wait for the requested reply."""
        why_not = wait_for(self._replied, timeout_s, self._context.clock)
        if why_not is None:
            why_not = f"the leader has not answered within {format_quantity(timeout_s, 'time')}"
        if why_not:
            raise self._unanswered(f"{otherwise}: {why_not}")

    def _unanswered(self, text: str) -> TransientError:
        """The error for a leader that does not do its part. The machine is fine, so the run continues.

        A shot that a leader began is repeated at its next `go`. Any other shot follows its policy.
        """
        kind = ShotAbortedError if self._dialogue.state == "busy" else TransientError
        return kind(text, self._name)

    def _replied(self, longest_s: float) -> str | None:
        """Why the reply will not come, "" if it has come, or None if it may still come."""
        with self._changed:
            if not self._dialogue.awaited:
                return ""
            if self._dialogue.is_aborted:
                raise ShotAbortedError("the leader aborted the shot", self._name)
            if self._dialogue.awaited == UNANSWERED:
                return "the leader left before it answered"
            self._changed.wait(longest_s)
            return None

    def _take(self, longest_s: float) -> str | None:
        with self._changed:
            self._check_open()
            if self._failure is not None:
                raise DeviceError(self._name, f"it no longer listens: {self._failure!r}")
            text = self._dialogue.take(self._link.now())
            if text is None:
                self._changed.wait(longest_s)  # the caller looks again at once
            return text

    def _send(self, lines: Sequence[str]) -> bool:
        """Send lines. Returns whether the control system received them.

        The answer to the next `go` is set first, because the control system may send `go` at once.
        """
        self._link.expect(encoded(answer) if (answer := self._dialogue.next_answer) else b"")
        try:
            for line in lines:
                self._link.send(encoded(line))
        except OSError as error:
            self._dialogue.log.note(f"'{lines[0][:80]}' could not be sent to the leader: {error}")
            return False
        return True

    def _check_open(self) -> None:
        if not self._is_open:
            raise DeviceError(self._name, "not open; call open() first")
