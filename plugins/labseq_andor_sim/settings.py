"""Settings of the simulated camera (cooler, amplifier, EM gain, region, shutter, exposure, trigger).

Methods with names of SDK functions are these functions. They take the arguments, return the results that C
writes through pointers, and raise :class:`Refused` where the camera refuses the call.
"""

# ruff: noqa: D102, N802 - the SDK's names, which its manual explains

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, TypeVar

from labseq_andor.codes import (
    EXTERNAL,
    EXTERNAL_EXPOSURE,
    EXTERNAL_START,
    FULL_IMAGE,
    INTERNAL,
    KINETIC,
    REAL_GAIN_MODE,
    RUN_TILL_ABORT,
    SHUTTER_AUTO,
    SHUTTER_CLOSED,
    SHUTTER_OPEN,
    SOFTWARE,
    Code,
)
from labseq_andor.heads import Head, readout_s

from labseq.plugin import Clock, SensorMode
from labseq_andor_sim.faults import Faults

T = TypeVar("T")

AMPLIFIERS: Final = ("Electron Multiplying", "Conventional")
MIN_GAIN, MAX_GAIN, MAX_ADVANCED_GAIN = 2, 300, 1000
"""Real EM gains that can be set, and the largest with SetEMAdvanced (ours, as cameras of this kind)."""
CLOSING_MS, OPENING_MS = 20, 27
"""Times that the shutter takes to close and to open (ours, as cameras of this kind)."""
MIN_EXPOSURE_S, MAX_EXPOSURE_S = 10e-6, 1000.0
"""Shortest exposure without frame transfer, and longest (ours). With it, the shortest is the read-out."""
ENDLESS: Final = 2**31

ROOM_C: Final = 20.0
COLDEST_SETPOINT_C, WARMEST_SETPOINT_C = -120, 20
"""Temperatures that can be set (ours)."""
TIME_CONSTANT_S: Final = 60.0
"""Time constant with which the sensor reaches its temperature (ours)."""
NEAR_K: Final = 1.0
"""Largest deviation from the temperature that counts as reached (ours)."""
STABLE_AFTER_S: Final = 30.0
"""How long it must have been reached until the camera reports it as stabilized (ours)."""


class Refused(Exception):  # noqa: N818 - it is a return code of the SDK, not an error of labseq
    """An SDK function refuses a call, with this return code."""

    def __init__(self, code: Code) -> None:
        self.code = code
        super().__init__(code)


def require(is_valid: object, code: Code = Code.P1INVALID) -> None:
    """Refuse a call unless a condition holds."""
    if not is_valid:
        raise Refused(code)


def pick(values: Sequence[T], index: int, code: Code = Code.P1INVALID) -> T:
    """One of some values. Refuses an index that is out of range."""
    require(0 <= index < len(values), code)
    return values[index]


class Cooler:
    """Brings the sensor to its temperature exponentially, on the session's clock.

    Attributes:
        is_on: Whether the cooler is on.
    """

    def __init__(self, clock: Clock, faults: Faults) -> None:
        self._clock = clock
        self._faults = faults
        self.is_on = False
        self._setpoint_c = WARMEST_SETPOINT_C
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

    def GetTemperatureRange(self) -> tuple[int, int]:
        return COLDEST_SETPOINT_C, WARMEST_SETPOINT_C

    def SetTemperature(self, celsius: int) -> None:
        require(COLDEST_SETPOINT_C <= celsius <= WARMEST_SETPOINT_C)
        if celsius != self._setpoint_c:
            self._change(setpoint_c=celsius)

    def GetTemperatureF(self) -> float:
        return self.temperature_c

    def CoolerON(self) -> None:
        if not self.is_on:
            self._change(is_on=True)

    def CoolerOFF(self) -> None:
        if self.is_on:
            self._change(is_on=False)

    def SetCoolerMode(self, stays_on: int) -> None:
        """Mode 1 keeps the cooler on when the SDK is shut down."""
        self._stays_on = bool(stays_on)

    def SetFanMode(self, mode: int) -> None:
        """Mode 0 is full, 1 low, 2 off."""
        require(0 <= mode <= 2)

    @property
    def _end_c(self) -> float:
        return max(self._setpoint_c, self._faults.coldest_c) if self.is_on else ROOM_C

    def _change(self, *, is_on: bool | None = None, setpoint_c: int | None = None) -> None:
        self._from_c, self._since_s = self.temperature_c - self._faults.drift_k, self._clock.now()
        self.is_on = self.is_on if is_on is None else is_on
        self._setpoint_c = self._setpoint_c if setpoint_c is None else setpoint_c


