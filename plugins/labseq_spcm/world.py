"""What a simulated card does to the simulated world."""

from __future__ import annotations

from typing import Final

import numpy as np

from labseq import Simulation, ToneProgram
from labseq.model import AxisTones

_NOTHING: Final = np.empty(0)
_NO_TONES: Final = AxisTones(np.zeros(1, np.int32), _NOTHING, _NOTHING, _NOTHING, _NOTHING, _NOTHING)
SILENCE: Final = ToneProgram(_NO_TONES, _NO_TONES, _NOTHING, np.empty(0, np.int8), np.empty(0, np.int32))
"""The program that has no segments: all tones off."""


class Stage:
    """Tells the simulated world what is played; without a world it tells nobody.

    The world is told the program, not yet the samples.

    Args:
        world: The simulated world, or None, as for a real card.
    """

    def __init__(self, world: Simulation | None) -> None:
        self._world = world
        self._program: ToneProgram | None = None

    def prepare(self, program: ToneProgram | None) -> None:
        """This is what will be played."""
        self._program = program

    def play(self, start_s: float) -> None:
        """It begins."""
        if self._world is not None and self._program is not None:
            self._world.play("mobile_tweezers", self._program, start_s)

    def cut(self, now_s: float) -> None:
        """It is cut short."""
        if self._world is not None:
            self._world.play("mobile_tweezers", SILENCE, now_s)
