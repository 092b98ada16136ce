"""The boards, and their instructions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, NamedTuple

LONGEST: Final = 2**32 - 1
"""Most clock cycles of an instruction, whose delay counter has 32 bits."""
SHORT_PULSE_BITS: Final = 0b111 << 21
"""Flags that are not outputs on a PulseBlasterESR-PRO. With 0 all outputs are low, with 1 to 6 they are high
only for as many cycles, with 7 they follow the other flags."""


class Code(IntEnum):
    """Codes of the instructions that are used, from SpinCore's ``spinapi.h``."""

    CONTINUE = 0
    STOP = 1
    BRANCH = 6
    LONG_DELAY = 7
    WAIT = 8


class Instruction(NamedTuple):
    """An instruction of the board.

    Attributes:
        flags: Bit n is output n.
        code: Action that follows it.
        data: Number of repetitions of a long delay, or address of a branch.
        cycles: Its length in clock cycles.
    """

    flags: int
    code: int
    data: int
    cycles: int


@dataclass(frozen=True, slots=True)
class Model:
    """A board, from SpinCore's manuals.

    Attributes:
        clock_hz: Frequency of its core clock.
        n_outputs: Number of its outputs.
        n_instructions: Size of its memory.
        shortest: Fewest clock cycles of an instruction.
        fixed_flags: Flags of every instruction that are not outputs.
    """

    clock_hz: float
    n_outputs: int
    n_instructions: int
    shortest: int
    fixed_flags: int = 0


def _esr_pro(clock_hz: float) -> Model:
    return Model(clock_hz, 21, 4096, 5, SHORT_PULSE_BITS)


MODELS: Final[Mapping[str, Model]] = {
    "PB24-100-4k": Model(100e6, 24, 4096, 5),
    "PB24-100-32k": Model(100e6, 24, 32768, 9),
    "PBESR-PRO-250": _esr_pro(250e6),
    "PBESR-PRO-300": _esr_pro(300e6),
    "PBESR-PRO-400": _esr_pro(400e6),
    "PBESR-PRO-500": _esr_pro(500e6),
}
