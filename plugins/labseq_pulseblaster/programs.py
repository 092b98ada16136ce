"""A program of the lines as instructions of the board."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from labseq.plugin import ConfigError, LimitError, LineProgram, LineSpec, format_quantity
from labseq_pulseblaster.models import LONGEST, Code, Instruction, Model

CHUNK: Final = 2**30
"""Clock cycles that a long delay repeats."""


def check_outputs(specs: Sequence[LineSpec], model: Model, device: str) -> None:
    """Refuse lines on outputs that the board does not have.

    Raises:
        ConfigError: There is such a line.
    """
    for spec in specs:
        if spec.channel not in range(model.n_outputs):
            text = f"{device}: '{spec.name}' is on channel {spec.channel}"
            raise ConfigError(f"{text}; expected the number of an output, 0 to {model.n_outputs - 1}")


def flags_of(on: Sequence[bool], specs: Sequence[LineSpec], model: Model) -> int:
    """The flags for a state of the lines."""
    high = (1 << int(spec.channel) for spec, is_on in zip(specs, on, strict=True) if is_on != spec.active_low)
    return sum(high) | model.fixed_flags


def instructions_of(
    program: LineProgram, specs: Sequence[LineSpec], model: Model, device: str
) -> tuple[Instruction, ...]:
    """The instructions of a program. The last one stops the board, which holds the levels before it.

    Raises:
        LimitError: Edges closer together than the shortest instruction, or too many instructions.
    """
    what = f"{device}: `{program.kind}`"
    steps = np.diff(np.rint(np.append(program.t_s, program.duration_s) * model.clock_hz)).astype(np.int64)
    if (close := np.flatnonzero(steps[:-1] < model.shortest)).size:
        first = int(close[0])
        before_s, t_s = program.t_s[first : first + 2].tolist()
        changes = program.on[first] != program.on[first + 1]
        names = ", ".join(f"'{line}'" for line, new in zip(program.lines, changes, strict=True) if new)
        between = f"{what}: time before the edge of {names} at {format_quantity(t_s, 'time', 7)}"
        shortest = format_quantity(model.shortest / model.clock_hz, "time")
        came = format_quantity(t_s - before_s, "time")
        raise LimitError(between, came, f"at least {shortest}", "change a lead, a lag or a pulse")
    # a long pause needs two instructions, and STOP and the two of ``waiting`` need room, too
    n_instructions, most = len(steps) + int((steps > LONGEST).sum()), model.n_instructions - 3
    if n_instructions > most:
        raise LimitError(f"{what}: number of instructions", n_instructions, f"at most {most}")
    steps[-1] = max(steps[-1], model.shortest)
    flags = [flags_of(row, specs, model) for row in program.on.tolist()]
    delays = zip(flags, steps.tolist(), strict=True)
    instructions = [instruction for flag, cycles in delays for instruction in _delay(flag, cycles)]
    return *instructions, Instruction(flags[-1], Code.STOP, 0, model.shortest)


def _delay(flags: int, cycles: int) -> Iterator[Instruction]:
    """Hold flags for a time, in a long delay if one instruction cannot."""
    if cycles > LONGEST:
        n_chunks = cycles // CHUNK - 1
        yield Instruction(flags, Code.LONG_DELAY, n_chunks, CHUNK)
        cycles -= n_chunks * CHUNK
    yield Instruction(flags, Code.CONTINUE, 0, cycles)


def waiting(flags: int, model: Model) -> tuple[Instruction, ...]:
    """The instructions before a program that waits for the trigger input.

    A WAIT must follow an instruction that is longer than the shortest.
    """
    before = Instruction(flags, Code.CONTINUE, 0, 2 * model.shortest)
    return before, Instruction(flags, Code.WAIT, 0, model.shortest)
