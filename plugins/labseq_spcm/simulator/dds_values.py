"""The DDS registers as the driver holds them: ranges, steps, and masks that snap."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq_spcm.simulator import facts, registers as r
from labseq_spcm.simulator.rules import Number, Refusal, refuse

KINDS: Final = (
    r.SPC_DDS_CORE0_FREQ,
    r.SPC_DDS_CORE0_FREQ_SLOPE,
    r.SPC_DDS_CORE0_AMP,
    r.SPC_DDS_CORE0_AMP_SLOPE,
    r.SPC_DDS_CORE0_PHASE,
)
"""First register of each kind that there is per core."""
PHASE: Final = KINDS.index(r.SPC_DDS_CORE0_PHASE)

LIMITS: Final = {
    r.SPC_DDS_AVAIL_FREQ_MIN: 0.0,
    r.SPC_DDS_AVAIL_FREQ_MAX: facts.DDS_RATE_HZ / 2,
    r.SPC_DDS_AVAIL_FREQ_STEP: facts.DDS_FREQUENCY_STEP_HZ,
    r.SPC_DDS_AVAIL_FREQ_SLOPE_MIN: -facts.DDS_FREQUENCY_SLOPE_MAX,
    r.SPC_DDS_AVAIL_FREQ_SLOPE_MAX: facts.DDS_FREQUENCY_SLOPE_MAX,
    r.SPC_DDS_AVAIL_AMP_MIN: -1.0,
    r.SPC_DDS_AVAIL_AMP_MAX: 1.0,
    r.SPC_DDS_AVAIL_AMP_STEP: facts.DDS_AMPLITUDE_STEP,
    r.SPC_DDS_AVAIL_AMP_SLOPE_MIN: -facts.DDS_AMPLITUDE_SLOPE_MAX,
    r.SPC_DDS_AVAIL_AMP_SLOPE_MAX: facts.DDS_AMPLITUDE_SLOPE_MAX,
    r.SPC_DDS_AVAIL_PHASE_MIN: 0.0,
    r.SPC_DDS_AVAIL_PHASE_MAX: 360.0,
    r.SPC_DDS_AVAIL_PHASE_STEP: facts.DDS_PHASE_STEP_DEG,
}

STEPPED: Final = (
    r.SPC_DDS_TRG_SRC,
    r.SPC_DDS_TRG_TIMER,
    r.SPC_DDS_PHASE_BEHAVIOUR,
    r.SPC_DDS_DATA_TRANSFER_MODE,
    r.SPC_DDS_FREQ_RAMP_STEPSIZE,
    r.SPC_DDS_AMP_RAMP_STEPSIZE,
)
"""Registers, besides those of the cores, that have a range and a step."""

FIXED_CORES: Final = 0xFF
"""Cores that always belong to channel 0."""
BLOCKS: Final = (0xF00, 0xF000, 0xF0000)
"""Groups of four cores that channel 0 may have; the first may go to channel 1 instead."""
LONE_CORE: Final = 1 << 20
"""The core that always belongs to channel 1."""


class DdsValues:
    """What was written to the DDS registers last, rounded as the driver rounds it.

    Args:
        n_cores: How many cores the card has.
    """

    def __init__(self, n_cores: int) -> None:
        self.n_cores = n_cores
        self.reset()

    def reset(self) -> None:
        """Back to the state after power-on: 20 cores on channel 0, one on channel 1."""
        self._values: dict[int, float] = {
            **LIMITS,
            r.SPC_DDS_NUM_CORES: self.n_cores,
            r.SPC_DDS_TRG_SRC: r.SPCM_DDS_TRG_SRC_CARD,
            r.SPC_DDS_TRG_TIMER: facts.DDS_TIMER_S[0],
            r.SPC_DDS_PHASE_BEHAVIOUR: r.SPCM_DDS_PHASE_JUMP,
            r.SPC_DDS_DATA_TRANSFER_MODE: r.SPCM_DDS_DTM_SINGLE,
            r.SPC_DDS_FREQ_RAMP_STEPSIZE: 1,
            r.SPC_DDS_AMP_RAMP_STEPSIZE: 1,
            r.SPC_DDS_CORES_ON_CH0: FIXED_CORES | sum(BLOCKS),
            r.SPC_DDS_CORES_ON_CH1: LONE_CORE,
        }

    def __getitem__(self, register: int) -> float:
        if register == r.SPC_DDS_AVAIL_FREQ_SLOPE_STEP:
            return facts.DDS_FREQUENCY_SLOPE_STEP / self._values[r.SPC_DDS_FREQ_RAMP_STEPSIZE]
        if register == r.SPC_DDS_AVAIL_AMP_SLOPE_STEP:
            return facts.DDS_AMPLITUDE_SLOPE_STEP / self._values[r.SPC_DDS_AMP_RAMP_STEPSIZE]
        if register in self._values:
            return self._values[register]
        if self._is_core(register):
            return 0.0
        raise Refusal(r.ERR_REG, "the simulator does not know this register")

    @property
    def masks(self) -> tuple[int, int]:
        """The cores of each channel, a bit each."""
        return int(self._values[r.SPC_DDS_CORES_ON_CH0]), int(self._values[r.SPC_DDS_CORES_ON_CH1])

    def _is_core(self, register: int) -> bool:
        return register // 1000 * 1000 in KINDS and register % 1000 < self.n_cores

    def write(self, register: int, value: Number) -> float:
        """Take a value.

        Returns:
            The value that the card really has: rounded, or snapped.

        Raises:
            Refusal: Out of range, or a register that can only be read.
        """
        if self._is_core(register):
            exact = self._core(register // 1000 * 1000, value)
        elif register in STEPPED:
            exact = self._stepped(value, *self._range(register))
        elif register in (r.SPC_DDS_CORES_ON_CH0, r.SPC_DDS_CORES_ON_CH1):
            return self._connect(register, int(value))
        else:
            self[register]
            raise Refusal(r.ERR_NOWRITEALLOWED, "this register can only be read")
        self._values[register] = exact
        return exact

    def write_many(self, registers: NDArray[np.int32], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take many values of cores, trigger source and timer, at once.

        Args:
            registers: int32 (n,).
            values: float64 (n,).

        Returns:
            float64 (n,): the values that the card really has.

        Raises:
            Refusal: One is out of range, or of another register; none is taken.
        """
        kinds, numbers = registers // 1000 - r.SPC_DDS_CORE0_FREQ // 1000, registers % 1000
        settings = kinds == len(KINDS)  # source and timer: two more kinds
        kinds = np.where(settings, kinds + numbers, kinds)
        known = (kinds >= 0) & (kinds < len(KINDS) + 2) & (settings | (numbers < self.n_cores))
        if not (known.all() and np.isfinite(values).all()):
            raise Refusal(r.ERR_REG, "there is another register, or a value that is not finite")
        low, high, step = self._ranges()[:, kinds]
        phases = kinds == PHASE
        wanted = np.where(phases, values % 360, values)
        if ((wanted < low) | (wanted > high)).any():
            raise Refusal(r.ERR_VALUE, "a value is out of range")
        steps = np.rint(wanted / step)
        exact = np.where(phases, steps % 4096, steps) * step
        self._values.update(zip(registers.tolist(), exact.tolist(), strict=True))
        return exact

    def _core(self, kind: int, value: Number) -> float:
        if kind == r.SPC_DDS_CORE0_PHASE:
            if not math.isfinite(value):
                raise refuse(value, "an angle in degrees")
            return round(value % 360 / facts.DDS_PHASE_STEP_DEG) % 4096 * facts.DDS_PHASE_STEP_DEG
        return self._stepped(value, *self._range(kind))

    def _range(self, register: int) -> tuple[float, float, float]:
        """Least, most and step of a register, or of all registers of a kind."""
        if register == r.SPC_DDS_TRG_TIMER:
            return *facts.DDS_TIMER_S, facts.DDS_TIMER_STEP_S
        if register == r.SPC_DDS_TRG_SRC:
            return 0, 2, 1
        if register in (r.SPC_DDS_PHASE_BEHAVIOUR, r.SPC_DDS_DATA_TRANSFER_MODE):
            return 0, 1, 1
        if register in (r.SPC_DDS_FREQ_RAMP_STEPSIZE, r.SPC_DDS_AMP_RAMP_STEPSIZE):
            return 1, 4096, 1
        if register == r.SPC_DDS_CORE0_FREQ:
            return 0.0, facts.DDS_RATE_HZ / 2, facts.DDS_FREQUENCY_STEP_HZ
        if register == r.SPC_DDS_CORE0_AMP:
            return -1.0, 1.0, facts.DDS_AMPLITUDE_STEP
        if register == r.SPC_DDS_CORE0_FREQ_SLOPE:
            most, step = facts.DDS_FREQUENCY_SLOPE_MAX, self[r.SPC_DDS_AVAIL_FREQ_SLOPE_STEP]
        else:
            most, step = facts.DDS_AMPLITUDE_SLOPE_MAX, self[r.SPC_DDS_AVAIL_AMP_SLOPE_STEP]
        return -most, most, step

    def _ranges(self) -> NDArray[np.float64]:
        """Least, most and step of the kinds of core registers, of the source and of the timer."""
        phase = -np.inf, np.inf, facts.DDS_PHASE_STEP_DEG
        kinds = (*KINDS, r.SPC_DDS_TRG_SRC, r.SPC_DDS_TRG_TIMER)
        return np.array([phase if k == r.SPC_DDS_CORE0_PHASE else self._range(k) for k in kinds]).T

    def _stepped(self, value: Number, low: float, high: float, step: float) -> float:
        if not low <= value <= high:
            raise refuse(value, f"{low:g} to {high:g}")
        return round(value / step) * step

    def _connect(self, register: int, mask: int) -> float:
        """Snap a mask to the connections that the chip has; the first block has one owner."""
        if register == r.SPC_DDS_CORES_ON_CH0:
            mask = FIXED_CORES | sum(block for block in BLOCKS if mask & block)
            other, lost = r.SPC_DDS_CORES_ON_CH1, mask & BLOCKS[0]
        else:
            mask = LONE_CORE | (BLOCKS[0] if mask & BLOCKS[0] else 0)
            other, lost = r.SPC_DDS_CORES_ON_CH0, mask & BLOCKS[0]
        self._values[register] = mask
        self._values[other] = int(self._values[other]) & ~lost
        return mask
