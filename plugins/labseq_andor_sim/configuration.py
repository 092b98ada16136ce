"""What can be set at the simulated camera: amplifier, EM gain, region, shutter, exposure, trigger."""

from __future__ import annotations

from typing import Any, Final

from labseq_andor.codes import (
    FULL_IMAGE,
    REAL_GAIN_MODE,
    SHUTTER_AUTO,
    SHUTTER_CLOSED,
    SHUTTER_OPEN,
    Code,
)
from labseq_andor.heads import Head, readout_s

from labseq.plugin import Clock, SensorMode
from labseq_andor_sim.functions import check_index, implements, write_text

AMPLIFIERS: Final = ("Electron Multiplying", "Conventional")
BIT_DEPTH: Final = 16
MIN_GAIN, MAX_GAIN, MAX_ADVANCED_GAIN = 2, 300, 1000
"""Real EM gains that can be set, and the largest with SetEMAdvanced (ours, as cameras of this kind)."""
SHUTTER_MS: Final = 27
"""Time that the shutter takes to open or close (ours, as cameras of this kind)."""
MIN_EXPOSURE_S: Final = 10e-6
"""Shortest exposure without frame transfer; with it, that is the read-out (ours)."""
MAX_EXPOSURE_S: Final = 1000.0
"""Longest exposure (ours)."""
INTERNAL, EXTERNAL, SOFTWARE = 0, 1, 10
"""Modes of ``SetTriggerMode``."""
KINETIC, RUN_TILL_ABORT = 3, 5
"""Modes of ``SetAcquisitionMode``."""
ENDLESS: Final = 2**31


