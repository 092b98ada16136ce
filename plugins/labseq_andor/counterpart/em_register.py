"""The simulated camera's EM register."""

from __future__ import annotations

from typing import Any, Final

from labseq_andor.codes import REAL_GAIN_MODE, Code
from labseq_andor.counterpart.calls import answers

LOW: Final = 2
"""Least real EM gain; 0 is off (ours, as cameras of this kind)."""

HIGH: Final = 300
MOST: Final = 1000
"""Most that can be set, and with SetEMAdvanced (ours, as cameras of this kind)."""


class EmRegister:
    """The gain of the EM register.

    Attributes:
        gain: As it was set; 0 for none.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """As after Initialize."""
        self.gain = 0
        self._is_advanced = False
        self._mode = 0

    @answers("SetEMGainMode", only_idle=True)
    def set_mode(self, mode: int) -> int:
        """0: by the steps of a converter; 3: real gain."""
        if mode not in (0, REAL_GAIN_MODE):
            return Code.P1INVALID
        self._mode, self.gain = mode, 0
        return Code.SUCCESS

    @answers("SetEMAdvanced", only_idle=True)
    def set_advanced(self, state: int) -> int:
        """Open the range above 300."""
        self._is_advanced = bool(state)
        if not state:
            self.gain = min(self.gain, HIGH)
        return Code.SUCCESS

    @answers("GetEMAdvanced")
    def get_advanced(self, state: Any) -> int:
        """Whether it is open."""
        state[0] = int(self._is_advanced)
        return Code.SUCCESS

    @answers("GetEMGainRange")
    def get_range(self, low: Any, high: Any) -> int:
        """Gains that can be set."""
        low[0], high[0] = self._range
        return Code.SUCCESS

    @answers("SetEMCCDGain", only_idle=True)
    def set_gain(self, gain: int) -> int:
        """Set it; 0: off. The steps of the converter are not modelled: in that mode only 0 is taken."""
        low, high = self._range
        if gain != 0 and (self._mode != REAL_GAIN_MODE or not low <= gain <= high):
            return Code.P1INVALID
        self.gain = gain
        return Code.SUCCESS

    @answers("GetEMCCDGain")
    def get_gain(self, gain: Any) -> int:
        """The gain as it was set."""
        gain[0] = self.gain
        return Code.SUCCESS

    @property
    def _range(self) -> tuple[int, int]:
        if self._mode != REAL_GAIN_MODE:
            return 0, 255
        return LOW, MOST if self._is_advanced else HIGH
