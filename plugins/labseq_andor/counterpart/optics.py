"""What the simulated camera reads of its sensor, and whether light falls on it."""

from __future__ import annotations

from typing import Any, Final

from labseq.plugin import Clock, SensorMode
from labseq_andor.codes import Code
from labseq_andor.counterpart.calls import answers

FULL_IMAGE: Final = 4
SHUTTER_MS: Final = 27
"""Time that the shutter takes to open or close (ours, as cameras of this kind)."""

AUTO, OPEN, CLOSED = 0, 1, 2


class Optics:
    """Region, binning, isolated crop, frame transfer and shutter.

    Args:
        sensor_shape: (height, width) of the sensor.
        clock: The session's clock.

    Attributes:
        sensor_shape: (height, width) of the sensor.
        frame_transfer: Whether the next frame is exposed while one is read.
        is_cropped: Whether the rest of the sensor is left out.
        shutter: 0: automatic, 1: open, 2: closed.
    """

    def __init__(self, sensor_shape: tuple[int, int], clock: Clock) -> None:
        self.sensor_shape = sensor_shape
        self._clock = clock
        self.reset()

    def reset(self) -> None:
        """As after Initialize."""
        self.frame_transfer = False
        self.is_cropped = False
        self.shutter = CLOSED
        self._opened_s = 0.0
        self._read_mode = 0
        self._region, self._binning = (0, 0, *self.sensor_shape), 1

    def mode(self, em_gain: float) -> SensorMode:
        """How the sensor is exposed from now on."""
        region = None if self._region == (0, 0, *self.sensor_shape) else self._region
        is_open = self.shutter == AUTO or (
            self.shutter == OPEN and self._clock.now() >= self._opened_s + SHUTTER_MS / 1e3 - 1e-9
        )
        return SensorMode(region, self._binning, em_gain, is_open)

    @property
    def frame_shape(self) -> tuple[int, int]:
        """(height, width) of a frame."""
        return self._region[2] // self._binning, self._region[3] // self._binning

    @property
    def reads_images(self) -> bool:
        """Whether images are read, rather than tracks."""
        return self._read_mode == FULL_IMAGE

    @answers("GetDetector")
    def get_detector(self, width: Any, height: Any) -> int:
        """Pixels of the sensor; of the region in isolated crop."""
        shape = self._region[2:] if self.is_cropped else self.sensor_shape
        height[0], width[0] = shape
        return Code.SUCCESS

    @answers("SetReadMode", only_idle=True)
    def set_read_mode(self, mode: int) -> int:
        """4: images; tracks and full vertical binning can be chosen, but not acquired."""
        if mode not in range(FULL_IMAGE + 1):
            return Code.P1INVALID
        self._read_mode = mode
        return Code.SUCCESS

    @answers("SetSingleTrack", "SetMultiTrack", "SetRandomTracks", only_idle=True)
    def set_tracks(self, *places: Any) -> int:
        """Without effect: tracks are not modelled; pylablib sets them when it opens a camera."""
        del places
        return Code.SUCCESS

    @answers("SetImage", only_idle=True)
    def set_image(self, hbin: int, vbin: int, left: int, right: int, bottom: int, top: int) -> int:
        """Region, ends included, counted from 1; equal binning along both axes."""
        height, width = self.sensor_shape
        if hbin < 1:
            return Code.P1INVALID
        if vbin != hbin:
            return Code.P2INVALID
        if not 1 <= left <= right:
            return Code.P3INVALID
        if right > width or (right - left + 1) % hbin:
            return Code.P4INVALID
        if not 1 <= bottom <= top:
            return Code.P5INVALID
        if top > height or (top - bottom + 1) % vbin:
            return Code.P6INVALID
        self._region = (bottom - 1, left - 1, top - bottom + 1, right - left + 1)
        self._binning, self.is_cropped = hbin, False
        return Code.SUCCESS

    @answers("SetIsolatedCropModeEx", only_idle=True)
    def set_isolated_crop(
        self, active: int, height: int, width: int, vbin: int, hbin: int, left: int, bottom: int
    ) -> int:
        """Crop the sensor; only with frame transfer."""
        if not active:
            self.is_cropped = False
            return Code.SUCCESS
        if not self.frame_transfer:
            return Code.INVALID_MODE
        right, top = left + width - 1, bottom + height - 1
        if self.set_image(hbin, vbin, left, right, bottom, top) != Code.SUCCESS:
            return Code.P2INVALID
        self.is_cropped = True
        return Code.SUCCESS

    @answers("SetFrameTransferMode", only_idle=True)
    def set_frame_transfer(self, state: int) -> int:
        """Expose the next frame while one is read."""
        self.frame_transfer = bool(state)
        return Code.SUCCESS

    @answers("IsInternalMechanicalShutter")
    def get_has_shutter(self, is_there: Any) -> int:
        """It has one."""
        is_there[0] = 1
        return Code.SUCCESS

    @answers("GetShutterMinTimes")
    def get_shutter_times(self, closing_ms: Any, opening_ms: Any) -> int:
        """Time that it takes, in ms."""
        closing_ms[0] = opening_ms[0] = SHUTTER_MS
        return Code.SUCCESS

    @answers("SetShutter", only_idle=True)
    def set_shutter(self, level: int, mode: int, closing_ms: int, opening_ms: int) -> int:
        """Move it."""
        if level not in (0, 1):
            return Code.P1INVALID
        if mode not in (AUTO, OPEN, CLOSED):
            return Code.P2INVALID
        if min(closing_ms, opening_ms) < 0:
            return Code.P3INVALID
        if mode == OPEN and self.shutter != OPEN:
            self._opened_s = self._clock.now()
        self.shutter = mode
        return Code.SUCCESS
