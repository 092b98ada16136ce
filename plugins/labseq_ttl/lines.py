"""The driver of the timing box."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, Final, NamedTuple, NoReturn

from labseq.plugin import (
    ConfigError,
    Context,
    DeviceError,
    DeviceTimeoutError,
    Emergency,
    LineProgram,
    Lines,
    LinesFacts,
    format_quantity,
)
from labseq.plugin.lines import idle_program, off_program
from labseq.plugin.messages import one_of
from labseq_ttl.access import choose_box
from labseq_ttl.box import Box, Identity, cause_text, late_error
from labseq_ttl.programs import MAX_EDGES, Slots, edges_of, mask_of
from labseq_ttl.protocol import (
    CHANNELS,
    EDGES,
    LONGEST,
    OUTPUTS,
    SHORTEST,
    SHORTEST_S,
    TICK_S,
    VERSION,
    Edge,
)
from labseq_ttl.settings import TtlSettings

LATENCY_S: Final = 0.4e-3
"""Delay from the end of ``fire`` on the line to the first edge, without the computer's own delays."""

BEATS_PER_TIMEOUT: Final = 4
"""How often the box receives something within its watchdog timeout."""
TEST_TICKS: Final = 200_000
TEST_WAIT_S: Final = 15.0
TOO_FAST: Final = 0.95
"""A self test that takes less than this part of its time fails. More is the computer's delay."""


class Compiled(NamedTuple):
    """The program that was compiled last."""

    program: LineProgram
    slot: int
    """Where the box holds it."""
    n_edges: int


