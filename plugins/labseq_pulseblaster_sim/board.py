"""The simulated board with its refusals and its outputs."""

from __future__ import annotations

import math
from enum import IntFlag
from typing import Final

import numpy as np
from labseq_pulseblaster.models import LONGEST, SHORT_PULSE_BITS, Code, Instruction
from labseq_pulseblaster.settings import PulseBlasterSettings

from labseq.plugin import Context, LineProgram

ROUNDING_S: Final = 1e-9
MAX_REPETITIONS: Final = 2**20


class Status(IntFlag):
    """Bits of the status."""

    STOPPED = 1
    RESET = 2
    RUNNING = 4
    WAITING = 8


class Refused(Exception):  # noqa: N818 - a call is refused, which is no error of the simulator
    """A call is refused. The text says why."""


class Board:
    """A computer with one board.

    Attributes:
        n_boards: Number of boards that the library finds.
        told_mhz: Clock that the program has told the library, 0 for none.
        program: The instructions in its memory.
        flags: Flags of its outputs.
    """

    firmware = 0x0A01

    def __init__(self, settings: PulseBlasterSettings, context: Context) -> None:
        self._model = settings.facts
        self._faults = settings.faults
        self._clock = context.clock
        self._simulation = context.simulation
        self._specs = context.lines
        self._number = settings.board_number
        self.n_boards = 0 if settings.faults.missing else settings.board_number + 1
        self.told_mhz = 0.0
        self.program: list[Instruction] = []
        self.flags = 0
        self._played: list[tuple[float, int]] = []
        self._begin_s = self._end_s = -math.inf
        self._is_open = self._is_written = self._is_reset = False
        self._is_waiting = self._is_unplugged = False

    def select(self, number: int) -> None:
        """Select a board by its number."""
        if not 0 <= number < self.n_boards:
            raise Refused(f"there is no board {number}")

    def open(self) -> None:
        """Open the board."""
        if not self.n_boards:
            raise Refused("no board was found")
        if self._faults.in_use:
            raise Refused("the board cannot be opened; another program may use it")
        self._is_open, self._is_reset = True, True

    def close(self) -> None:
        """Close the board, which continues its program."""
        self._reach()
        self._is_open = False

    def start_programming(self, device: int) -> None:
        """Begin to write a program, from the first instruction on."""
        self._reach()
        if device != 0:
            raise Refused(f"{device} is not something to program; expected 0, the pulse program")
        if not self.told_mhz:
            raise Refused("the clock is not known; call pb_core_clock")
        if not self._is_reset:
            raise Refused("the board is not stopped; call pb_stop before pb_start_programming")
        self.program, self._is_written = [], True

    def add(self, flags: int, code: int, data: int, length_ns: float) -> int:
        """Write an instruction, and return its address."""
        self._reach()
        if not self._is_written:
            raise Refused("no program is being written; call pb_start_programming")
        cycles = round(length_ns * self.told_mhz / 1e3)
        instruction = Instruction(flags, code, data, cycles)
        self._check(instruction)
        self.program.append(instruction)
        return len(self.program) - 1

    def _check(self, instruction: Instruction) -> None:
        flags, code, data, cycles = instruction
        shortest, address = self._model.shortest, len(self.program)
        before = self.program[-1].cycles if self.program else 0
        problems = {
            f"there is no instruction {code}": code not in tuple(Code),
            f"the memory has room for {self._model.n_instructions} instructions": address
            >= self._model.n_instructions,
            f"flags {flags:#x} have more than 24 bits": not 0 <= flags < 1 << 24,
            f"an instruction of {cycles} clock cycles; expected at least {shortest}": cycles < shortest,
            f"an instruction of {cycles} clock cycles; expected at most {LONGEST}": cycles > LONGEST,
            f"a long delay of {data} repetitions": code == Code.LONG_DELAY
            and not 2 <= data <= MAX_REPETITIONS,
            f"a branch to instruction {data}": code == Code.BRANCH and not 0 <= data <= address,
            "WAIT needs a longer instruction before it": code == Code.WAIT and before <= shortest,
        }
        for text, is_refused in problems.items():
            if is_refused:
                raise Refused(text)

    def stop_programming(self) -> None:
        """End writing."""
        self._reach()
        if not self._is_written:
            raise Refused("no program is being written; call pb_start_programming")
        if not self.program or self.program[-1].code not in (Code.STOP, Code.BRANCH):
            raise Refused("the program does not end with STOP or BRANCH")
        self._is_written = False

    def start(self) -> None:
        """Play the program from its first instruction on, and past WAIT once the edge has come."""
        self._reach()
        if self._is_written or not self.program:
            raise Refused("there is no program that was written to its end")
        if not self._is_reset:
            raise Refused("the board is not reset; call pb_reset before pb_start")
        self._is_reset = False
        codes = [instruction.code for instruction in self.program]
        first = codes.index(Code.WAIT) + 1 if Code.WAIT in codes else 0
        if first:
            self._play(self.program[:first])
        self._is_waiting = bool(first) and self._faults.no_edge
        if not self._is_waiting:
            self._play(self.program[first:])
        self._is_unplugged = self._faults.unplugged

    def reset(self) -> None:
        """Stop. Outputs keep the levels of that moment."""
        self._reach()
        now_s = self._clock.now()
        if now_s < self._end_s - ROUNDING_S:
            flags = [flags for t_s, flags in self._played if self._begin_s + t_s <= now_s + ROUNDING_S][-1]
            if flags != self.flags:
                self._show([(0.0, flags)], 0.0)
        self._is_reset, self._is_waiting, self._end_s = True, False, -math.inf

    def status(self) -> int:
        """Present state of the board."""
        self._reach()
        if self._is_reset:
            return Status.STOPPED | Status.RESET
        if self._is_waiting:
            return Status.WAITING
        return Status.RUNNING if self._clock.now() < self._end_s - ROUNDING_S else Status.STOPPED

    def _play(self, instructions: list[Instruction]) -> None:
        """Play instructions from now on, up to the end of the last. A branch back never ends."""
        clock_hz = self._faults.clock or self._model.clock_hz
        cycles, steps = 0, list[tuple[float, int]]()
        for flags, code, data, length in instructions:
            steps.append((cycles / clock_hz, flags))
            if code not in (Code.STOP, Code.WAIT):
                cycles += length * (data if code == Code.LONG_DELAY else 1)
        is_endless = instructions[-1].code == Code.BRANCH
        self._end_s = math.inf if is_endless else self._clock.now() + cycles / clock_hz
        self._show(steps, cycles / clock_hz)

    def _show(self, steps: list[tuple[float, int]], duration_s: float) -> None:
        """Set the flags of the outputs from now on. The simulation receives the states of the lines."""
        self._played, self._begin_s = steps, self._clock.now()
        self.flags = steps[-1][1]
        states = [self._states(flags) for _, flags in steps]
        kept = [i for i in range(len(steps)) if i == 0 or states[i] != states[i - 1]]
        t_s = np.array([steps[i][0] for i in kept])
        on = np.array([states[i] for i in kept], np.bool_).reshape(len(kept), len(self._specs))
        if self._simulation is not None:
            names = tuple(spec.name for spec in self._specs)
            program = LineProgram("played", names, t_s, on, 0.0, duration_s)
            self._simulation.play("lines", program, self._clock.now())

    def _states(self, flags: int) -> list[bool]:
        """Which lines are on. Outputs of a board with the short pulse feature are low without its bits."""
        has_short_pulses = self._model.fixed_flags == SHORT_PULSE_BITS
        high = 0 if has_short_pulses and not flags & SHORT_PULSE_BITS else flags
        return [bool(high >> int(spec.channel) & 1) != spec.active_low for spec in self._specs]

    def _reach(self) -> None:
        if self._is_unplugged:
            raise Refused("the board does not answer")
        if not self._is_open:
            raise Refused("the board is not open; call pb_init")
