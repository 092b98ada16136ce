"""The driver."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final, NoReturn

from labseq.plugin import (
    ConfigError,
    Context,
    DeviceError,
    DeviceTimeoutError,
    LineProgram,
    Lines,
    LinesFacts,
    idle_program,
    off_program,
    one_of,
)
from labseq_ttl import faults
from labseq_ttl.box import Box
from labseq_ttl.connection import SIMULATED_MAX_WAIT_S, Connection
from labseq_ttl.counterpart import warm_simulator
from labseq_ttl.programs import MAX_EDGES, as_played, edges_of, mask_of
from labseq_ttl.protocol import CHANNELS, SHORTEST_S, TICK_S, VERSION
from labseq_ttl.self_test import check_box
from labseq_ttl.settings import TtlSettings
from labseq_ttl.slots import Slots

LATENCY_S: Final = 0.4e-3
"""From the end of ``fire`` on the line to the first edge, without the computer's own delays."""

ROUNDING_S: Final = 1e-9


class TtlLines(Lines):
    """A timing box with labseq's firmware.

    Args:
        settings: Port, start, who simulates it.
        context: Lines, clock and, for a simulated box, the world that feels the lines.
    """

    def __init__(self, settings: TtlSettings, context: Context) -> None:
        self._settings = settings
        self._name = context.name or "lines"
        self._clock = context.clock
        self._world = context.simulation
        self._specs = context.lines
        self._names = tuple(spec.name for spec in self._specs)
        self._polarity = mask_of([spec.active_low for spec in self._specs], self._specs)
        self._polarity |= 0 if settings.go is None else settings.go.polarity
        self._connection: Connection | None = None
        self._slots = Slots()
        self._n_boots = self._n_runs = 0
        self._was_lost = False
        self._forget()

    @property
    def lines_facts(self) -> LinesFacts:
        """Channels and limits."""
        return LinesFacts(CHANNELS, TICK_S, SHORTEST_S, MAX_EDGES, LATENCY_S)

    def warm(self) -> None:
        """Compile what runs the firmware of a simulated box, if that is what simulates it.

        Raises:
            DeviceError: It cannot be compiled.
        """
        if self._settings.is_simulated:
            warm_simulator(self._settings.simulated_by, self._name)

    def open(self) -> None:
        """Connect to the box; the lines are idle. No effect if it is open.

        Raises:
            ConfigError: A line is on a channel that the box does not have.
            DeviceError: It does not answer, or is another than the profile says.
        """
        if self._connection is not None:
            return
        for spec in self._specs:
            if spec.channel not in CHANNELS:
                text = f"{self._name}: the box has no channel {spec.channel} for '{spec.name}'"
                raise ConfigError(f"{text}; expected {one_of(tuple(map(str, CHANNELS)))}")
        idle = idle_program(self._specs)
        box = self._connect()
        try:
            box.set_lines(mask_of(idle.on[-1].tolist(), self._specs))
        except BaseException:
            self._disconnect()
            raise
        self._apply_lines(idle)

    def close(self) -> None:
        """Turn all lines off and disconnect; legal in any state."""
        try:
            self.safe_state()
        finally:
            self._disconnect()

    def safe_state(self) -> None:
        """Turn all lines off, whatever the box is doing; it is tried once more on a new connection.

        Raises:
            DeviceError: The box does not confirm it.
        """
        self._forget()
        if self._connection is None:
            return
        try:
            self._connection.box.line.stop()
            self._connection.box.line.drop_messages()
        except DeviceError:
            self._was_lost = True
        if self._was_lost:
            self._disconnect()
            self._connect()  # which turns all off
        self._apply_lines(off_program(self._specs))

    def compile(self, program: LineProgram) -> None:
        """Take a program for the next firing; one that the box knows already is not sent again.

        Raises:
            LimitError: More edges, or nearer to one another, than the box can make.
            DeviceError: Not open, a program runs, or lines that nobody declared.
        """
        connection = self._opened()
        if program.lines != self._names:
            text = f"a program has the lines {program.lines}; expected {self._names}"
            raise DeviceError(self._name, text)
        edges = edges_of(program, self._specs, self._name)
        self._refuse_while_running("compiled")
        slot = self._slots.find(edges)
        if slot is None:
            slot = self._slots.free()
            connection.box.put(slot, edges)
            self._slots.keep(edges, slot)
        self._compiled, self._is_armed = (program, slot, len(edges)), False

    def arm(self) -> None:
        """Get ready to fire what was compiled last.

        Raises:
            DeviceError: Not open, nothing was compiled, a program runs, or the box was reset.
        """
        connection = self._opened()
        self._refuse_while_running("armed")
        if self._compiled is None:
            raise DeviceError(self._name, "armed, but nothing was compiled; call compile() first")
        _, slot, n_edges = self._compiled
        boots = connection.box.arm(slot, n_edges)
        if boots != self._n_boots:
            self._was_reset(boots)
        self._is_armed = True

    def fire(self) -> None:
        """Start the program, or let the start input start it; returns at once.

        Raises:
            DeviceError: Not armed, or a program runs.
        """
        connection = self._opened()
        if not self._is_armed or self._compiled is None:
            raise DeviceError(self._name, "fired, but not armed; call arm() before each fire()")
        self._refuse_while_running("fired")
        program = self._compiled[0]
        self._is_armed, self._is_running = False, True
        connection.box.fire(external=self._settings.start == "external")
        now_s = self._clock.now()
        self._over_s = now_s + program.duration_s
        if connection.counterpart is not None:
            edges = connection.counterpart.played(self._polarity)
            self._apply_lines(as_played(edges, program, self._specs))

    def wait(self, timeout_s: float) -> None:
        """Wait for the end of the program.

        Raises:
            DeviceTimeoutError: It did not end within ``timeout_s``.
            DeviceError: The box was reset or stopped, or the line is broken.
        """
        connection = self._opened()
        if connection.counterpart is not None:  # it plays a program at once: here its time passes
            left_s = self._over_s - self._clock.now()
            self._clock.sleep(max(0.0, min(left_s, timeout_s)))
            if left_s > timeout_s + ROUNDING_S:
                raise self._too_late(timeout_s)
            timeout_s = SIMULATED_MAX_WAIT_S
        if self._is_running:
            self._wait_for_box(connection.box, timeout_s)

    def self_test(self) -> None:
        """Write a program, read it back, and play one that changes no line.

        Raises:
            DeviceError: Not open, a program runs, or the box does something else.
        """
        connection = self._opened()
        self._refuse_while_running("tested")
        self._compiled, self._is_armed = None, False
        check_box(connection, self._slots.free(), self._name, self._polarity)
        self._n_runs = connection.box.state().runs

    def describe(self) -> Mapping[str, Any]:
        """Firmware, serial number, starts, lines, settings in force."""
        told: dict[str, Any] = {"model": "labseq timing box", **self._settings.model_dump(mode="json")}
        if self._connection is not None:
            identity = self._connection.identity
            told |= {"firmware": f"protocol {VERSION}", "serial_number": identity.serial_number}
            told |= {"n_boots": self._n_boots, "started_by": identity.cause}
        return {**told, "lines": {spec.name: spec.channel for spec in self._specs}}

    def _connect(self) -> Box:
        """A box with all lines off."""
        self._forget()
        connection = Connection(self._settings, self._polarity, self._name, self._clock)
        self._slots.clear()
        self._n_boots, self._n_runs = connection.identity.boots, connection.n_runs
        self._connection, self._was_lost = connection, False
        return connection.box

    def _disconnect(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _forget(self) -> None:
        self._compiled: tuple[LineProgram, int, int] | None = None
        self._is_armed = self._is_running = False
        self._over_s = -math.inf

    def _opened(self) -> Connection:
        if self._connection is None:
            raise DeviceError(self._name, "not open; call open() first")
        return self._connection

    def _apply_lines(self, program: LineProgram) -> None:
        """Let the simulated world feel the lines of a simulated box."""
        simulated = self._connection is not None and self._connection.counterpart is not None
        if simulated and self._world is not None:
            self._world.play("lines", program, self._clock.now())

    def _refuse_while_running(self, what: str) -> None:
        while (new_events := self._opened().box.line.new_events()) is not None:
            self._hear(new_events)
        if self._is_running or self._clock.now() < self._over_s - ROUNDING_S:
            raise DeviceError(self._name, f"{what} while a program runs; call wait() first")

    def _wait_for_box(self, box: Box, timeout_s: float) -> None:
        new_events = box.line.new_events(timeout_s)
        while new_events is not None:
            self._hear(new_events)
            if not self._is_running:
                return
            new_events = box.line.new_events(timeout_s)
        with suppress(DeviceTimeoutError):  # perhaps it has said so, and nobody understood it
            state = box.state(tries=1)
            if state.boots != self._n_boots:
                self._was_reset(state.boots)
            if state.runs == (self._n_runs + 1) & 0xFFFF:
                self._has_ended(state.runs)
                return
        raise self._too_late(timeout_s)

    def _hear(self, new_events: list[str]) -> None:
        """What the box says unasked.

        Raises:
            DeviceError: It turned all lines off.
        """
        what, *words = new_events
        numbers = [int(word, 16) for word in words]
        if what == "done":
            self._has_ended(numbers[-1])
        elif what == "boot":
            self._was_reset(*numbers)
        elif what == "off":
            self._forget()
            raise faults.turned_off_error(self._name)
        elif what == "alone":
            self._forget()
            raise faults.watchdog_error(self._name, self._settings.watchdog_timeout)

    def _has_ended(self, n_runs: int) -> None:
        self._is_running, self._n_runs = False, n_runs
        if self._opened().counterpart is None:
            self._over_s = -math.inf

    def _was_reset(self, n_boots: int, cause: int = 0) -> NoReturn:
        self._forget()
        self._slots.clear()
        self._n_boots, self._n_runs, self._was_lost = n_boots, 0, True
        raise faults.reset_error(self._name, cause)

    def _too_late(self, timeout_s: float) -> DeviceTimeoutError:
        is_external = self._settings.start == "external"
        return faults.is_too_late(self._name, timeout_s, is_external=is_external)
