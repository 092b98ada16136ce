"""What starts the simulated camera's exposures."""

from __future__ import annotations

from typing import Any, Final

from labseq_andor.codes import EXTERNAL_TRIGGER, SOFTWARE_TRIGGER, Code
from labseq_andor.counterpart.calls import answers

INTERNAL_TRIGGER: Final = 0
KINETIC, RUN_TILL_ABORT = 3, 5
ENDLESS: Final = 2**31


class TriggerSettings:
    """Acquisition mode and trigger.

    Attributes:
        trigger: 0: internal, 1: external, 10: software.
        runs_till_abort: Whether the series has no end.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """As after Initialize."""
        self.trigger = INTERNAL_TRIGGER
        self._mode = self._n_kinetics = 1

    @property
    def runs_till_abort(self) -> bool:
        """Whether the series has no end."""
        return self._mode == RUN_TILL_ABORT

    @property
    def n_frames(self) -> int:
        """Frames of a series."""
        return {KINETIC: self._n_kinetics, RUN_TILL_ABORT: ENDLESS}.get(self._mode, 1)

    @answers("SetAcquisitionMode", only_idle=True)
    def set_mode(self, mode: int) -> int:
        """1: single, 2: accumulate, 3: kinetic, 5: run till abort."""
        if mode not in (1, 2, KINETIC, RUN_TILL_ABORT):
            return Code.P1INVALID
        self._mode = mode
        return Code.SUCCESS

    @answers("SetNumberKinetics", only_idle=True)
    def set_n_kinetics(self, number: int) -> int:
        """Length of a kinetic series."""
        if number < 1:
            return Code.P1INVALID
        self._n_kinetics = number
        return Code.SUCCESS

    @answers("SetNumberAccumulations", only_idle=True)
    def set_n_accumulations(self, number: int) -> int:
        """One exposure per frame: sums are not modelled."""
        return Code.SUCCESS if number == 1 else Code.P1INVALID

    @answers("SetTriggerMode", only_idle=True)
    def set_trigger(self, mode: int) -> int:
        """Choose the trigger."""
        if mode not in (INTERNAL_TRIGGER, EXTERNAL_TRIGGER, SOFTWARE_TRIGGER):
            return Code.P1INVALID
        self.trigger = mode
        return Code.SUCCESS

    @answers("SetTriggerInvert", "SetFastExtTrigger", only_idle=True)
    def set_edge(self, mode: int) -> int:
        """Which edge counts, and whether it cuts a cleaning cycle short: a pulse has both edges."""
        return Code.SUCCESS if mode in (0, 1) else Code.P1INVALID

    @answers("GetTriggerLevelRange")
    def get_levels(self, least: Any, most: Any) -> int:
        """The level of the trigger input cannot be set."""
        del least, most
        return Code.NOT_SUPPORTED
