"""The simulated camera with its identity and its rules for calls."""

# ruff: noqa: D102, N802 - the SDK's names, which its manual explains

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from labseq_andor.codes import EM_GAIN_REAL, AcqModes, Code, Features, SetFunctions, TriggerModes
from labseq_andor.heads import Head
from labseq_andor.sdk import SIGNATURES, Capabilities

from labseq.plugin import Clock, Simulation
from labseq.plugin.camera import SimulatedSensor
from labseq_andor_sim.acquisition import Acquisition
from labseq_andor_sim.faults import Faults
from labseq_andor_sim.settings import Amplifiers, Cooler, Optics, Refused, Timing

SERIAL: Final = 10001
FIRMWARE: Final = (2, 1)

NOT_WHILE_ACQUIRING: Final = ("Set", "Cooler", "Prepare", "Start", "GetTemperatureF")
"""Beginnings of the functions that are refused with DRV_ACQUIRING while the camera acquires."""


class SimulatedCamera:
    """A simulated EMCCD camera as the SDK's functions show it.

    Its sensor is the simulation's. The camera exists from the beginning, also while no program has it open.
    Initialize sets everything except the cooler to its defaults.

    Args:
        sensor_shape: (height, width) of the simulation's sensor.
        arm_s: Time that ``StartAcquisition`` takes, in seconds.

    Attributes:
        faults: Failures to simulate.
        functions: The SDK functions that the camera implements, by name.
    """

    def __init__(
        self,
        world: Simulation,
        clock: Clock,
        head: Head,
        sensor_shape: tuple[int, int],
        serial: int = SERIAL,
        arm_s: float = 0.0,
    ) -> None:
        self.faults = Faults()
        self.sensor = SimulatedSensor(world, clock)
        self.head = head
        self._serial = serial
        self.cooler = Cooler(clock, self.faults)
        self.amplifiers = Amplifiers(head)
        self.optics = Optics(sensor_shape, clock)
        self.timing = Timing(self.optics, self.amplifiers)
        self.acquisition = Acquisition(self.sensor, self.timing, clock, self.faults, arm_s)
        self._is_initialized = False
        self._resettable = (self.amplifiers, self.optics, self.timing, self.acquisition)
        parts = (self, self.cooler, *self._resettable)
        self.functions: dict[str, Callable[..., Any]] = {
            name: getattr(part, name) for part in parts for name in SIGNATURES if hasattr(part, name)
        }

    def initialize(self) -> None:
        """Get ready. Refused if another program uses the camera."""
        if self.faults.held:
            raise Refused(Code.VXDNOTINSTALLED)
        if self.faults.unplugged:
            raise Refused(Code.ERROR_ACK)
        for part in self._resettable:
            part.reset()
        self._is_initialized = True

    def shut_down(self) -> None:
        """Release the camera."""
        if self._is_initialized:
            self._is_initialized = False
            self.acquisition.reset()
            self.cooler.shut_down()

    def check(self, name: str) -> None:
        """Refuse a call of a function that the camera does not take now."""
        if not self._is_initialized:
            raise Refused(Code.NOT_INITIALIZED)
        self.acquisition.proceed()
        if self.faults.unplugged:
            raise Refused(Code.ERROR_ACK)
        if self.acquisition.is_acquiring and name.startswith(NOT_WHILE_ACQUIRING):
            raise Refused(Code.ACQUIRING)

    def trigger(self, t_s: float | None = None, width_s: float = 1e-3) -> bool:
        """A pulse at the trigger input, now or at ``t_s`` of the clock. False if it started no exposure."""
        return self.acquisition.pulse(t_s, width_s)

    def GetHeadModel(self) -> str:
        return self.head.model

    def GetCameraSerialNumber(self) -> int:
        return self._serial

    def GetHardwareVersion(self) -> tuple[int, ...]:
        """Versions of boards, and version and build of the firmware."""
        return 0, 0, 0, 0, *FIRMWARE

    def GetCapabilities(self) -> Capabilities:
        """All that the driver asks for, except bulb with frame transfer, which only the iXon 885 has."""
        return Capabilities(
            ulAcqModes=sum(AcqModes),
            ulTriggerModes=sum(TriggerModes),
            ulSetFunctions=sum(SetFunctions),
            ulFeatures=Features.SHUTTER | Features.FANCONTROL | Features.METADATA,
            ulEMGainCapability=EM_GAIN_REAL,
        )
