"""The simulated camera: its identity, its cooler, and which calls it accepts when."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final

from labseq_andor.codes import EM_GAIN_REAL, AcqModes, Code, Features, GetFunctions, SetFunctions, Triggers
from labseq_andor.heads import Head

from labseq.plugin import Clock, Simulation
from labseq.plugin.camera import SimulatedSensor
from labseq_andor_sim.acquisition import Acquisition, Faults
from labseq_andor_sim.configuration import Amplifiers, Optics, Timing
from labseq_andor_sim.functions import Function, functions_of, implements, require

SERIAL: Final = 10001
FIRMWARE: Final = (2, 1)
READ_MODES: Final = 1 | 2 | 4 | 8 | 16 | 32
"""Images, regions and tracks: pylablib requires all of them."""
IXON_ULTRA: Final = 21
PIXELS_OF_16_BIT: Final = 4

ROOM_C: Final = 20.0
TEMPERATURES_C: Final = (-120, 20)
"""Temperatures that can be set (ours)."""
TIME_CONSTANT_S: Final = 60.0
"""Time constant with which the sensor reaches its temperature (ours)."""
NEAR_K: Final = 1.0
"""Largest deviation from the temperature that counts as reached (ours)."""
STABLE_AFTER_S: Final = 30.0
"""How long it must have been reached until the camera reports it as stabilized (ours)."""


class SimulatedCamera:
    """A simulated EMCCD camera as the SDK's functions show it.

    Its sensor is the simulation's. The camera exists from the beginning, also while no program has it open;
    Initialize sets everything except the cooler to its defaults.

    Args:
        sensor_shape: (height, width) of the simulation's sensor.
        arm_s: Time that ``StartAcquisition`` takes, in seconds.

    Attributes:
        faults: Failures to simulate.
        functions: The SDK functions that the camera implements, by name.
    """

    getters: ClassVar[Mapping[str, Callable[[Any], object]]] = {
        "GetControllerCardModel": lambda _: "USB",
        "GetHeadModel": lambda self: self.head.model,
        "GetCameraSerialNumber": lambda self: self._serial,
        "GetHardwareVersion": lambda _: (0, 0, 0, 0, *FIRMWARE),
    }

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
        self.head, self._clock = head, clock
        self._serial = serial
        self.cooler = Cooler(clock, self.faults)
        self.amplifiers = Amplifiers(head)
        self.optics = Optics(sensor_shape, clock)
        self.timing = Timing(self.optics, self.amplifiers)
        self.acquisition = Acquisition(self.sensor, self.timing, clock, self.faults, arm_s)
        self._is_initialized = False
        self._resettable = (self.amplifiers, self.optics, self.timing, self.acquisition)
        functions: dict[str, Function] = {}
        for part in (self, self.cooler, *self._resettable):
            functions |= functions_of(part)
        self.functions: Mapping[str, Function] = functions

    def initialize(self) -> Code:
        """Get ready; refused if another program uses the camera."""
        if self.faults.held:
            return Code.VXDNOTINSTALLED
        if self.faults.unplugged:
            return Code.ERROR_ACK
        for part in self._resettable:
            part.reset()
        self._is_initialized = True
        return Code.SUCCESS

    def shut_down(self) -> Code:
        """Release the camera."""
        if not self._is_initialized:
            return Code.NOT_INITIALIZED
        self._is_initialized = False
        self.acquisition.abort()
        self.cooler.shut_down()
        return Code.SUCCESS

    def refusal(self, function: Function) -> Code:
        """Why a call is refused now; SUCCESS if it is not."""
        if not self._is_initialized:
            return Code.NOT_INITIALIZED
        self.acquisition.proceed()
        if self.faults.unplugged:
            return Code.ERROR_ACK
        if function.only_idle and self.acquisition.is_acquiring:
            return Code.ACQUIRING
        return Code.SUCCESS

    def trigger(self, t_s: float | None = None, width_s: float = 1e-3) -> bool:
        """A pulse at the trigger input, now or at ``t_s`` of the clock; False if it started no exposure."""
        return self.acquisition.pulse(self._clock.now() if t_s is None else t_s, width_s)

    @implements("GetCapabilities")
    def _get_capabilities(self, capabilities: Any) -> None:
        caps = capabilities[0]
        caps.ulAcqModes = sum(AcqModes)
        caps.ulReadModes = caps.ulFTReadModes = READ_MODES
        caps.ulTriggerModes = sum(Triggers)
        caps.ulCameraType = IXON_ULTRA
        caps.ulPixelMode = PIXELS_OF_16_BIT
        caps.ulSetFunctions = sum(SetFunctions)
        caps.ulGetFunctions = sum(GetFunctions)
        caps.ulFeatures = sum(Features) - Features.FTEXTERNALEXPOSURE - Features.KINETICEXTERNALEXPOSURE
        caps.ulEMGainCapability = EM_GAIN_REAL


class Cooler:
    """Brings the sensor to its temperature exponentially, on the session's clock.

    Attributes:
        is_on: Whether the cooler is on.
    """

    getters: ClassVar[Mapping[str, Callable[[Any], object]]] = {
        "GetTemperatureRange": lambda _: TEMPERATURES_C,
        "IsCoolerOn": lambda self: int(self.is_on),
    }

    def __init__(self, clock: Clock, faults: Faults) -> None:
        self._clock = clock
        self._faults = faults
        self.is_on = False
        self._setpoint_c = TEMPERATURES_C[1]
        self._stays_on = False
        self._from_c, self._since_s = ROOM_C, clock.now()

    @property
    def temperature_c(self) -> float:
        """Temperature of the sensor now, in degrees Celsius."""
        passed_s = self._clock.now() - self._since_s
        left_k = (self._from_c - self._end_c) * math.exp(-passed_s / TIME_CONSTANT_S)
        return self._end_c + left_k + self._faults.drift_k

    @property
    def status(self) -> Code:
        """The SDK's status of the cooling."""
        if not self.is_on:
            return Code.TEMP_OFF
        way_k = max(abs(self._from_c - self._setpoint_c), NEAR_K)
        near_s = self._since_s + TIME_CONSTANT_S * math.log(way_k / NEAR_K)
        was_stable = self._clock.now() >= near_s + STABLE_AFTER_S and self._end_c == self._setpoint_c
        if abs(self.temperature_c - self._setpoint_c) > NEAR_K + 1e-6:
            return Code.TEMP_DRIFT if was_stable else Code.TEMP_NOT_REACHED
        return Code.TEMP_STABILIZED if was_stable else Code.TEMP_NOT_STABILIZED

    def shut_down(self) -> None:
        """Switch off when the SDK is shut down, unless SetCoolerMode says otherwise."""
        if not self._stays_on:
            self._change(is_on=False)

    @implements("SetTemperature", only_idle=True)
    def set_temperature(self, celsius: int) -> None:
        """Set the temperature that the cooler aims at."""
        require(TEMPERATURES_C[0] <= celsius <= TEMPERATURES_C[1])
        if celsius != self._setpoint_c:
            self._change(setpoint_c=celsius)

    @implements("GetTemperatureF", only_idle=True)
    def _get_temperature(self, celsius: Any) -> Code:
        celsius[0] = self.temperature_c
        return self.status

    @implements("CoolerON", only_idle=True)
    def switch_on(self) -> None:
        """Start to cool."""
        if not self.is_on:
            self._change(is_on=True)

    @implements("CoolerOFF", only_idle=True)
    def _switch_off(self) -> None:
        if self.is_on:
            self._change(is_on=False)

    @implements("SetCoolerMode", only_idle=True)
    def _set_mode(self, stays_on: int) -> None:
        """1: the cooler stays on when the SDK is shut down."""
        self._stays_on = bool(stays_on)

    @implements("SetFanMode", only_idle=True)
    def _set_fan(self, mode: int) -> None:
        """0: full, 1: low, 2: off."""
        require(0 <= mode <= 2)

    @property
    def _end_c(self) -> float:
        return max(self._setpoint_c, self._faults.coldest_c) if self.is_on else ROOM_C

    def _change(self, *, is_on: bool | None = None, setpoint_c: int | None = None) -> None:
        self._from_c, self._since_s = self.temperature_c - self._faults.drift_k, self._clock.now()
        self.is_on = self.is_on if is_on is None else is_on
        self._setpoint_c = self._setpoint_c if setpoint_c is None else setpoint_c
