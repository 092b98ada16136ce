"""The simulated camera's amplifiers and clocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from labseq_andor.codes import Code
from labseq_andor.counterpart.calls import answers
from labseq_andor.counterpart.texts import put_text
from labseq_andor.heads import Head

NAMES: Final = ("Electron Multiplying", "Conventional")
BIT_DEPTH: Final = 16


class Amplifiers:
    """Read-out rates, shift speeds, pre-amplifier and offset.

    Args:
        head: What the camera has.

    Attributes:
        amplifier: 0: behind the EM register, 1: the conventional one.
        baseline_clamp: Whether the offset is held steady.
    """

    def __init__(self, head: Head) -> None:
        self._head = head
        self.reset()

    def reset(self) -> None:
        """As after Initialize."""
        self.amplifier = 0
        self.baseline_clamp = False
        self._rate = self._shift = self._preamp = 0

    @property
    def rate_hz(self) -> float:
        """Pixels per second."""
        return self._rates(self.amplifier)[self._rate]

    @property
    def shift_s(self) -> float:
        """Time to shift the rows by one, in seconds."""
        return self._head.shifts_s[self._shift]

    @property
    def preamp_gain(self) -> float:
        """Gain of the pre-amplifier."""
        return self._head.preamp_gains[self._preamp]

    @answers("GetNumberADChannels")
    def get_n_channels(self, number: Any) -> int:
        """One converter."""
        number[0] = 1
        return Code.SUCCESS

    @answers("SetADChannel", only_idle=True)
    def set_channel(self, channel: int) -> int:
        """Choose the converter."""
        return Code.SUCCESS if channel == 0 else Code.P1INVALID

    @answers("GetBitDepth")
    def get_bit_depth(self, channel: int, depth: Any) -> int:
        """Of the converter."""
        depth[0] = BIT_DEPTH
        return Code.SUCCESS if channel == 0 else Code.P1INVALID

    @answers("GetNumberAmp")
    def get_n_amplifiers(self, number: Any) -> int:
        """Two outputs."""
        number[0] = len(NAMES)
        return Code.SUCCESS

    @answers("GetAmpDesc")
    def get_amplifier_name(self, index: int, text: int, length: int) -> int:
        """What an output is called."""
        if not 0 <= index < len(NAMES):
            return Code.P1INVALID
        return put_text(text, NAMES[index], length)

    @answers("SetOutputAmplifier", only_idle=True)
    def set_amplifier(self, index: int) -> int:
        """Choose the output; its fastest rate until another is chosen."""
        if not 0 <= index < len(NAMES):
            return Code.P1INVALID
        if index != self.amplifier:
            self.amplifier, self._rate = index, 0
        return Code.SUCCESS

    @answers("GetNumberHSSpeeds")
    def get_n_rates(self, channel: int, amplifier: int, number: Any) -> int:
        """How many read-out rates an output has."""
        number[0] = len(self._rates(amplifier))
        return Code.SUCCESS if channel == 0 else Code.P1INVALID

    @answers("GetHSSpeed")
    def get_rate(self, channel: int, amplifier: int, index: int, mhz: Any) -> int:
        """A read-out rate, in MHz."""
        rates = self._rates(amplifier)
        if channel != 0 or not 0 <= index < len(rates):
            return Code.P1INVALID if channel else Code.P3INVALID
        mhz[0] = rates[index] / 1e6
        return Code.SUCCESS

    @answers("SetHSSpeed", only_idle=True)
    def set_rate(self, amplifier: int, index: int) -> int:
        """Choose the read-out rate."""
        if not 0 <= index < len(self._rates(amplifier)):
            return Code.P2INVALID
        self._rate = index
        return Code.SUCCESS

    @answers("GetNumberVSSpeeds")
    def get_n_shifts(self, number: Any) -> int:
        """How many shift speeds there are."""
        number[0] = len(self._head.shifts_s)
        return Code.SUCCESS

    @answers("GetVSSpeed")
    def get_shift(self, index: int, microseconds: Any) -> int:
        """A shift speed, in us."""
        return _put(self._head.shifts_s, index, microseconds, 1e6)

    @answers("GetFastestRecommendedVSSpeed")
    def get_recommended_shift(self, index: Any, microseconds: Any) -> int:
        """The fastest shift speed that the maker recommends."""
        index[0] = self._head.recommended_shift
        return self.get_shift(self._head.recommended_shift, microseconds)

    @answers("SetVSSpeed", only_idle=True)
    def set_shift(self, index: int) -> int:
        """Choose the shift speed."""
        if not 0 <= index < len(self._head.shifts_s):
            return Code.P1INVALID
        self._shift = index
        return Code.SUCCESS

    @answers("GetNumberPreAmpGains")
    def get_n_preamp_gains(self, number: Any) -> int:
        """How many gains the pre-amplifier has."""
        number[0] = len(self._head.preamp_gains)
        return Code.SUCCESS

    @answers("GetPreAmpGain")
    def get_preamp_gain(self, index: int, gain: Any) -> int:
        """A gain of the pre-amplifier."""
        return _put(self._head.preamp_gains, index, gain)

    @answers("IsPreAmpGainAvailable")
    def get_is_preamp_gain_there(
        self, channel: int, amplifier: int, rate: int, preamp: int, status: Any
    ) -> int:
        """Every gain goes with every rate."""
        del channel, amplifier, rate
        status[0] = int(0 <= preamp < len(self._head.preamp_gains))
        return Code.SUCCESS

    @answers("SetPreAmpGain", only_idle=True)
    def set_preamp_gain(self, index: int) -> int:
        """Choose the gain of the pre-amplifier."""
        if not 0 <= index < len(self._head.preamp_gains):
            return Code.P1INVALID
        self._preamp = index
        return Code.SUCCESS

    @answers("SetBaselineClamp", only_idle=True)
    def set_baseline_clamp(self, state: int) -> int:
        """Hold the offset steady."""
        self.baseline_clamp = bool(state)
        return Code.SUCCESS

    @answers("GetBaselineClamp")
    def get_baseline_clamp(self, state: Any) -> int:
        """Whether the offset is held steady."""
        state[0] = int(self.baseline_clamp)
        return Code.SUCCESS

    def _rates(self, amplifier: int) -> tuple[float, ...]:
        return self._head.em_rates_hz if amplifier == 0 else self._head.conventional_rates_hz


def _put(values: Sequence[float], index: int, into: Any, factor: float = 1.0) -> int:
    if not 0 <= index < len(values):
        return Code.P1INVALID
    into[0] = values[index] * factor
    return Code.SUCCESS