class Amplifiers:
    """Amplifiers, read-out rates, shift speeds, pre-amplifier, EM gain, offset.

    Attributes:
        is_em: Whether the amplifier behind the EM register is used.
        rate_hz: Pixels per second.
        shift_s: Time to shift the rows by one, in seconds.
        em_gain: EM gain as it was set, 0 for none.
    """

    def __init__(self, head: Head) -> None:
        self._head = head
        self._rates_hz = (head.em_rates_hz, head.conventional_rates_hz)
        self.reset()

    def reset(self) -> None:
        """Set the defaults, as Initialize does."""
        self.is_em = True
        self.rate_hz, self.shift_s = self._rates_hz[0][0], self._head.shifts_s[0]
        self.em_gain = self._gain_mode = 0
        self._is_advanced = False

    def GetNumberADChannels(self) -> int:
        return 1

    def SetADChannel(self, channel: int) -> None:
        require(channel == 0)

    def GetBitDepth(self, channel: int) -> int:
        require(channel == 0)
        return 16

    def GetNumberAmp(self) -> int:
        return len(AMPLIFIERS)

    def GetAmpDesc(self, index: int) -> str:
        return pick(AMPLIFIERS, index)

    def SetOutputAmplifier(self, index: int) -> None:
        """Choose the amplifier, with its fastest rate until another is chosen."""
        pick(AMPLIFIERS, index)
        self.is_em, self.rate_hz = index == 0, self._rates_hz[index][0]

    def GetNumberHSSpeeds(self, channel: int, amplifier: int) -> int:
        require(channel == 0)
        return len(pick(self._rates_hz, amplifier, Code.P2INVALID))

    def GetHSSpeed(self, channel: int, amplifier: int, index: int) -> float:
        """A read-out rate, in MHz."""
        require(channel == 0)
        return pick(pick(self._rates_hz, amplifier, Code.P2INVALID), index, Code.P3INVALID) / 1e6

    def SetHSSpeed(self, amplifier: int, index: int) -> None:
        require(amplifier == (0 if self.is_em else 1))
        self.rate_hz = pick(self._rates_hz[amplifier], index, Code.P2INVALID)

    def GetNumberVSSpeeds(self) -> int:
        return len(self._head.shifts_s)

    def GetVSSpeed(self, index: int) -> float:
        """A shift speed, in microseconds."""
        return pick(self._head.shifts_s, index) * 1e6

    def GetFastestRecommendedVSSpeed(self) -> tuple[int, float]:
        """Number of the speed, and the speed in microseconds."""
        return self._head.recommended_shift, self.GetVSSpeed(self._head.recommended_shift)

    def SetVSSpeed(self, index: int) -> None:
        self.shift_s = pick(self._head.shifts_s, index)

    def GetNumberPreAmpGains(self) -> int:
        return len(self._head.preamp_gains)

    def GetPreAmpGain(self, index: int) -> float:
        return pick(self._head.preamp_gains, index)

    def IsPreAmpGainAvailable(self, _channel: int, _amplifier: int, _rate: int, index: int) -> int:
        """Every gain is available with every rate."""
        return int(index in range(len(self._head.preamp_gains)))

    def SetPreAmpGain(self, index: int) -> None:
        """Has no effect on the pictures."""
        pick(self._head.preamp_gains, index)

    def SetBaselineClamp(self, state: int) -> None:
        """Has no effect, since the offset is stable."""
        require(state in (0, 1))

    def SetEMGainMode(self, mode: int) -> None:
        """Mode 0 is steps of a converter, which are not modelled, and 3 real gain."""
        require(mode in (0, REAL_GAIN_MODE))
        self._gain_mode, self.em_gain = mode, 0

    def SetEMAdvanced(self, state: int) -> None:
        """Allow high gains, at which the register ages fast."""
        self._is_advanced = bool(state)

    def GetEMGainRange(self) -> tuple[int, int]:
        if self._gain_mode != REAL_GAIN_MODE:
            return 0, 255
        return MIN_GAIN, MAX_ADVANCED_GAIN if self._is_advanced else MAX_GAIN

    def SetEMCCDGain(self, gain: int) -> None:
        """Set the gain. 0 is off, the only value outside of real gain."""
        low, high = self.GetEMGainRange()
        require(gain == 0 or (self._gain_mode == REAL_GAIN_MODE and low <= gain <= high))
        self.em_gain = gain


