"""The base class of camera drivers, its settings, and simulated sensors."""

from __future__ import annotations

import math
import threading
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any, Final, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass as settings

from labseq.errors import DeviceError, DeviceTimeoutError, LimitError, TransientError, one_of
from labseq.model import CameraFacts, Frame, Orientation, SensorMode
from labseq.roles import Camera, Clock, Context, LineTrigger, Simulation, Trigger
from labseq.settings import IN_SI, Duration, PositiveDuration, Temperature, setting_error
from labseq.units import ZERO_CELSIUS_K, format_quantity


@dataclass(frozen=True, slots=True)
class Series:
    """A series of exposures for which a camera was armed.

    Attributes:
        n_frames: Number of exposures.
        exposure_s: Exposure time, in seconds.
        trigger: Trigger of each exposure, or of the whole series.
        em_gain: Mean gain of the EM register. 1 means no gain.
    """

    n_frames: int
    exposure_s: float
    trigger: Trigger
    em_gain: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class ExposureResult:
    """The outcome of one exposure.

    Attributes:
        number: Index in the series as counted by the camera, from 0.
        image: uint16 (height, width) in the sensor's orientation, not used elsewhere. None for a lost frame.
        fault: Reason why the frame was lost.
        exposure_s: Actual exposure time, in seconds. nan means as requested.
        t_start_s: Start of the exposure on the session's clock. nan means derived from the trigger.
        device_time_s: The camera's own time stamp, in seconds. nan if it has none.
    """

    number: int
    image: NDArray[np.uint16] | None
    fault: str = ""
    exposure_s: float = math.nan
    t_start_s: float = math.nan
    device_time_s: float = math.nan


