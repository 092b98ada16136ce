"""The simulated camera with its states, its buffer, and its failures."""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Clock, Frame, Simulation, Trigger
from labseq.plugin.camera import Series, SimulatedSensor
from labseq.plugin.camera_simulator import CameraFaults, ExposureTiming, SimulatedExposures
from labseq_dcam_sim.header import SEQUENCE, SNAP, Code, Property, Status, Text
from labseq_dcam_sim.properties import STEP_PX, WARMEST_C, Properties, Refused, require

ENDLESS: Final = 2**31 - 1
KINDS: Final[dict[tuple[int, int, int], Trigger]] = {
    (3, 1, 1): "software",
    (1, 1, 1): "internal",
    (2, 1, 1): "external",
    (2, 1, 6): "external_start",
    (2, 2, 1): "bulb",
}
"""TRIGGER SOURCE, TRIGGER ACTIVE and TRIGGER MODE -> labseq's trigger."""
TIME_CONSTANT_S: Final = 60.0
"""Time constant with which the sensor reaches its temperature (ours)."""


@dataclass(slots=True)
class Faults(CameraFaults):
    """Failures to simulate. They may be changed at any time.

    Attributes:
        lost_frames: How many of the next frames do not reach the computer.
        coldest_c: Lowest temperature that the cooler reaches, in degrees Celsius (ours).
    """

    lost_frames: int = 0
    coldest_c: float = -35.0


class Exposures(SimulatedExposures):
    """Exposures that the camera numbers, so that a frame that is lost on its way leaves a gap.

    Attributes:
        stamps: Number of each frame in the buffer, as the camera counted it, from 0.
    """

    def __init__(self, sensor: SimulatedSensor, clock: Clock, faults: Faults) -> None:
        self._losses = faults
        super().__init__(sensor, clock, faults)

    def empty_buffer(self, n_frames: int = 1) -> None:
        """Forget the frames, and the numbers of the exposures."""
        self.stamps: list[int] = []
        self._n_exposed = 0
        super().empty_buffer(n_frames)

    def is_missed(self) -> bool:
        """A missed trigger is not counted, but a frame that is lost on its way is."""
        if super().is_missed():
            return True
        stamp, self._n_exposed = self._n_exposed, self._n_exposed + 1
        if self._losses.lost_frames:
            self._losses.lost_frames -= 1
            return True
        self.stamps.append(stamp)
        return False


