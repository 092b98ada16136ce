"""The simulated camera: its parts, and which calls it answers when."""

from __future__ import annotations

from typing import Final

from labseq.plugin import Clock, LabseqError, SimulatedSensor, Simulation
from labseq_andor.codes import Code
from labseq_andor.counterpart.acquisition import Acquisition
from labseq_andor.counterpart.amplifiers import Amplifiers
from labseq_andor.counterpart.calls import Answer, answers_of, names_of
from labseq_andor.counterpart.cooler import Cooler
from labseq_andor.counterpart.em_register import EmRegister
from labseq_andor.counterpart.faults import Faults
from labseq_andor.counterpart.identity import Identity
from labseq_andor.counterpart.optics import Optics
from labseq_andor.counterpart.timing import Timing
from labseq_andor.counterpart.triggers import TriggerSettings
from labseq_andor.heads import Head

SERIAL: Final = 10001
_PARTS: Final = (Identity, Cooler, Amplifiers, EmRegister, Optics, Timing, TriggerSettings, Acquisition)
FUNCTIONS: Final = frozenset[str]().union(*(names_of(part) for part in _PARTS))
"""Names of the functions of the SDK that it answers."""


class SimulatedCamera:
    """An EMCCD camera that exists only in software, as the SDK's functions show it.

    Its sensor is that of the simulated world. It is there from the beginning, also while nobody has it
    open; Initialize sets everything but the cooler to its defaults.

    Args:
        world: The simulated world.
        clock: The session's clock.
        head: What the camera is.
        sensor_shape: (height, width) of the world's sensor.
        serial: Serial number.

    Attributes:
        faults: Failures to rehearse.
        sensor: Where its pixels come from.
        failure: Why the world could not be exposed; None if it could.
    """

    def __init__(
        self, world: Simulation, clock: Clock, head: Head, sensor_shape: tuple[int, int], serial: int = SERIAL
    ) -> None:
        self.faults = Faults()
        self.sensor = SimulatedSensor(world, clock)
        self.failure: LabseqError | None = None
        self.identity = Identity(head, serial)
        self.cooler = Cooler(clock, self.faults)
        self.amplifiers = Amplifiers(head)
        self.register = EmRegister()
        self.optics = Optics(sensor_shape, clock)
        self.timing = Timing(self.optics, self.amplifiers, self.register)
        self.triggers = TriggerSettings()
        self.acquisition = Acquisition(self.sensor, self.timing, self.triggers, clock, self.faults)
        self._is_initialized = False
        self._resettable = (
            self.amplifiers,
            self.register,
            self.optics,
            self.timing,
            self.triggers,
            self.acquisition,
        )
        self._answers: dict[str, Answer] = {}
        for part in (self.identity, self.cooler, *self._resettable):
            self._answers |= answers_of(part)

    def initialize(self) -> int:
        """Get ready; refused if another program holds the camera."""
        if self.faults.held:
            return Code.VXDNOTINSTALLED
        if self.faults.unplugged:
            return Code.ERROR_ACK
        for part in self._resettable:
            part.reset()
        self._is_initialized = True
        return Code.SUCCESS

    def shut_down(self) -> int:
        """Let the camera go."""
        if not self._is_initialized:
            return Code.NOT_INITIALIZED
        self._is_initialized = False
        self.acquisition.abort()
        self.cooler.shut_down()
        return Code.SUCCESS

    def answer(self, name: str) -> Answer:
        """How it answers one of :data:`FUNCTIONS`."""
        return self._answers[name]

    def refusal(self, answer: Answer) -> int:
        """Why a call is refused now; SUCCESS if it is not."""
        if not self._is_initialized:
            return Code.NOT_INITIALIZED
        self.acquisition.proceed()
        if self.faults.unplugged:
            return Code.ERROR_ACK
        if answer.rule.only_idle and self.acquisition.is_acquiring:
            return Code.ACQUIRING
        return Code.SUCCESS

    def trigger(self) -> bool:
        """An edge at the trigger input, now; False if it started no exposure."""
        return self.acquisition.pulse()