class Amplifiers:
    """Amplifiers, read-out rates, shift speeds, pre-amplifier, EM gain, offset.

    Attributes:
        is_em: Whether the amplifier behind the EM register is used.
        em_gain: EM gain as it was set; 0 for none.
        baseline_clamp: Whether the offset is stabilized.
    """

    def __init__(self, head: Head) -> None:
        self._head = head
        self._rates_hz = (head.em_rates_hz, head.conventional_rates_hz)
        self.reset()

    def reset(self) -> None:
        """Set the defaults, as Initialize does."""
        self._amplifier = self._rate = self._shift = self._preamp = 0
        self.baseline_clamp = False
        self.em_gain = self._gain_mode = 0
        self._is_advanced = False

    @property
    def is_em(self) -> bool:
        """Whether the amplifier behind the EM register is used."""
        return self._amplifier == 0

    @property
    def rate_hz(self) -> float:
        """Pixels per second."""
        return self._rates_hz[self._amplifier][self._rate]

    @property
    def shift_s(self) -> float:
        """Time to shift the rows by one, in seconds."""
        return self._head.shifts_s[self._shift]

    @property
    def preamp_gain(self) -> float:
        """Gain of the pre-amplifier."""
        return self._head.preamp_gains[self._preamp]

    @implements("GetNumberADChannels", outputs=1)
    def _get_n_channels(self) -> tuple[int]:
        return (1,)

    @implements("SetADChannel", only_idle=True)
    def _set_channel(self, channel: int) -> Code:
        return check_index(channel, (0,))

    @implements("GetBitDepth", outputs=1)
    def _get_bit_depth(self, channel: int) -> Code | tuple[int]:
        return Code.P1INVALID if channel != 0 else (BIT_DEPTH,)

    @implements("GetNumberAmp", outputs=1)
    def _get_n_amplifiers(self) -> tuple[int]:
        return (len(AMPLIFIERS),)

    @implements("GetAmpDesc")
    def _get_amplifier_name(self, index: int, text: int, length: int) -> Code:
        code = check_index(index, AMPLIFIERS)
        return write_text(text, AMPLIFIERS[index], length) if code == Code.SUCCESS else code

    @implements("SetOutputAmplifier", only_idle=True)
    def _set_amplifier(self, index: int) -> Code:
        """Choose the amplifier, with its fastest rate until another is chosen."""
        code = check_index(index, AMPLIFIERS)
        if code == Code.SUCCESS and index != self._amplifier:
            self._amplifier, self._rate = index, 0
        return code

    @implements("GetNumberHSSpeeds", outputs=1)
    def _get_n_rates(self, channel: int, amplifier: int) -> Code | tuple[int]:
        if channel != 0:
            return Code.P1INVALID
        return (len(self._rates_hz[amplifier]),) if amplifier in (0, 1) else Code.P2INVALID

    @implements("GetHSSpeed", outputs=1)
    def _get_rate(self, channel: int, amplifier: int, index: int) -> Code | tuple[float]:
        if channel != 0 or amplifier not in (0, 1):
            return Code.P1INVALID if channel else Code.P2INVALID
        rates_hz = self._rates_hz[amplifier]
        code = check_index(index, rates_hz, Code.P3INVALID)
        return (rates_hz[index] / 1e6,) if code == Code.SUCCESS else code

    @implements("SetHSSpeed", only_idle=True)
    def _set_rate(self, amplifier: int, index: int) -> Code:
        if amplifier not in (0, 1):
            return Code.P1INVALID
        code = check_index(index, self._rates_hz[amplifier], Code.P2INVALID)
        self._rate = index if code == Code.SUCCESS else self._rate
        return code

    @implements("GetNumberVSSpeeds", outputs=1)
    def _get_n_shifts(self) -> tuple[int]:
        return (len(self._head.shifts_s),)

    @implements("GetVSSpeed", outputs=1)
    def _get_shift(self, index: int) -> Code | tuple[float]:
        code = check_index(index, self._head.shifts_s)
        return (self._head.shifts_s[index] * 1e6,) if code == Code.SUCCESS else code

    @implements("GetFastestRecommendedVSSpeed", outputs=2)
    def _get_recommended_shift(self) -> tuple[int, float]:
        index = self._head.recommended_shift
        return index, self._head.shifts_s[index] * 1e6

    @implements("SetVSSpeed", only_idle=True)
    def _set_shift(self, index: int) -> Code:
        code = check_index(index, self._head.shifts_s)
        self._shift = index if code == Code.SUCCESS else self._shift
        return code

    @implements("GetNumberPreAmpGains", outputs=1)
    def _get_n_preamp_gains(self) -> tuple[int]:
        return (len(self._head.preamp_gains),)

    @implements("GetPreAmpGain", outputs=1)
    def _get_preamp_gain(self, index: int) -> Code | tuple[float]:
        code = check_index(index, self._head.preamp_gains)
        return (self._head.preamp_gains[index],) if code == Code.SUCCESS else code

    @implements("IsPreAmpGainAvailable", outputs=1)
    def _is_preamp_gain_available(self, *place: int) -> tuple[int]:
        """Every gain is available with every rate; ``place`` ends with the gain's index."""
        return (int(check_index(place[-1], self._head.preamp_gains) == Code.SUCCESS),)

    @implements("SetPreAmpGain", only_idle=True)
    def _set_preamp_gain(self, index: int) -> Code:
        code = check_index(index, self._head.preamp_gains)
        self._preamp = index if code == Code.SUCCESS else self._preamp
        return code

    @implements("SetBaselineClamp", only_idle=True)
    def _set_baseline_clamp(self, state: int) -> Code:
        self.baseline_clamp = bool(state)
        return Code.SUCCESS

    @implements("GetBaselineClamp", outputs=1)
    def _get_baseline_clamp(self) -> tuple[int]:
        return (int(self.baseline_clamp),)

    @implements("SetEMGainMode", only_idle=True)
    def _set_gain_mode(self, mode: int) -> Code:
        """0: steps of a converter, which are not modelled; 3: real gain."""
        if mode not in (0, REAL_GAIN_MODE):
            return Code.P1INVALID
        self._gain_mode, self.em_gain = mode, 0
        return Code.SUCCESS

    @implements("SetEMAdvanced", only_idle=True)
    def _set_advanced(self, state: int) -> Code:
        self._is_advanced = bool(state)
        if not state:
            self.em_gain = min(self.em_gain, MAX_GAIN)
        return Code.SUCCESS

    @implements("GetEMAdvanced", outputs=1)
    def _get_advanced(self) -> tuple[int]:
        return (int(self._is_advanced),)

    @implements("GetEMGainRange", outputs=2)
    def _get_gain_range(self) -> tuple[int, int]:
        if self._gain_mode != REAL_GAIN_MODE:
            return 0, 255
        return MIN_GAIN, MAX_ADVANCED_GAIN if self._is_advanced else MAX_GAIN

    @implements("SetEMCCDGain", only_idle=True)
    def _set_gain(self, gain: int) -> Code:
        """Set the gain; 0: off, the only value outside of real gain."""
        low, high = self._get_gain_range()
        if gain != 0 and (self._gain_mode != REAL_GAIN_MODE or not low <= gain <= high):
            return Code.P1INVALID
        self.em_gain = gain
        return Code.SUCCESS

    @implements("GetEMCCDGain", outputs=1)
    def _get_gain(self) -> tuple[int]:
        return (self.em_gain,)


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
        """How the sensor is exposed at this moment."""
        region = None if self._region == (0, 0, *self.sensor_shape) else self._region
        opened_s = self._opened_s + SHUTTER_MS / 1e3 - 1e-9
        is_open = self.shutter == SHUTTER_AUTO or (
            self.shutter == SHUTTER_OPEN and self._clock.now() >= opened_s
        )
        return SensorMode(region, self._binning, em_gain, is_open)

    @property
    def frame_shape(self) -> tuple[int, int]:
        """(height, width) of a frame."""
        return self._region[2] // self._binning, self._region[3] // self._binning

    @implements("GetDetector", outputs=2)
    def _get_detector(self) -> tuple[int, int]:
        """Width and height of the sensor; of the region in isolated crop."""
        height, width = self._region[2:] if self.is_cropped else self.sensor_shape
        return width, height

    @implements("SetReadMode", only_idle=True)
    def _set_read_mode(self, mode: int) -> Code:
        """4: images. The other modes can be chosen, but not acquired."""
        if mode not in range(FULL_IMAGE + 1):
            return Code.P1INVALID
        self.reads_images = mode == FULL_IMAGE
        return Code.SUCCESS

    @implements("SetSingleTrack", "SetMultiTrack", "SetRandomTracks", only_idle=True)
    def _set_tracks(self, *_places: Any) -> Code:
        """No effect: tracks are not modelled, but pylablib sets them when it opens a camera."""
        return Code.SUCCESS

    @implements("SetImage", only_idle=True)
    def set_image(self, hbin: int, vbin: int, left: int, right: int, bottom: int, top: int) -> Code:
        """Set the region, ends included, counted from 1; equal binning along both axes."""
        height, width = self.sensor_shape
        valid = (
            hbin >= 1,
            vbin == hbin,
            1 <= left <= right,
            right <= width and hbin >= 1 and (right - left + 1) % hbin == 0,
            1 <= bottom <= top,
            top <= height and hbin >= 1 and (top - bottom + 1) % hbin == 0,
        )
        codes = (
            Code.P1INVALID,
            Code.P2INVALID,
            Code.P3INVALID,
            Code.P4INVALID,
            Code.P5INVALID,
            Code.P6INVALID,
        )
        if not all(valid):
            return codes[valid.index(False)]
        self._region = (bottom - 1, left - 1, top - bottom + 1, right - left + 1)
        self._binning, self.is_cropped = hbin, False
        return Code.SUCCESS

    @implements("SetIsolatedCropModeEx", only_idle=True)
    def _set_isolated_crop(
        self, active: int, height: int, width: int, vbin: int, hbin: int, left: int, bottom: int
    ) -> Code:
        """Crop the sensor; only with frame transfer."""
        if active and not self.frame_transfer:
            return Code.INVALID_MODE
        if active and self.set_image(hbin, vbin, left, left + width - 1, bottom, bottom + height - 1) != (
            Code.SUCCESS
        ):
            return Code.P2INVALID
        self.is_cropped = bool(active)
        return Code.SUCCESS

    @implements("SetFrameTransferMode", only_idle=True)
    def _set_frame_transfer(self, state: int) -> Code:
        self.frame_transfer = bool(state)
        return Code.SUCCESS

    @implements("IsInternalMechanicalShutter", outputs=1)
    def _has_shutter(self) -> tuple[int]:
        return (1,)

    @implements("GetShutterMinTimes", outputs=2)
    def _get_shutter_times(self) -> tuple[int, int]:
        return SHUTTER_MS, SHUTTER_MS

    @implements("SetShutter", only_idle=True)
    def _set_shutter(self, level: int, mode: int, closing_ms: int, opening_ms: int) -> Code:
        if level not in (0, 1):
            return Code.P1INVALID
        if mode not in (SHUTTER_AUTO, SHUTTER_OPEN, SHUTTER_CLOSED):
            return Code.P2INVALID
        if min(closing_ms, opening_ms) < 0:
            return Code.P3INVALID
        if mode == SHUTTER_OPEN and self.shutter != SHUTTER_OPEN:
            self._opened_s = self._clock.now()
        self.shutter = mode
        return Code.SUCCESS