class SimulatedCamera:
    """A simulated ORCA-Quest as DCAM's functions show it, with the simulation's sensor.

    Args:
        world: The simulation.
        clock: The session's clock.
        sensor_shape: (height, width) of the simulation's sensor.
        serial: Serial number.
        arm_s: Time that ``dcamcap_start`` takes, in seconds.
        step_px: Step of the region.

    Attributes:
        faults: Failures to simulate.
        properties: Values of the properties.
        exposures: The exposures of the series.
        is_open: Whether a handle of it is open.
    """

    def __init__(
        self,
        world: Simulation,
        clock: Clock,
        sensor_shape: tuple[int, int],
        serial: str = "500001",
        arm_s: float = 0.0,
        step_px: int = STEP_PX,
    ) -> None:
        self.faults = Faults()
        self.properties = Properties(sensor_shape, step_px)
        self.exposures = Exposures(SimulatedSensor(world, clock), clock, self.faults)
        self.model, self.serial = "C15550-20UP", serial
        self._clock, self._arm_s = clock, arm_s
        self._buffer: NDArray[np.uint16] | None = None
        self._is_aborted = False
        self._cooled_since_s, self._from_c = clock.now(), float(WARMEST_C)
        self.is_open = False

    def trigger(self, t_s: float | None = None, width_s: float = 1e-3) -> bool:
        """A pulse at the trigger input, now or at ``t_s`` of the clock. False if it started no exposure."""
        return self.exposures.pulse(t_s, width_s)

    def check(self) -> None:
        """Refuse every call of a camera that is unplugged."""
        self.exposures.proceed()
        require(not self.faults.unplugged, Code.NOCONNECTION)

    def open(self) -> None:
        """Get ready. Refused if another program uses the camera."""
        require(not (self.faults.held or self.is_open), Code.EXCLUDED)
        require(not self.faults.unplugged, Code.NOCONNECTION)
        self.is_open = True
        self.properties.reset()

    def close(self) -> None:
        """Release the camera and its buffer."""
        self.is_open, self._buffer = False, None
        self.exposures.reset()

    @property
    def status(self) -> Status:
        """BUSY in a series, READY with a buffer, else STABLE."""
        if self.exposures.is_acquiring:
            return Status.BUSY
        return Status.STABLE if self._buffer is None else Status.READY

    def text(self, number: int) -> str:
        """A text about the camera."""
        texts = {
            Text.BUS: "CoaXPress",
            Text.CAMERAID: f"S/N: {self.serial}",
            Text.VENDOR: "Hamamatsu",
            Text.MODEL: self.model,
            Text.CAMERAVERSION: "2.20.A",
            Text.DRIVERVERSION: "simulated",
        }
        require(number in texts, Code.UNKNOWNSTRID)
        return texts[Text(number)]

    # properties

    def get_value(self, number: int) -> float:
        """Value of a property."""
        if number == Property.SENSOR_TEMPERATURE:
            return self.temperature_c
        return self.properties.get(number)

    def set_value(self, number: int, value: float) -> float:
        """Set a property, and return its new value."""
        if number in (Property.SENSOR_COOLER, Property.SENSOR_TEMPERATURE_TARGET):
            self._from_c, self._cooled_since_s = self.temperature_c, self._clock.now()
        self.properties.set(number, value, self.status)
        return self.get_value(number)

    @property
    def temperature_c(self) -> float:
        """Temperature of the sensor now, in degrees Celsius."""
        is_on = self.properties.get(Property.SENSOR_COOLER) == 2
        target_c = self.properties.get(Property.SENSOR_TEMPERATURE_TARGET)
        end_c = max(target_c, self.faults.coldest_c) if is_on else WARMEST_C
        passed_s = self._clock.now() - self._cooled_since_s
        return end_c + (self._from_c - end_c) * math.exp(-passed_s / TIME_CONSTANT_S)

    # buffer and series

    def allocate(self, n_frames: int) -> None:
        """Allocate the buffer, only without one."""
        require(self.status == Status.STABLE, Code.NOTSTABLE)
        require(n_frames >= 1, Code.INVALIDPARAM)
        height, width = self.properties.mode.frame_shape(self.properties.sensor_shape)
        self._buffer = np.zeros((n_frames, height, width), np.uint16)
        self.exposures.empty_buffer(n_frames)

    def release(self) -> None:
        """Free the buffer, but not in a series."""
        require(self.status != Status.BUSY, Code.BUSY)
        self._buffer = None

    def start(self, mode: int) -> None:
        """Start a series, only with a buffer. SNAP ends when the buffer is full."""
        require(self.status != Status.BUSY, Code.BUSY)
        require(mode in (SEQUENCE, SNAP), Code.INVALIDPARAM)
        if self._buffer is None:
            raise Refused(Code.NOTREADY)
        properties = self.properties
        names = Property.TRIGGER_SOURCE, Property.TRIGGER_ACTIVE, Property.TRIGGER_MODE
        kind = KINDS.get(tuple(int(properties.get(name)) for name in names))  # type: ignore[arg-type]
        if kind is None:
            raise Refused(Code.NOTSUPPORT)
        n_frames = len(self._buffer) if mode == SNAP else ENDLESS
        series = Series(n_frames, properties.get(Property.EXPOSURE_TIME), kind)
        overlaps = kind in ("internal", "external_start")
        timing = ExposureTiming(properties.readout_s, properties.period_s, overlaps, self._arm_s)
        self.exposures.empty_buffer(len(self._buffer))
        self.exposures.start(series, properties.mode, timing)

    def stop(self) -> None:
        """End the series. No effect without one."""
        if self.exposures.is_acquiring:
            self.exposures.abort()

    def fire(self) -> None:
        """A software trigger, only in a series that waits for it, and not before the last frame is read."""
        require(self.exposures.is_acquiring, Code.NOTBUSY)
        require(self.properties.get(Property.TRIGGER_SOURCE) == 3, Code.NOTSUPPORT)
        require(not self.exposures.is_busy, Code.TOOFREQUENTTRIGGER)
        self.exposures.expose()

    def lock(self, index: int) -> tuple[Frame, int, int]:
        """The frame at a place of the buffer, its number, and the address of its pixels."""
        self.exposures.hang()
        buffer = self._buffer
        if buffer is None:
            raise Refused(Code.NOTREADY)
        require(0 <= index < len(buffer), Code.INVALIDFRAMEINDEX)
        held = {(number - 1) % len(buffer): number for number in self.exposures.buffer}
        require(index in held, Code.INVALIDFRAMEINDEX)
        number = held[index]
        frame = self.exposures.buffer[number]
        buffer[index] = frame.image
        self.exposures.n_fetched = max(self.exposures.n_fetched, number)
        return (
            frame,
            self.exposures.stamps[number - 1],
            ctypes.addressof(ctypes.c_char.from_buffer(buffer[index].data)),
        )

    def wait(self, timeout_ms: int) -> None:
        """Wait for a frame. Refused once after ``abort_wait``."""
        if self._is_aborted:
            self._is_aborted = False
            raise Refused(Code.ABORT)
        require(self.exposures.wait(timeout_ms / 1e3), Code.ABORT if self._is_aborted else Code.TIMEOUT)

    def abort_wait(self) -> None:
        """Make the present wait return, or the next one."""
        self._is_aborted = True
        self.exposures.cancel_wait()
