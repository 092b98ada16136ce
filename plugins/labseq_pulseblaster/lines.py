"""The driver, which plays one compiled program of all lines by the board's clock."""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, Final

import numpy as np

from labseq.plugin import (
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
from labseq_pulseblaster.emergency import SpinapiError, call, connect, hold, write
from labseq_pulseblaster.library import choose_library
from labseq_pulseblaster.models import Instruction
from labseq_pulseblaster.programs import check_outputs, flags_of, instructions_of, waiting
from labseq_pulseblaster.settings import PulseBlasterSettings

TEST_S: Final = 50e-3
POLL_S: Final = 1e-3
ROUNDING_S: Final = 1e-9
STOPPED: Final = 1
"""Bit of the status."""


class PulseBlasterLines(Lines):
    """Lines on a PulseBlaster.

    Calls raise ``DeviceError`` if the board is not open, refuses, or plays a program.
    """

    def __init__(self, settings: PulseBlasterSettings, context: Context) -> None:
        self._settings = settings
        self._model = settings.facts
        self._name = context.name or "lines"
        self._clock = context.clock
        self._specs = context.lines
        self._names = tuple(spec.name for spec in self._specs)
        check_outputs(self._specs, self._model, self._name)
        self._library = choose_library(settings, context)
        self._spinapi: Any = None
        self._resting = off_program(self._specs)
        self._firmware = self._version = ""
        self._forget()

    @property
    def lines_facts(self) -> LinesFacts:
        """Outputs and limits of the model."""
        model = self._model
        outputs = tuple(range(model.n_outputs))
        tick_s = 1.0 / model.clock_hz
        return LinesFacts(outputs, tick_s, model.shortest * tick_s, model.n_instructions - 3)

    def open(self) -> None:
        """Connect to the board, and turn all lines off. No effect if it is open.

        Raises:
            DeviceError: SpinAPI or the board is missing, or another program holds it.
        """
        if self._spinapi is not None:
            return
        self._spinapi = self._library.load(self._name)
        try:
            self._connect()
            self._rest(off_program(self._specs))
        except BaseException:
            self._disconnect()
            raise

    def idle(self) -> None:
        """Turn on the lines that are on between steps."""
        self._rest(idle_program(self._specs))

    def close(self) -> None:
        """Turn all lines off and disconnect, while the board keeps them off. Legal in any state."""
        try:
            self.safe_state()
        finally:
            self._disconnect()

    def safe_state(self) -> None:
        """Stop a program, and turn all lines off."""
        if self._spinapi is not None:
            self._rest(off_program(self._specs))

    def emergency(self) -> Emergency | None:
        """A script that stops the board, and lets it hold the levels of lines that are off."""
        if self._spinapi is None:
            return None
        flags = self._last_flags(off_program(self._specs))
        return self._library.emergency(self._settings.board_number, self._model.clock_hz / 1e6, flags)

    def check_program(self, program: LineProgram) -> None:
        """Refuse a program that the board cannot play.

        Raises:
            LimitError: Edges closer together, or more of them, than the board can make.
        """
        instructions_of(program, self._specs, self._model, self._name)

    def compile(self, program: LineProgram) -> None:
        """Write a program to the board for the next firing, unless it holds it already.

        Raises:
            LimitError: Edges closer together, or more of them, than the board can make.
        """
        with self._calls():
            if program.lines != self._names:
                text = f"a program has the lines {program.lines}; expected {self._names}"
                raise DeviceError(self._name, text)
            instructions = instructions_of(program, self._specs, self._model, self._name)
            self._refuse_while_running("compiled")
            self._is_armed = False
            self._write(instructions)
            self._compiled = program, instructions

    def arm(self) -> None:
        """Prepare the program that was compiled last."""
        with self._calls():
            self._refuse_while_running("armed")
            if self._compiled is None:
                raise DeviceError(self._name, "armed, but nothing was compiled; call compile() first")
            self._write(self._compiled[1])  # with other levels before the trigger, if it was fired since
            self._is_armed = True

    def fire(self) -> None:
        """Start the program, or let the edge at the trigger input start it, and return at once."""
        with self._calls() as spinapi:
            if not self._is_armed or self._compiled is None:
                raise DeviceError(self._name, "fired, but not armed; call arm() before each fire()")
            program, _ = self._compiled
            self._is_armed, self._is_running = False, True
            call(spinapi, "pb_reset")  # without it the board does not begin at the first instruction
            call(spinapi, "pb_start")
            self._held = self._last_flags(program)
            self._end_s = self._clock.now() + program.duration_s

    def wait(self, timeout_s: float) -> None:
        """Wait for the end of the program.

        Raises:
            DeviceTimeoutError: It did not end within ``timeout_s``.
        """
        with self._calls():
            deadline_s = self._clock.now() + timeout_s
            self._clock.sleep(max(0.0, min(self._end_s - self._clock.now(), timeout_s)))
            while self._is_running and not self._is_stopped():
                if (left_s := deadline_s - self._clock.now()) < ROUNDING_S:
                    text = f"the program has not ended after {format_quantity(timeout_s, 'time')}"
                    raise DeviceTimeoutError(self._name, f"{text}; {self._late_hint()}", timeout_s)
                self._clock.sleep(min(left_s, POLL_S))
            self._is_running = False

    def self_test(self) -> None:
        """Play a program that changes no line, and check that the clock matches the model.

        Raises:
            DeviceError: The program ended too early.
        """
        on = self._resting.on[-1:]
        self.compile(LineProgram("test", self._names, np.zeros(1), on, 0.0, TEST_S))
        self.arm()
        self.fire()
        if not self._settings.external_trigger:  # then it may begin at any time
            self._clock.sleep(0.8 * TEST_S)
            with self._calls():
                if self._is_stopped():
                    text = "a program ended before 80 % of its time, so the board's clock is faster than"
                    raise DeviceError(self._name, f"{text} the clock of 'model', {self._settings.model}")
        self.wait(TEST_S)
        self._rest(self._resting)

    def describe(self) -> Mapping[str, Any]:
        """Model, firmware, lines, settings."""
        lines = {spec.name: spec.channel for spec in self._specs}
        return {"firmware": self._firmware, "lines": lines, **self._settings.model_dump(mode="json")}

    def versions(self) -> Mapping[str, tuple[str, str]]:
        """Version of SpinAPI."""
        return {"SpinAPI": (self._version, "")} if self._version else {}

    def _connect(self) -> None:
        with self._calls() as spinapi:
            number, n_boards = self._settings.board_number, call(spinapi, "pb_count_boards")
            if number >= n_boards:
                found = f"boards 0 to {n_boards - 1}" if n_boards else "no board"
                text = f"there is no board {number}, since SpinAPI finds {found}"
                raise DeviceError(self._name, f"{text}; check the cable, or change 'board_number'")
            connect(spinapi, number, self._model.clock_hz / 1e6)
            firmware = call(spinapi, "pb_get_firmware_id")
            self._firmware = f"{firmware >> 8 & 0xFF}-{firmware & 0xFF}"
            self._version = spinapi.pb_get_version().decode(errors="replace")

    def _write(self, instructions: tuple[Instruction, ...]) -> None:
        """Write a program, unless the board holds it."""
        if self._settings.external_trigger:
            instructions = (*waiting(self._held, self._model), *instructions)
        if instructions == self._written:
            return
        self._written = ()
        hz = self._model.clock_hz
        write(self._spinapi, ((flags, code, data, n * 1e9 / hz) for flags, code, data, n in instructions))
        self._written = instructions

    def _rest(self, program: LineProgram) -> None:
        """Stop a program, and hold the last states of another one."""
        self._forget()
        with self._calls() as spinapi:
            hold(spinapi, self._last_flags(program))
        self._held, self._resting = self._last_flags(program), program

    def _last_flags(self, program: LineProgram) -> int:
        return flags_of(program.on[-1].tolist(), self._specs, self._model)

    def _is_stopped(self) -> bool:
        return bool(call(self._spinapi, "pb_read_status") & STOPPED)

    def _late_hint(self) -> str:
        if self._settings.external_trigger:
            return "is there an edge at the board's trigger input?"
        return f"is the board a {self._settings.model}?"

    def _refuse_while_running(self, what: str) -> None:
        if self._is_running and not self._is_stopped():
            raise DeviceError(self._name, f"{what} while a program runs; call wait() first")
        self._is_running = False

    def _forget(self) -> None:
        self._compiled: tuple[LineProgram, tuple[Instruction, ...]] | None = None
        self._written: tuple[Instruction, ...] = ()
        self._held = self._last_flags(off_program(self._specs))
        self._is_armed = self._is_running = False
        self._end_s = -math.inf

    def _disconnect(self) -> None:
        self._forget()
        spinapi, self._spinapi = self._spinapi, None
        if spinapi is not None:
            with suppress(SpinapiError):
                call(spinapi, "pb_close")

    @contextmanager
    def _calls(self) -> Generator[Any]:
        """Within the block SpinCore's errors become errors of this device."""
        if self._spinapi is None:
            raise DeviceError(self._name, "not open; call open() first")
        try:
            yield self._spinapi
        except SpinapiError as error:
            raise DeviceError(self._name, f"SpinAPI: {error}") from error
