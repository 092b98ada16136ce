"""What can be set at the simulated camera: amplifier, EM gain, region, shutter, exposure, trigger."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final

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
from labseq_andor_sim.functions import implements, pick, require, write_text

AMPLIFIERS: Final = ("Electron Multiplying", "Conventional")
BIT_DEPTH: Final = 16
MIN_GAIN, MAX_GAIN, MAX_ADVANCED_GAIN = 2, 300, 1000
"""Real EM gains that can be set, and the largest with SetEMAdvanced (ours, as cameras of this kind)."""
SHUTTER_MS: Final = 27
CLOSING_MS: Final = 20
"""Time that the shutter takes to open, and to close (ours, as cameras of this kind)."""
MIN_EXPOSURE_S: Final = 10e-6
"""Shortest exposure without frame transfer; with it, that is the read-out (ours)."""
MAX_EXPOSURE_S: Final = 1000.0
"""Longest exposure (ours)."""
INTERNAL, EXTERNAL, EXTERNAL_START, EXTERNAL_EXPOSURE, SOFTWARE = 0, 1, 6, 7, 10
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

    getters: ClassVar[Mapping[str, Callable[[Any], object]]] = {
        "GetNumberADChannels": lambda _: 1,
        "GetNumberAmp": lambda _: len(AMPLIFIERS),
        "GetNumberVSSpeeds": lambda self: len(self._head.shifts_s),
        "GetFastestRecommendedVSSpeed": lambda self: self._recommended_shift,
        "GetNumberPreAmpGains": lambda self: len(self._head.preamp_gains),
        "GetEMGainRange": lambda self: self._gain_range,
    }

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

    @property
    def _recommended_shift(self) -> tuple[int, float]:
        index = self._head.recommended_shift
        return index, self._head.shifts_s[index] * 1e6

    @property
    def _gain_range(self) -> tuple[int, int]:
        if self._gain_mode != REAL_GAIN_MODE:
            return 0, 255
        return MIN_GAIN, MAX_ADVANCED_GAIN if self._is_advanced else MAX_GAIN

    @implements("SetADChannel", only_idle=True)
    def _set_channel(self, channel: int) -> None:
        require(channel == 0)

    @implements("GetBitDepth", outputs=1)
    def _get_bit_depth(self, channel: int) -> int:
        require(channel == 0)
        return BIT_DEPTH

    @implements("GetAmpDesc")
    def _get_amplifier_name(self, index: int, text: int, length: int) -> None:
        write_text(text, pick(AMPLIFIERS, index), length)

    @implements("SetOutputAmplifier", only_idle=True)
    def _set_amplifier(self, index: int) -> None:
        """Choose the amplifier, with its fastest rate until another is chosen."""
        pick(AMPLIFIERS, index)
        if index != self._amplifier:
            self._amplifier, self._rate = index, 0

    @implements("GetNumberHSSpeeds", outputs=1)
    def _get_n_rates(self, channel: int, amplifier: int) -> int:
        require(channel == 0)
        return len(pick(self._rates_hz, amplifier, Code.P2INVALID))

    @implements("GetHSSpeed", outputs=1)
    def _get_rate(self, channel: int, amplifier: int, index: int) -> float:
        require(channel == 0)
        return pick(pick(self._rates_hz, amplifier, Code.P2INVALID), index, Code.P3INVALID) / 1e6

    @implements("SetHSSpeed", only_idle=True)
    def _set_rate(self, amplifier: int, index: int) -> None:
        pick(pick(self._rates_hz, amplifier), index, Code.P2INVALID)
        self._rate = index

    @implements("GetVSSpeed", outputs=1)
    def _get_shift(self, index: int) -> float:
        return pick(self._head.shifts_s, index) * 1e6

    @implements("SetVSSpeed", only_idle=True)
    def _set_shift(self, index: int) -> None:
        pick(self._head.shifts_s, index)
        self._shift = index

    @implements("GetPreAmpGain", outputs=1)
    def _get_preamp_gain(self, index: int) -> float:
        return pick(self._head.preamp_gains, index)

    @implements("IsPreAmpGainAvailable", outputs=1)
    def _is_preamp_gain_available(self, *place: int) -> int:
        """Every gain is available with every rate; ``place`` ends with the gain's index."""
        return int(place[-1] in range(len(self._head.preamp_gains)))

    @implements("SetPreAmpGain", only_idle=True)
    def _set_preamp_gain(self, index: int) -> None:
        pick(self._head.preamp_gains, index)
        self._preamp = index

    @implements("SetBaselineClamp", only_idle=True)
    def _set_baseline_clamp(self, state: int) -> None:
        self.baseline_clamp = bool(state)

    @implements("SetEMGainMode", only_idle=True)
    def _set_gain_mode(self, mode: int) -> None:
        """0: steps of a converter, which are not modelled; 3: real gain."""
        require(mode in (0, REAL_GAIN_MODE))
        self._gain_mode, self.em_gain = mode, 0

    @implements("SetEMAdvanced", only_idle=True)
    def _set_advanced(self, state: int) -> None:
        self._is_advanced = bool(state)
        if not state:
            self.em_gain = min(self.em_gain, MAX_GAIN)

    @implements("SetEMCCDGain", only_idle=True)
    def _set_gain(self, gain: int) -> None:
        """Set the gain; 0: off, the only value outside of real gain."""
        low, high = self._gain_range
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

    getters: ClassVar[Mapping[str, Callable[[Any], object]]] = {
        "GetDetector": lambda self: self._detector[::-1],
        "GetShutterMinTimes": lambda _: (CLOSING_MS, SHUTTER_MS),
    }

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

    @property
    def _detector(self) -> tuple[int, int]:
        """(height, width) of the sensor; of the region in isolated crop."""
        return self._region[2:] if self.is_cropped else self.sensor_shape

    @implements("SetReadMode", only_idle=True)
    def _set_read_mode(self, mode: int) -> None:
        """4: images. The other modes can be chosen, but not acquired."""
        require(mode in range(FULL_IMAGE + 1))
        self.reads_images = mode == FULL_IMAGE

    @implements("SetSingleTrack", "SetMultiTrack", "SetRandomTracks", only_idle=True)
    def _set_tracks(self, *_places: Any) -> None:
        """No effect: tracks are not modelled, but pylablib sets them when it opens a camera."""

    @implements("SetImage", only_idle=True)
    def set_image(self, hbin: int, vbin: int, left: int, right: int, bottom: int, top: int) -> None:
        """Set the region, ends included, counted from 1; equal binning along both axes."""
        height, width = self.sensor_shape
        require(hbin >= 1)
        require(vbin == hbin, Code.P2INVALID)
        require(1 <= left <= right, Code.P3INVALID)
        require(right <= width and (right - left + 1) % hbin == 0, Code.P4INVALID)
        require(1 <= bottom <= top, Code.P5INVALID)
        require(top <= height and (top - bottom + 1) % hbin == 0, Code.P6INVALID)
        self._region = (bottom - 1, left - 1, top - bottom + 1, right - left + 1)
        self._binning, self.is_cropped = hbin, False

    @implements("SetIsolatedCropModeEx", only_idle=True)
    def _set_isolated_crop(
        self, active: int, height: int, width: int, vbin: int, hbin: int, left: int, bottom: int
    ) -> None:
        """Crop the sensor; only with frame transfer."""
        if active:
            require(self.frame_transfer, Code.INVALID_MODE)
            self.set_image(hbin, vbin, left, left + width - 1, bottom, bottom + height - 1)
        self.is_cropped = bool(active)

    @implements("SetFrameTransferMode", only_idle=True)
    def _set_frame_transfer(self, state: int) -> None:
        self.frame_transfer = bool(state)

    @implements("SetShutter", only_idle=True)
    def _set_shutter(self, level: int, mode: int, closing_ms: int, opening_ms: int) -> None:
        require(level in (0, 1))
        require(mode in (SHUTTER_AUTO, SHUTTER_OPEN, SHUTTER_CLOSED), Code.P2INVALID)
        require(min(closing_ms, opening_ms) >= 0, Code.P3INVALID)
        if mode == SHUTTER_OPEN and self.shutter != SHUTTER_OPEN:
            self._opened_s = self._clock.now()
        self.shutter = mode