class CameraDriver(Camera):
    """Base of camera drivers. Plays the role, and leaves to a subclass only the camera's own actions.

    It refuses impossible requests before the camera gets them, returns as many frames as the camera was
    armed for, detects missing frames by gaps in their numbers, and gives images their
    orientation.

    A subclass implements ``facts``, ``describe`` and the methods below with one underscore. They
    are called in this order: ``_connect``, then for each series ``_start``, ``_fire`` and ``_take``,
    at its end ``_stop``, and ``_disconnect``.

    Args:
        context: Name of the camera, and clock.
        orientation: Orientation of images relative to the sensor's frames. It is ``settings.orientation`` of
            :class:`CameraSettings`, whose ``frame_shape`` is the shape of the images.
    """

    def __init__(self, context: Context, orientation: Orientation = Orientation()) -> None:  # noqa: B008 - frozen
        self._orientation = orientation
        self._name = context.name or "camera"
        self._clock = context.clock
        self._trigger_lines = [f"'{line.name}'" for line in context.lines if line.triggers == "camera"]
        self._is_open = False
        self._forget()

    @property
    @abstractmethod
    def facts(self) -> CameraFacts:
        """What the camera can do, also before it is opened."""

    @abstractmethod
    def describe(self) -> Mapping[str, Any]:
        """Model, serial number, firmware and current settings, as JSON-ready values."""

    @abstractmethod
    def _connect(self) -> None:
        """Connect to the camera and make the settings that stay the same."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Release everything. Called in any state, also after a ``_connect`` that failed."""

    @abstractmethod
    def _start(self, series: Series) -> None:
        """Get the camera ready for a series, and start it if the trigger is internal."""

    @abstractmethod
    def _fire(self) -> None:
        """Start an exposure of a series with the software trigger."""

    @abstractmethod
    def _take(self, timeout_s: float) -> ExposureResult | None:
        """Wait for the next result of the series. None if nothing comes in time.

        See :func:`labseq.plugin.wait_for`.
        """

    @abstractmethod
    def _stop(self) -> None:
        """End acquisition, close the shutter, EM gain to 1. Called in any state between open and close."""

    def _end(self) -> None:
        """End a series, EM gain to 1. The shutter may stay open. Without an override, it calls ``_stop``."""
        self._stop()

    def open(self) -> None:
        """Connect to the camera. No effect if it is open.

        Raises:
            DeviceError: It does not answer, or is not the camera named in the profile.
        """
        if self._is_open:
            return
        try:
            self._connect()
        except BaseException:
            with suppress(Exception):  # only the first error counts
                self._disconnect()
            raise
        self._is_open = True

    def close(self) -> None:
        """Make safe and disconnect. Legal in any state."""
        try:
            self.safe_state()
        finally:
            self._is_open = False
            self._disconnect()

    def safe_state(self) -> None:
        """Stop exposing, close the shutter, EM gain to 1. Frames not yet read are dropped."""
        self._forget()
        if self._is_open:
            self._stop()

    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        """Get ready for a series of exposures. Frames not yet read are dropped.

        Raises:
            LimitError: No frames, or an exposure that the camera cannot make or not within its cycle time.
            DeviceError: Not open, or a trigger that it does not have.
        """
        self._arm(n_frames, exposure_s, trigger, self.facts.em_gain)

    def disarm(self) -> None:
        """End the series, EM gain to 1. Frames not yet read are dropped."""
        if self._series is not None:
            self._forget()
            self._end()

    def trigger(self) -> None:
        """Start the next exposure of the series, and return at once.

        Raises:
            DeviceError: Not armed for the software trigger, all exposures made, or still exposing.
        """
        self._check_open()
        series, now_s = self._series, self._clock.now()
        if series is None or len(self._fired_s) == series.n_frames:
            raise DeviceError(self._name, "triggered without being armed for another frame; call arm() first")
        if series.trigger != "software":
            raise DeviceError(self._name, f"triggered, but armed for the {series.trigger} trigger")
        is_exposing = len(self._fired_s) > self._n_read
        if is_exposing and now_s < (until_s := self._fired_s[-1] + series.exposure_s):
            raise DeviceError(self._name, f"triggered during an exposure that ends at {until_s:.6f} s")
        self._fired_s.append(now_s)
        self._fire()

    def read(self, timeout_s: float) -> Frame:
        """Wait for the oldest frame not yet read.

        Raises:
            DeviceTimeoutError: No frame came within ``timeout_s``.
            TransientError: One or more frames of the series were lost.
            DeviceError: Not open, or the camera no longer answers.
        """
        self._check_open()
        series = self._series
        if series is None or self._n_read == series.n_frames:
            self._clock.sleep(timeout_s)
            raise self._no_frame(timeout_s)
        exposure, self._held = self._held or self._take(timeout_s), None
        if exposure is None:
            raise self._no_frame(timeout_s)
        if exposure.number > self._n_read:
            self._held = exposure  # this frame is good, and the next call returns it
            raise self._lost(exposure.number - 1, "the camera's frame numbers have a gap")
        self._n_read = exposure.number + 1
        if exposure.image is None:
            raise self._lost(exposure.number, exposure.fault)
        exposure_s = series.exposure_s if math.isnan(exposure.exposure_s) else exposure.exposure_s
        t_start_s = self._t_start_s(exposure, exposure_s)
        image = self._orientation.apply(exposure.image)
        return Frame(image, exposure_s, t_start_s, self._name, exposure.number, exposure.device_time_s)

    def self_test(self) -> None:
        """Take a frame without EM gain, if the camera can be triggered. Frames not yet read are dropped.

        Raises:
            DeviceError: Not open, no frame came, or its shape is not the shape in the camera's facts.
            TransientError: The frame was lost.
        """
        facts = self.facts
        if "software" not in facts.triggers:
            return
        # with frame transfer no exposure is shorter than the read-out
        exposure_s = min(max(10e-3, facts.readout_s), facts.max_exposure_s)
        self._arm(1, exposure_s, "software", 1.0)
        self.trigger()
        shape, expected = self.read(exposure_s + facts.readout_s + 2.0).image.shape, facts.frame_shape
        if expected is not None and shape != expected:
            raise DeviceError(self._name, f"a frame has the shape {shape}; expected {expected}")

    def _arm(self, n_frames: int, exposure_s: float, trigger: Trigger, em_gain: float) -> None:
        self._check_open()
        facts = self.facts
        if n_frames < 1:
            raise LimitError(f"{self._name}: number of frames", n_frames, "at least 1")
        facts.check_exposure(exposure_s, self._name)
        if trigger not in facts.triggers:
            text = f"it has no {trigger} trigger; expected {one_of(facts.triggers)}"
            raise DeviceError(self._name, text)
        if trigger == "external_start" and facts.cycle_s < exposure_s:
            cycle, least = (format_quantity(s, "time") for s in (facts.cycle_s, exposure_s))
            raise LimitError(f"{self._name}: cycle_time", cycle, f"at least the exposure of {least}")
        self.disarm()  # an earlier series may still be running
        series = Series(n_frames, exposure_s, trigger, em_gain)
        try:
            self._start(series)
        except BaseException:
            with suppress(Exception):  # a series that is half started might go on exposing
                self._stop()
            raise
        self._series = series

    def _forget(self) -> None:
        self._series: Series | None = None
        self._fired_s: list[float] = []
        self._n_read = 0
        self._held: ExposureResult | None = None

    def _t_start_s(self, exposure: ExposureResult, exposure_s: float) -> float:
        if not math.isnan(exposure.t_start_s):
            return exposure.t_start_s
        if exposure.number < len(self._fired_s):
            return self._fired_s[exposure.number]
        # the time of an external edge is unknown, so the frame counts as read as soon as it was ready
        return self._clock.now() - exposure_s - self.facts.readout_s

    def _no_frame(self, timeout_s: float) -> DeviceTimeoutError:
        series, n_read = self._series, self._n_read
        if series is None:
            reason = "the camera is not armed"
        elif n_read == series.n_frames:
            reason = f"all {n_read} frames of the series were read"
        elif series.trigger == "software" and n_read >= len(self._fired_s):
            reason = "the next one was not triggered"
        elif series.trigger == "external_start" and n_read:
            reason = f"frame {n_read} of the externally triggered series is not ready"
        elif series.trigger in get_args(LineTrigger):
            line = f", the line {' or '.join(self._trigger_lines)}" if self._trigger_lines else ""
            reason = f"frame {n_read} waits for its external trigger{line}; check the cable"
        elif series.trigger == "software":
            reason = f"frame {n_read} is not ready, although its software trigger was sent"
        else:
            reason = f"frame {n_read} needs no trigger, but is not ready"
        text = f"no frame within {format_quantity(timeout_s, 'time')}: {reason}"
        return DeviceTimeoutError(self._name, text, timeout_s)

    def _lost(self, last: int, reason: str) -> TransientError:
        first, self._n_read = min(self._n_read, last), last + 1
        frames = f"frame {first} was" if first == last else f"frames {first} to {last} were"
        n_frames = self._series.n_frames if self._series is not None else 0
        return TransientError(f"{frames} lost from a series of {n_frames}: {reason}", self._name)

    def _check_open(self) -> None:
        if not self._is_open:
            raise DeviceError(self._name, "not open; call open() first")