class Optics:
    """Region, binning, isolated crop, frame transfer, shutter.

    Attributes:
        sensor_shape: (height, width) of the sensor.
        frame_transfer: Whether the next frame is exposed while one is read.
        is_cropped: Whether the camera ignores the sensor outside the region.
        reads_images: Whether images are read, rather than tracks.
        shutter: Mode of the shutter.
    """

    def __init__(self, sensor_shape: tuple[int, int], clock: Clock) -> None:
        self.sensor_shape = sensor_shape
        self._clock = clock
        self.reset()

    def reset(self) -> None:
        """Set the defaults, as Initialize does."""
        self.frame_transfer = self.is_cropped = self.reads_images = False
        self.shutter = SHUTTER_CLOSED
        self._opened_s = 0.0
        self._region, self._binning = (0, 0, *self.sensor_shape), 1

    def mode(self, em_gain: float) -> SensorMode:
        """Mode in which the sensor is exposed at this moment."""
        region = None if self._region == (0, 0, *self.sensor_shape) else self._region
        is_opened = self._clock.now() >= self._opened_s + OPENING_MS / 1e3 - 1e-9
        is_open = self.shutter == SHUTTER_AUTO or (self.shutter == SHUTTER_OPEN and is_opened)
        return SensorMode(region, self._binning, em_gain, is_open)

    @property
    def frame_shape(self) -> tuple[int, int]:
        """(height, width) of a frame."""
        return self._region[2] // self._binning, self._region[3] // self._binning

    def GetDetector(self) -> tuple[int, int]:
        """Width and height of the sensor, or of the region in isolated crop."""
        height, width = self._region[2:] if self.is_cropped else self.sensor_shape
        return width, height

    def SetReadMode(self, mode: int) -> None:
        """Mode 4 is images. The other modes can be chosen, but not acquired."""
        require(mode in range(FULL_IMAGE + 1))
        self.reads_images = mode == FULL_IMAGE

    def SetImage(self, hbin: int, vbin: int, left: int, right: int, bottom: int, top: int) -> None:
        """Set the region, ends included, counted from 1, with equal binning along both axes."""
        height, width = self.sensor_shape
        require(hbin >= 1)
        require(vbin == hbin, Code.P2INVALID)
        require(1 <= left <= right, Code.P3INVALID)
        require(right <= width and (right - left + 1) % hbin == 0, Code.P4INVALID)
        require(1 <= bottom <= top, Code.P5INVALID)
        require(top <= height and (top - bottom + 1) % hbin == 0, Code.P6INVALID)
        self._region = (bottom - 1, left - 1, top - bottom + 1, right - left + 1)
        self._binning, self.is_cropped = hbin, False

    def SetIsolatedCropModeEx(
        self, active: int, height: int, width: int, vbin: int, hbin: int, left: int, bottom: int
    ) -> None:
        """Crop the sensor, only with frame transfer."""
        if active:
            require(self.frame_transfer, Code.INVALID_MODE)
            self.SetImage(hbin, vbin, left, left + width - 1, bottom, bottom + height - 1)
        self.is_cropped = bool(active)

    def SetFrameTransferMode(self, state: int) -> None:
        self.frame_transfer = bool(state)

    def GetShutterMinTimes(self) -> tuple[int, int]:
        """Times to close and to open, in milliseconds."""
        return CLOSING_MS, OPENING_MS

    def SetShutter(self, level: int, mode: int, closing_ms: int, opening_ms: int) -> None:
        require(level in (0, 1))
        require(mode in (SHUTTER_AUTO, SHUTTER_OPEN, SHUTTER_CLOSED), Code.P2INVALID)
        require(min(closing_ms, opening_ms) >= 0, Code.P3INVALID)
        if mode == SHUTTER_OPEN and self.shutter != SHUTTER_OPEN:
            self._opened_s = self._clock.now()
        self.shutter = mode


