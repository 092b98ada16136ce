"""Series of frames with an open camera."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from labseq_aravis import Buffer, Camera, Stream, StreamOptions

from labseq.plugin import DeviceError, LimitError, Trigger, format_quantity
from labseq.plugin.camera import ExposureResult, Series
from labseq_genicam.connection import Link
from labseq_genicam.settings import GenicamSettings

BUFFER_BYTES: Final = 256 * 2**20
"""Memory for frames that were not read yet; a series that needs more reuses its buffers."""

INCOMPLETE: Final = "some of its network packets are missing"
FAULTS: Final[Mapping[str, str]] = {"success": "", "missing packets": INCOMPLETE, "timeout": INCOMPLETE}
"""What is wrong with a frame, by the status of its buffer."""

RATE: Final = "AcquisitionFrameRate"
ROUNDING: Final = 1e-6

BURST: Final = "FrameBurstStart"
SERIES: Final = ("AcquisitionStart", BURST)
"""Triggers that start a series, by their names in the SFNC; the first that a camera has is used."""
BURST_COUNT: Final = "AcquisitionBurstFrameCount"
WIDTH: Final = "TriggerWidth"
"""Exposure mode in which the trigger's width is the exposure, by its name in the SFNC."""

LAST_ID: Final = 65535
"""GigE cameras count frames from 1 to this and continue with 1, unless they use 64 bits."""