class Timing:
    """Exposure, read-out and cycle times; acquisition mode and trigger.

    Attributes:
        trigger: Mode of the trigger: INTERNAL, EXTERNAL or SOFTWARE.
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
        """How the sensor is exposed and read."""
        return self.optics.mode(float(max(1, self._amplifiers.em_gain)) if self._amplifiers.is_em else 1.0)

    @property
    def readout_s(self) -> float:
        """From the end of an exposure to its frame, in seconds."""
        return readout_s(
            self._amplifiers.rate_hz,
            self._amplifiers.shift_s,
            self.optics.sensor_shape,
            self.sensor_mode,
            isolated_crop=self.optics.is_cropped,
        )

    @property
    def exposure_s(self) -> float:
        """Exposure as the camera makes it, in seconds."""
        return max(self._exposure_s, self.readout_s if self.optics.frame_transfer else MIN_EXPOSURE_S)

    @property
    def kinetic_s(self) -> float:
        """From one exposure to the next with the internal trigger, in seconds."""
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

    @implements("SetExposureTime", only_idle=True)
    def _set_exposure(self, seconds: float) -> Code:
        if not 0 <= seconds <= MAX_EXPOSURE_S:
            return Code.P1INVALID
        self._exposure_s = seconds
        return Code.SUCCESS

    @implements("GetMaximumExposure", outputs=1)
    def _get_max_exposure(self) -> tuple[float]:
        return (MAX_EXPOSURE_S,)

    @implements("SetKineticCycleTime", only_idle=True)
    def _set_cycle(self, seconds: float) -> Code:
        self._cycle_s = seconds
        return Code.SUCCESS if seconds >= 0 else Code.P1INVALID

    @implements("SetAccumulationCycleTime", only_idle=True)
    def _set_accumulation_cycle(self, seconds: float) -> Code:
        """No effect: accumulation is not modelled."""
        return Code.SUCCESS if seconds >= 0 else Code.P1INVALID

    @implements("GetAcquisitionTimings", outputs=3)
    def _get_timings(self) -> tuple[float, float, float]:
        return self.exposure_s, self.kinetic_s, self.kinetic_s

    @implements("GetReadOutTime", outputs=1)
    def _get_readout(self) -> tuple[float]:
        return (self.readout_s,)

    @implements("SetAcquisitionMode", only_idle=True)
    def _set_mode(self, mode: int) -> Code:
        """1: single, 2: accumulate, 3: kinetic, 5: run till abort."""
        if mode not in (1, 2, KINETIC, RUN_TILL_ABORT):
            return Code.P1INVALID
        self._mode = mode
        return Code.SUCCESS

    @implements("SetNumberKinetics", only_idle=True)
    def _set_n_kinetics(self, number: int) -> Code:
        if number < 1:
            return Code.P1INVALID
        self._n_kinetics = number
        return Code.SUCCESS

    @implements("SetNumberAccumulations", only_idle=True)
    def _set_n_accumulations(self, number: int) -> Code:
        return Code.SUCCESS if number == 1 else Code.P1INVALID

    @implements("SetTriggerMode", only_idle=True)
    def _set_trigger(self, mode: int) -> Code:
        if mode not in (INTERNAL, EXTERNAL, SOFTWARE):
            return Code.P1INVALID
        self.trigger = mode
        return Code.SUCCESS

    @implements("SetTriggerInvert", "SetFastExtTrigger", only_idle=True)
    def _set_edge(self, mode: int) -> Code:
        """No effect: a simulated pulse has both edges, and the sensor has no cleaning cycle."""
        return Code.SUCCESS if mode in (0, 1) else Code.P1INVALID

    @implements("GetTriggerLevelRange")
    def _get_levels(self, *_pointers: Any) -> Code:
        return Code.NOT_SUPPORTED