class Timing:
    """Exposure, read-out and cycle times, acquisition mode and trigger.

    Attributes:
        trigger: Mode of the trigger, such as INTERNAL.
        optics: Region and frame transfer, which the times depend on.
    """

    def __init__(self, optics: Optics, amplifiers: Amplifiers) -> None:
        self.optics, self._amplifiers = optics, amplifiers
        self.reset()

    def reset(self) -> None:
        """Set the defaults, as Initialize does."""
        self._exposure_s, self._cycle_s = 0.1, 0.0
        self.trigger = INTERNAL
        self._mode = self._n_kinetics = 1

    @property
    def sensor_mode(self) -> SensorMode:
        """Mode in which the sensor is exposed and read."""
        return self.optics.mode(float(max(1, self._amplifiers.em_gain)) if self._amplifiers.is_em else 1.0)

    @property
    def readout_s(self) -> float:
        """Time from the end of an exposure to its frame, in seconds."""
        amplifiers, is_cropped = self._amplifiers, self.optics.is_cropped
        rate_hz, shift_s, shape = amplifiers.rate_hz, amplifiers.shift_s, self.optics.sensor_shape
        return readout_s(rate_hz, shift_s, shape, self.sensor_mode, isolated_crop=is_cropped)

    @property
    def exposure_s(self) -> float:
        """Exposure as the camera makes it, in seconds."""
        return max(self._exposure_s, self.readout_s if self.optics.frame_transfer else MIN_EXPOSURE_S)

    @property
    def kinetic_s(self) -> float:
        """Time from one exposure to the next with the internal trigger, in seconds."""
        shortest_s = self.exposure_s + (0.0 if self.optics.frame_transfer else self.readout_s)
        return max(shortest_s, self._cycle_s)

    @property
    def runs_till_abort(self) -> bool:
        """Whether the series has no end."""
        return self._mode == RUN_TILL_ABORT

    @property
    def n_frames(self) -> int:
        """Frames of a series."""
        return {KINETIC: self._n_kinetics, RUN_TILL_ABORT: ENDLESS}.get(self._mode, 1)

    def GetReadOutTime(self) -> float:
        return self.readout_s

    def GetMaximumExposure(self) -> float:
        return MAX_EXPOSURE_S

    def SetExposureTime(self, seconds: float) -> None:
        require(0 <= seconds <= MAX_EXPOSURE_S)
        self._exposure_s = seconds

    def SetKineticCycleTime(self, seconds: float) -> None:
        """Set the time from one exposure to the next. Shorter times than possible have no effect."""
        require(seconds >= 0)
        self._cycle_s = seconds

    def GetAcquisitionTimings(self) -> tuple[float, float, float]:
        """Exposure, accumulation and cycle times, in seconds."""
        return self.exposure_s, self.kinetic_s, self.kinetic_s

    def SetAcquisitionMode(self, mode: int) -> None:
        """Mode 1 is single, 2 accumulate, 3 kinetic, 5 run till abort."""
        require(mode in (1, 2, KINETIC, RUN_TILL_ABORT))
        self._mode = mode

    def SetNumberKinetics(self, number: int) -> None:
        require(number >= 1)
        self._n_kinetics = number

    def SetNumberAccumulations(self, number: int) -> None:
        """Accumulation is not modelled."""
        require(number == 1)

    def SetTriggerMode(self, mode: int) -> None:
        require(mode in (INTERNAL, EXTERNAL, EXTERNAL_START, EXTERNAL_EXPOSURE, SOFTWARE))
        self.trigger = mode

    def SetTriggerInvert(self, mode: int) -> None:
        """Has no effect, since a simulated pulse has both edges."""
        require(mode in (0, 1))

    def SetFastExtTrigger(self, mode: int) -> None:
        """Has no effect, since the sensor has no cleaning cycle."""
        require(mode in (0, 1))

    def SetMetaData(self, state: int) -> None:
        """Has no effect, since there are always time stamps."""
        require(state in (0, 1))