LOOK_S: Final = 1.0
"""Time between two readings of a sensor's temperature, in seconds."""


def _is_temperature_of_sensors(kelvin: float) -> float:
    if not 150.0 <= kelvin <= 323.0:
        given = f"{format_quantity(kelvin, 'temperature')} ({kelvin - ZERO_CELSIUS_K:.0f} degC)"
        raise setting_error(f"temperature is {given}", "-123 to 50 degC, such as '-70 degC'")
    return kelvin


@settings(frozen=True, slots=True, config=IN_SI)
class Cooling:
    """The temperature of a cooled sensor."""

    temperature_k: Annotated[
        Temperature,
        AfterValidator(_is_temperature_of_sensors),
        Field(description='temperature of the sensor, such as "-70 degC"'),
    ]
    tolerance_k: Annotated[
        float, Field(gt=0, le=20, description="largest difference from the temperature, in kelvins")
    ] = 1.0
    steady_s: Annotated[Duration, Field(description="how long the sensor must keep to tolerance_k")] = 5.0
    timeout_s: Annotated[PositiveDuration, Field(description="maximum time for cooling")] = 900.0


def settle(cooling: Cooling, read_k: Callable[[], float], clock: Clock, name: str) -> None:
    """Wait until a sensor has reached its temperature and keeps it.

    Args:
        cooling: Temperature, tolerance and times.
        read_k: Reads the temperature, in kelvins.
        clock: The session's clock.
        name: Name of the device, for the error.

    Raises:
        DeviceTimeoutError: The temperature is not reached in time.
        StopRequested: The operator asked the run to stop.
    """
    start_s = clock.now()
    within_since_s: float | None = None
    while True:
        now_s, temperature_k = clock.now(), read_k()
        # the temperature may pass through the setpoint before it is steady
        if abs(temperature_k - cooling.temperature_k) > cooling.tolerance_k:
            within_since_s = None
        elif within_since_s is None:
            within_since_s = now_s
        if within_since_s is not None and now_s - within_since_s >= cooling.steady_s:
            return
        if now_s - start_s >= cooling.timeout_s:
            raise DeviceTimeoutError(name, _too_late(cooling, temperature_k), cooling.timeout_s)
        clock.sleep(LOOK_S)