class TtlLines(Lines):
    """A timing box with labseq's firmware.

    Calls raise ``DeviceError`` if the box is not open, does not answer, was reset, or plays a program.

    Attributes:
        access: The driver's access to the box.
    """

    def __init__(self, settings: TtlSettings, context: Context) -> None:
        self._settings = settings
        self._name = context.name or "lines"
        self._clock = context.clock
        self._specs = context.lines
        self._names = tuple(spec.name for spec in self._specs)
        self._polarity = mask_of([spec.active_low for spec in self._specs], self._specs)
        self._polarity |= 0 if settings.go is None else settings.go.polarity
        self.access = choose_box(settings, context)
        self._box: Box | None = None
        self._identity = Identity(0, 0, "")
        self._heartbeat: Heartbeat | None = None
        self._slots = Slots()
        self._n_boots = self._n_runs = 0
        self._was_lost = False
        self._forget()

    @property
    def lines_facts(self) -> LinesFacts:
        """Channels and limits."""
        return LinesFacts(CHANNELS, TICK_S, SHORTEST_S, MAX_EDGES, LATENCY_S)

    def open(self) -> None:
        """Connect to the box, which turns all lines off. No effect if it is open.

        Raises:
            ConfigError: A line is on a channel that the box does not have.
            DeviceError: It does not answer, or is not the box in the profile.
        """
        if self._box is not None:
            return
        for spec in self._specs:
            if spec.channel not in CHANNELS:
                text = f"{self._name}: the box has no channel {spec.channel} for '{spec.name}'"
                raise ConfigError(f"{text}; expected {one_of(tuple(map(str, CHANNELS)))}")
        self._connect()
        self.access.lines_set(off_program(self._specs))

    def idle(self) -> None:
        """Turn on the lines that are on between steps."""
        idle = idle_program(self._specs)
        self._opened().set_lines(mask_of(idle.on[-1].tolist(), self._specs))
        self.access.lines_set(idle)

    def close(self) -> None:
        """Turn all lines off and disconnect. Legal in any state."""
        try:
            self.safe_state()
        finally:
            self._disconnect()

    def safe_state(self) -> None:
        """Turn all lines off, whatever the box is doing. If that fails, try again on a new connection.

        Raises:
            DeviceError: The box does not confirm it.
        """
        self._forget()
        if self._box is None:
            return
        try:
            self._box.stop()
            self._box.drop_messages()
        except DeviceError:
            self._was_lost = True
        if self._was_lost:
            self._disconnect()
            self._connect()  # which turns all lines off
        self.access.lines_set(off_program(self._specs))

    def emergency(self) -> Emergency | None:
        """The byte that turns all lines off, as the reset of a box at the opening of its port does too."""
        return None if self._box is None else self._box.emergency()

    def check_program(self, program: LineProgram) -> None:
        """Refuse a program that the box cannot play.

        Raises:
            LimitError: More edges, or closer together, than the box can make.
        """
        edges_of(program, self._specs, self._name)

    def compile(self, program: LineProgram) -> None:
        """Take a program for the next firing. A program that the box stores already is not sent again.

        Raises:
            LimitError: More edges, or closer together, than the box can make.
            DeviceError: Not open, a program runs, or lines that the profile does not have.
        """
        box = self._opened()
        if program.lines != self._names:
            text = f"a program has the lines {program.lines}; expected {self._names}"
            raise DeviceError(self._name, text)
        edges = edges_of(program, self._specs, self._name)
        self._refuse_while_running("compiled")
        slot = self._slots.find(edges)
        if slot is None:
            slot = self._slots.free()
            box.put(slot, edges)
            self._slots.fill(slot, edges)
        self._compiled, self._is_armed = Compiled(program, slot, len(edges)), False

    def arm(self) -> None:
        """Prepare the program that was compiled last."""
        box = self._opened()
        self._refuse_while_running("armed")
        if self._compiled is None:
            raise DeviceError(self._name, "armed, but nothing was compiled; call compile() first")
        boots = box.arm(self._compiled.slot, self._compiled.n_edges)
        if boots != self._n_boots:
            self._was_reset(boots)
        self._is_armed = True

    def fire(self) -> None:
        """Start the program, or let the start input start it, and return at once."""
        box = self._opened()
        if not self._is_armed or self._compiled is None:
            raise DeviceError(self._name, "fired, but not armed; call arm() before each fire()")
        self._refuse_while_running("fired")
        program = self._compiled.program
        self._is_armed, self._is_running = False, True
        box.fire(external=self._settings.start == "external")
        self._end_s = self._clock.now() + program.duration_s
        self.access.fired(program)

    def wait(self, timeout_s: float) -> None:
        """Wait for the end of the program.

        Raises:
            DeviceTimeoutError: It did not end within ``timeout_s``.
        """
        box = self._opened()
        max_wait_s = self.access.wait_until(self._end_s, timeout_s)
        if self._is_running:
            self._wait_for_box(box, max_wait_s)

    def self_test(self) -> None:
        """Write a program, read it back, and play a program that changes no line."""
        box, slot = self._opened(), self._slots.free()
        self._refuse_while_running("tested")
        self._compiled, self._is_armed = None, False
        written = bit_pattern()
        box.put(slot, written)
        for i, edge in enumerate(written):
            if (read := box.get(slot, i)) != edge:
                raise DeviceError(self._name, f"edge {i} in slot {slot} reads {read}, not {edge}")
        on = box.state().on
        box.put(slot, ((0, on), (TEST_TICKS, on)))
        box.arm(slot, 2)
        started_s, expected_s = time.monotonic(), TEST_TICKS * TICK_S
        box.fire()
        self.access.fired(None)
        event = box.new_events(TEST_WAIT_S)
        took_s = time.monotonic() - started_s
        if event is None or event[0] != "done":
            sent = "nothing" if event is None else " ".join(event)
            raise DeviceError(self._name, f"at the end of a program the box sends '{sent}', not 'done'")
        if self.access.real_time and took_s < TOO_FAST * expected_s:
            text = (
                f"the box played {format_quantity(expected_s, 'time')} in {format_quantity(took_s, 'time')}"
            )
            raise DeviceError(self._name, f"{text}; does its processor run at 16 MHz?")
        self._n_runs = box.state().runs

    def describe(self) -> Mapping[str, Any]:
        """Firmware, serial number, starts, lines, settings."""
        facts: dict[str, Any] = {"model": "labseq timing box", **self._settings.model_dump(mode="json")}
        if self._box is not None:
            facts |= {"firmware": f"protocol {VERSION}", "serial_number": self._identity.serial_number}
            facts |= {"n_boots": self._n_boots, "started_by": self._identity.cause}
        return {**facts, "lines": {spec.name: spec.channel for spec in self._specs}}

    def _connect(self) -> None:
        """Open the port, check the box, turn all lines off, and set what stays the same."""
        self._forget()
        self._slots.clear()
        try:
            self._box = box = Box(self.access.connect(), self._name, self._clock, self.access.max_wait_s)
            self._identity = box.identify()
            self._check_serial_number(self._identity.serial_number)
            box.drop_messages()
            box.ask("off")
            state = box.state()
            if state.polarity != self._polarity:
                box.set_polarity(self._polarity)
            self._start_watchdog(box)
        except BaseException:
            self._disconnect()
            raise
        self._n_boots, self._n_runs, self._was_lost = self._identity.boots, state.runs, False

    def _check_serial_number(self, found: int) -> None:
        expected = self._settings.serial_number
        if self.access.real_time and expected is not None and expected != found:
            text = f"the box at {self._settings.port} has the serial number {found}, not {expected}"
            raise DeviceError(self._name, f"{text}; is this the right port?")

    def _start_watchdog(self, box: Box) -> None:
        timeout_s = self._settings.watchdog_timeout if self.access.real_time else 0.0
        box.set_watchdog_timeout(timeout_s)
        if timeout_s:
            # the box ignores empty lines
            self._heartbeat = Heartbeat(lambda: box.send(b"\n"), timeout_s)
            self._heartbeat.start()

    def _disconnect(self) -> None:
        heartbeat, self._heartbeat = self._heartbeat, None
        if heartbeat is not None:
            heartbeat.stop()
        box, self._box = self._box, None
        if box is not None:
            box.close()
        self.access.disconnect()

    def _forget(self) -> None:
        self._compiled: Compiled | None = None
        self._is_armed = self._is_running = False
        self._end_s = -math.inf

    def _opened(self) -> Box:
        if self._box is None:
            raise DeviceError(self._name, "not open; call open() first")
        return self._box

    def _refuse_while_running(self, what: str) -> None:
        while (event := self._opened().new_events()) is not None:
            self._handle(event)
        if self._is_running or not self.access.is_over(self._end_s):
            raise DeviceError(self._name, f"{what} while a program runs; call wait() first")

    def _wait_for_box(self, box: Box, timeout_s: float) -> None:
        while (event := box.new_events(timeout_s)) is not None:
            self._handle(event)
            if not self._is_running:
                return
        with suppress(DeviceTimeoutError):  # the message of the end may have been damaged
            state = box.state(tries=1)
            if state.boots != self._n_boots:
                self._was_reset(state.boots)
            if state.runs == (self._n_runs + 1) & 0xFFFF:
                self._has_ended(state.runs)
                return
        raise late_error(self._name, timeout_s, is_external=self._settings.start == "external")

    def _handle(self, event: list[str]) -> None:
        """Act on a message that the box sent without being asked.

        Raises:
            DeviceError: It turned all lines off.
        """
        what, *words = event
        numbers = [int(word, 16) for word in words]
        if what == "done":
            self._has_ended(numbers[-1])
        elif what == "boot":
            self._was_reset(*numbers)
        elif what == "off":
            self._forget()
            text = "the box received a command to turn all lines off, but not from this driver"
            raise DeviceError(self._name, f"{text}; does another program use it?")
        elif what == "alone":
            self._forget()
            silent = format_quantity(self._settings.watchdog_timeout, "time")
            text = f"the box heard nothing for {silent} and turned all lines off"
            raise DeviceError(self._name, f"{text}; raise 'watchdog_timeout' if this computer is too busy")

    def _has_ended(self, n_runs: int) -> None:
        self._is_running, self._n_runs = False, n_runs

    def _was_reset(self, n_boots: int, cause: int = 0) -> NoReturn:
        self._forget()
        self._slots.clear()
        self._n_boots, self._n_runs, self._was_lost = n_boots, 0, True
        text = f"the box was reset (reason: {cause_text(cause)}) and turned all lines off"
        raise DeviceError(self._name, f"{text}; check its supply and cable")


class Heartbeat(threading.Thread):
    """Sends something to a box regularly, so that its watchdog does not turn all lines off.

    Args:
        beat: Sends it. It may fail, since the driver's next command finds out why.
        timeout_s: The box's watchdog timeout.
    """

    def __init__(self, beat: Callable[[], object], timeout_s: float) -> None:
        super().__init__(name="labseq ttl heartbeat", daemon=True)
        self._beat = beat
        self._period_s = timeout_s / BEATS_PER_TIMEOUT
        self._stopped = threading.Event()

    def run(self) -> None:
        """Run until it is stopped."""
        while not self._stopped.wait(self._period_s):
            with suppress(DeviceError):
                self._beat()

    def stop(self) -> None:
        """Stop, and return when the thread has ended."""
        self._stopped.set()
        self.join()


def bit_pattern() -> tuple[Edge, ...]:
    """A program in which every bit is once 0 and once 1."""
    first = (0, OUTPUTS & 0x5555)
    others = [(LONGEST ^ i, OUTPUTS & 0xAAAA) if i % 2 else (SHORTEST + i, OUTPUTS) for i in range(1, EDGES)]
    return first, *others