class Acquisition:
    """The series of an open camera.

    A camera that waits for software triggers continues to wait from one series to the next, since starting it
    again can take as long as an exposure. Late frames of an earlier series are recognised by their numbers.
    """

    def __init__(self, link: Link, settings: GenicamSettings) -> None:
        self._link = link
        self._settings = settings
        self._options = StreamOptions(settings.packet_timeout, settings.frame_timeout)
        self._stream: Stream | None = None
        self._trigger: Trigger | None = None  # while it acquires
        self._counter = FrameCounter()
        self._n_buffers = self._n_triggered = self._first = self._n_frames = 0
        self._exposure_s = math.nan

    def prepare(self, series: Series, trigger: Trigger) -> float:
        """Get ready for a series; nothing is exposed yet.

        Args:
            series: The series.
            trigger: What starts its exposures; a simulated camera may be triggered in another way.

        Returns:
            Time from one exposure to the next where the camera times them, in seconds; else nan.
        """
        continues = trigger == self._trigger == "software" and self._has_all_frames()
        if not continues:
            self.stop()
        period_s = math.nan
        with self._link.doing("prepare the series") as camera:
            if not continues:
                self._set_trigger(camera, trigger)
            if trigger == "bulb":
                self._exposure_s = series.exposure_s
            else:
                self._set_exposure(camera, series.exposure_s)
            if series.trigger in ("internal", "external_start"):
                period_s = self._set_period(camera, series, trigger)
            if trigger == "external_start":
                self._set_series_trigger(camera, series.n_frames)
            self._provide(camera, series.n_frames)
        self._first, self._n_frames = self._n_triggered, series.n_frames
        return period_s

    def begin(self, trigger: Trigger) -> None:
        """Start the prepared series, unless the camera is already waiting for triggers."""
        if self._trigger is None:
            with self._link.doing("start the series") as camera:
                is_counted = trigger == "external_start" and series_trigger(camera) != BURST
                camera.start(self._n_frames if is_counted else None)
            self._trigger = trigger

    @property
    def is_running(self) -> bool:
        """Whether the camera is already waiting for triggers, or exposes."""
        return self._trigger is not None

    def fire(self) -> None:
        """Start an exposure."""
        with self._link.doing("trigger it") as camera:
            camera.trigger()
        self._n_triggered += 1

    def poll(self, seconds: float) -> ExposureResult | None:
        """Wait for the next frame of the series, for at most ``seconds``; None if none came."""
        buffer = self._pop(seconds)
        if buffer is None:
            return None
        number = self._counter.number(buffer.frame_id if buffer.image is not None else None) - self._first
        if number < 0:  # of an earlier series
            return None
        if self._trigger in ("internal", "external_start") and number >= self._n_frames - 1:
            self.stop()
        time_s = 1e-9 * buffer.camera_time_ns if buffer.camera_time_ns else math.nan
        fault = FAULTS.get(buffer.status, f"its buffer is '{buffer.status}'")
        return ExposureResult(number, buffer.image, fault, self._exposure_s, device_time_s=time_s)

    def stop(self) -> None:
        """End the acquisition; frames that were not read are dropped, including those being transferred."""
        stream, trigger = self._stream, self._trigger
        self._stream = self._trigger = None
        if self._link.is_gone:
            return  # the link closes the stream
        if trigger is not None:
            with self._link.doing("stop the series") as camera:
                camera.stop()
        if stream is not None:
            stream.close()

    def _has_all_frames(self) -> bool:
        """Whether all triggered frames have come; those that were not read are dropped."""
        while (buffer := self._pop(0.0)) is not None:
            self._counter.number(buffer.frame_id if buffer.image is not None else None)
        return self._counter.n_frames == self._n_triggered

    def _pop(self, seconds: float) -> Buffer | None:
        if self._stream is None:
            raise DeviceError(self._link.name, "not acquiring; call arm() first")
        with self._link.doing("read a frame"):
            return self._stream.pop(seconds)

    def _set_exposure(self, camera: Camera, exposure_s: float) -> None:
        shortest_s, longest_s = camera.exposure_bounds_s
        if not shortest_s <= exposure_s <= longest_s:
            came, low, high = (format_quantity(t, "time") for t in (exposure_s, shortest_s, longest_s))
            limit = f"{low} to {high}, which the camera can do"
            raise LimitError(f"{self._link.name}: exposure", came, limit)
        camera.set_exposure_s(exposure_s)
        self._exposure_s = camera.exposure_s

    def _set_trigger(self, camera: Camera, trigger: Trigger) -> None:
        if camera.is_available("ExposureMode"):
            camera.set_string("ExposureMode", WIDTH if trigger == "bulb" else "Timed")
        if trigger in ("internal", "external_start"):
            camera.set_trigger(None)
            return
        source = "Software" if trigger == "software" else self._settings.trigger_line
        self._check_source(camera, source)
        camera.set_trigger(source)
        if trigger != "software" and self._settings.trigger_edge == "falling":
            camera.set_string("TriggerActivation", "FallingEdge")

    def _check_source(self, camera: Camera, source: str) -> None:
        if source not in (offered := camera.trigger_sources):
            text = f"its trigger source cannot be {source}; the camera offers {', '.join(offered) or 'none'}"
            raise DeviceError(self._link.name, text)

    def _set_series_trigger(self, camera: Camera, n_frames: int) -> None:
        """Let an edge start the series, whose exposures have no trigger of their own."""
        trigger, edge = series_trigger(camera), self._settings.trigger_edge
        camera.set_string("TriggerSelector", trigger)
        self._check_source(camera, self._settings.trigger_line)
        camera.set_string("TriggerMode", "On")
        camera.set_string("TriggerSource", self._settings.trigger_line)
        camera.set_string("TriggerActivation", "FallingEdge" if edge == "falling" else "RisingEdge")
        if trigger == BURST:
            camera.set_integer(BURST_COUNT, n_frames)

    def _set_period(self, camera: Camera, series: Series, trigger: Trigger) -> float:
        """Set the rate at which a camera exposes by itself; returns its period."""
        exposure_s, setting, wanted_hz = series.exposure_s, "frame_rate", self._settings.frame_rate
        if series.trigger == "external_start":
            setting, wanted_hz = "line_trigger: external_start", 1.0 / (self._settings.cycle_time or 1.0)
        natural_s = exposure_s + self._settings.readout
        if not camera.is_available(RATE):
            if wanted_hz is None:
                return natural_s
            text = f"the frame rate of the camera cannot be set; leave out `{setting}`"
            raise DeviceError(self._link.name, text)
        low_hz, high_hz = camera.float_bounds(RATE)
        rate_hz = wanted_hz or min(max(1.0 / natural_s, low_hz), high_hz)
        high_hz = min(high_hz, 1.0 / exposure_s)
        if not low_hz <= rate_hz <= high_hz * (1.0 + ROUNDING):
            limit = f"{low_hz:g} to {high_hz:g} per second at this exposure"
            raise LimitError(f"{self._link.name}: frame rate", f"{rate_hz:g}", limit)
        if trigger == "software":  # of the simulated camera
            return 1.0 / rate_hz
        camera.set_frame_rate_hz(rate_hz)
        return 1.0 / camera.frame_rate_hz

    def _provide(self, camera: Camera, n_frames: int) -> None:
        """Allocate buffers for the series, as far as the memory allows."""
        if self._stream is None:
            self._n_buffers = self._n_triggered = 0
            self._counter = FrameCounter()
            self._stream = camera.create_stream(0, self._options)
        payload = camera.payload
        n_missing = max(2, min(n_frames, BUFFER_BYTES // payload)) - self._n_buffers
        self._stream.allocate(n_missing, payload)
        self._n_buffers += max(0, n_missing)


def series_trigger(camera: Camera) -> str:
    """The trigger of a camera that starts a series; empty if it has none."""
    offered = camera.options("TriggerSelector")
    return next((name for name in SERIES if name in offered), "")


class FrameCounter:
    """Numbers the frames of an acquisition, including those that never came.

    The first frame that comes has the number 0. An incomplete frame is counted as the next one, since its
    frame id is not reliable.

    Example:
        >>> counter = FrameCounter()
        >>> [counter.number(frame_id) for frame_id in (65533, 65534, None, 1, 3)]
        [0, 1, 2, 3, 5]
        >>> counter.n_frames
        6
    """

    def __init__(self) -> None:
        self.n_frames = 0
        self._last: tuple[int, int] | None = None

    def number(self, frame_id: int | None) -> int:
        """Number, from 0, of the frame that has just come; its id is None if it is incomplete."""
        number = self.n_frames
        if frame_id is not None and self._last is not None:
            last_number, last_id = self._last
            n_steps = frame_id - last_id
            number = last_number + (n_steps if n_steps >= 0 else n_steps + LAST_ID)
        if frame_id is not None:
            self._last = number, frame_id
        self.n_frames = number + 1
        return number