class Timing:
    """Exposure, read-out and cycle times; acquisition mode and trigger.

    Attributes:
        trigger: Mode of the trigger, such as INTERNAL.
        optics: Region and frame transfer, which the times depend on.
    """

    getters: ClassVar[Mapping[str, Callable[[Any], object]]] = {
        "GetMaximumExposure": lambda _: MAX_EXPOSURE_S,
        "GetAcquisitionTimings": lambda self: (self.exposure_s, self.kinetic_s, self.kinetic_s),
        "GetReadOutTime": lambda self: self.readout_s,
    }

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
    def _set_exposure(self, seconds: float) -> None:
        require(0 <= seconds <= MAX_EXPOSURE_S)
        self._exposure_s = seconds

    @implements("SetKineticCycleTime", only_idle=True)
    def _set_cycle(self, seconds: float) -> None:
        require(seconds >= 0)
        self._cycle_s = seconds

    @implements("SetAccumulationCycleTime", only_idle=True)
    def _set_accumulation_cycle(self, seconds: float) -> None:
        """No effect: accumulation is not modelled."""
        require(seconds >= 0)

    @implements("SetAcquisitionMode", only_idle=True)
    def _set_mode(self, mode: int) -> None:
        """1: single, 2: accumulate, 3: kinetic, 5: run till abort."""
        require(mode in (1, 2, KINETIC, RUN_TILL_ABORT))
        self._mode = mode

    @implements("SetNumberKinetics", only_idle=True)
    def _set_n_kinetics(self, number: int) -> None:
        require(number >= 1)
        self._n_kinetics = number

    @implements("SetNumberAccumulations", only_idle=True)
    def _set_n_accumulations(self, number: int) -> None:
        require(number == 1)

    @implements("SetTriggerMode", only_idle=True)
    def _set_trigger(self, mode: int) -> None:
        require(mode in (INTERNAL, EXTERNAL, EXTERNAL_START, EXTERNAL_EXPOSURE, SOFTWARE))
        self.trigger = mode

    @implements("SetTriggerInvert", "SetFastExtTrigger", only_idle=True)
    def _set_edge(self, mode: int) -> None:
        """No effect: a simulated pulse has both edges, and the sensor has no cleaning cycle."""
        require(mode in (0, 1))

    @implements("GetTriggerLevelRange")
    def _get_levels(self, *_pointers: Any) -> Code:
        return Code.NOT_SUPPORTED