def _too_late(cooling: Cooling, temperature_k: float) -> str:
    waited = format_quantity(cooling.timeout_s, "time")
    reached, setpoint = (
        f"{kelvin - ZERO_CELSIUS_K:.1f} degC" for kelvin in (temperature_k, cooling.temperature_k)
    )
    text = f"the sensor is at {reached} after {waited}; expected {setpoint} within {cooling.tolerance_k:g} K"
    return f"{text}; check its cooling water or fan, or choose a higher temperature"


BeginExposure: TypeAlias = Callable[[float | None, float | None], object]
"""Begins an exposure at a time (None: now) on the session's clock, of a length (None: the series' length)."""


class SimulatedSensor:
    """Exposes the simulation for a camera, and computes when each frame can be read.

    A virtual camera reads its frames here. The simulator of a real camera takes only the pixels from here and
    sends them like the camera. Its driver then waits here until the frame is due. One thread may ask for
    exposures while another takes frames.

    Args:
        world: The simulation.
        clock: The session's clock.
    """

    def __init__(self, world: Simulation, clock: Clock) -> None:
        self._world = world
        self._clock = clock
        self._lock = threading.Lock()
        self._frames: deque[tuple[float, Frame]] = deque()
        self.clear()

    def arm(
        self,
        series: Series,
        mode: SensorMode,
        readout_s: float,
        period_s: float | None = None,
        arm_s: float = 0.0,
        cycle_s: float = 0.0,
    ) -> None:
        """Get ready for a series. Frames not yet taken are dropped.

        Args:
            series: Number, length and trigger of the exposures. With the internal trigger the first
                exposure begins now, and each later one at the end of the previous read-out.
            mode: Region and binning.
            readout_s: From the end of an exposure until its frame can be read, in seconds.
            period_s: With the internal trigger, from one exposure to the next, in seconds. Shorter than
                exposure plus read-out if they overlap.
            arm_s: Time that arming takes, in seconds.
            cycle_s: After the edge that starts a series, from one exposure to the next, in seconds.
        """
        self._clock.sleep(arm_s)
        with self._lock:
            self._frames.clear()
            self._series, self._mode, self._readout_s = series, mode, readout_s
            self._period_s = series.exposure_s + readout_s if period_s is None else period_s
            self._n_exposed = 0
            self._armed_s = self._clock.now()
            self._cycle_s, self._cycles_from_s = cycle_s, math.nan

    def follow_line(self, expose: BeginExposure) -> None:
        """Have the line at the trigger input start the exposures of the series.

        Args:
            expose: Begins an exposure, as long as in the series or, with bulb, as long as the line is on.
        """

        def on_pulse(t_s: float, width_s: float) -> None:
            trigger = "" if self._series is None else self._series.trigger
            if trigger == "external_start" and math.isnan(self._cycles_from_s):  # later edges do not count
                self._cycles_from_s = t_s
            elif trigger in ("external", "bulb"):
                expose(t_s, width_s if trigger == "bulb" else None)

        self._world.wire("camera", on_pulse)

    def expose_next(self, expose: BeginExposure, timeout_s: float) -> None:
        """Begin the next exposure that the camera times itself, unless a frame is still to be taken.

        With the internal trigger this is the next exposure. After the edge that starts a series,
        this waits until the exposure is due, for at most ``timeout_s``.
        """
        series = self._series
        if series is None or self._frames or self._n_exposed == series.n_frames:
            return
        if series.trigger == "internal":
            expose(None, None)
        elif not math.isnan(self._cycles_from_s):
            t_s = self._cycles_from_s + self._n_exposed * self._cycle_s
            self._clock.sleep(max(0.0, min(t_s - self._clock.now(), timeout_s)))
            if t_s <= self._clock.now():
                expose(t_s, None)

    def expose(
        self, late_s: float = 0.0, t_start_s: float | None = None, exposure_s: float | None = None
    ) -> Frame | None:
        """Begin the next exposure of the series.

        Args:
            late_s: Delay of the frame, in seconds, to rehearse a failure.
            t_start_s: Start on the session's clock. None means now, or with the internal trigger in
                its turn.
            exposure_s: Length, in seconds. None means as in the series.

        Returns:
            The frame, which can be read when it is due. None if no further exposure is armed.

        Raises:
            DeviceError: The simulation is already at a later time.
        """
        with self._lock:
            series = self._series
            if series is None or self._n_exposed == series.n_frames:
                return None
            if t_start_s is None and series.trigger == "internal":
                # the camera keeps its own times, however late this is called
                t_start_s = self._armed_s + self._n_exposed * self._period_s
            elif t_start_s is None:
                t_start_s = self._clock.now()
            exposure_s = series.exposure_s if exposure_s is None else exposure_s
            frame = self._world.expose(t_start_s, exposure_s, self._mode)
            self._n_exposed += 1
            self._frames.append((t_start_s + exposure_s + self._readout_s + late_s, frame))
            return frame

    def skip(self) -> None:
        """Let an exposure of the series pass without a frame, like a trigger that was not seen."""
        with self._lock:
            self._n_exposed += 1

    def take(self, timeout_s: float) -> Frame | None:
        """Wait on the clock for the oldest frame not yet taken.

        Returns:
            None if it is not due within ``timeout_s``, after which this returns.
        """
        with self._lock:
            due_s = self._frames[0][0] if self._frames else float("inf")
        # without the lock, so that another thread can expose during the wait
        remaining_s = due_s - self._clock.now()
        self._clock.sleep(max(0.0, min(remaining_s, timeout_s)))
        if remaining_s > timeout_s:
            return None
        with self._lock:
            return self._frames.popleft()[1] if self._frames else None

    def clear(self) -> None:
        """Forget the series and its frames."""
        with self._lock:
            self._frames.clear()
            self._series: Series | None = None
            self._mode = SensorMode()
            self._readout_s = self._period_s = self._armed_s = self._cycle_s = 0.0
            self._cycles_from_s = math.nan
            self._n_exposed = 0


def nearest(value: int, low: int, high: int, step: int) -> int:
    """The nearest allowed number to a value, from low to high in steps.

    Example:
        >>> nearest(37, 0, 100, 4), nearest(39, 2, 100, 4), nearest(200, 0, 99, 4)
        (36, 38, 96)
    """
    n_steps = (min(max(value, low), high) - low + step // 2) // step
    return low + step * min(n_steps, (high - low) // step)


def check_step(name: str, value: int, bounds: tuple[int, int, int], unit: int = 1) -> None:
    """Refuse a number that a camera does not accept.

    Args:
        name: Camera and name of the number, for the error.
        value: The number, in pixels of the sensor.
        bounds: Smallest, largest and increment, in the camera's own pixels.
        unit: The binning, which is pixels of the sensor per pixel of the camera.

    Raises:
        LimitError: It is out of range or between two steps. The error names the nearest valid number.
    """
    low, high, step = (unit * bound for bound in bounds)
    good = nearest(value, low, high, step)
    if good != value:
        limit = f"{low} to {high}, in steps of {step} for this camera"
        raise LimitError(name, value, limit, f"the nearest possible value is {good}")
