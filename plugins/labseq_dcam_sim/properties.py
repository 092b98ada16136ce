"""The properties of the simulated camera, with values, limits, and when they may be set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from labseq.plugin import SensorMode
from labseq_dcam_sim.header import (
    ACCESS_BUSY,
    ACCESS_READY,
    AUTO_ROUNDING,
    HAS_DEFAULT,
    HAS_RANGE,
    HAS_STEP,
    HAS_TEXT,
    LONG,
    MODE,
    READABLE,
    REAL,
    WRITABLE,
    Code,
    Property,
    Status,
)

P = Property

ROW_PAIR_S: Final = (172.8e-6, 7.2e-6)
"""Time to read two rows, in the ultra-quiet (1) and the standard scan (2), in seconds.

Measured at two ORCA-Quest as the jitter of their exposures (SCExAO's documentation of VAMPIRES, "Camera
Triggering"). Times 1152 it gives the published 5 and 120 frames per second.
"""
STEP_PX: Final = 4
"""Step and least size of the region (documentation of catkit2 for the ORCA-Quest)."""
LONGEST_S: Final = 1800.0
COLDEST_C, WARMEST_C = -35, 20
"""Temperatures that can be set (ours, as the sensor of a water-cooled camera is at -35 degC)."""
ELECTRONS_PER_COUNT, OFFSET_COUNTS = 0.11, 200.0
"""Conversion factor and offset of the virtual lab's qCMOS sensor (SCExAO measured 0.103 to 0.105)."""

IN_READY: Final = ACCESS_READY
ALWAYS: Final = ACCESS_READY | ACCESS_BUSY


class Refused(Exception):  # noqa: N818 - it is a return code of DCAM, not an error of labseq
    """A DCAM function refuses a call, with this return code."""

    def __init__(self, code: Code) -> None:
        self.code = code
        super().__init__(code)


def require(is_valid: object, code: Code) -> None:
    """Refuse a call unless a condition holds."""
    if not is_valid:
        raise Refused(code)


@dataclass(frozen=True, slots=True)
class Limits:
    """Kind of a property, and the values that it takes.

    Attributes:
        kind: MODE, LONG or REAL.
        low, high, step: Range. A step of 0 is none.
        default: Value after the camera was opened.
        access: In which states other than STABLE it may be set, None for read only.
        texts: Value of a mode -> its text.
    """

    kind: int
    low: float
    high: float
    step: float = 1.0
    default: float = 0.0
    access: int | None = 0
    texts: Mapping[int, str] | None = None

    @property
    def attribute(self) -> int:
        """DCAMPROPATTRIBUTE."""
        writable = 0 if self.access is None else WRITABLE | HAS_DEFAULT | self.access
        rounding = AUTO_ROUNDING if self.kind == REAL else 0
        return (
            self.kind
            | READABLE
            | HAS_RANGE
            | HAS_STEP
            | writable
            | rounding
            | (HAS_TEXT if self.texts else 0)
        )

    def check(self, value: float) -> None:
        """Refuse a value that is out of range, or on none of the steps."""
        require(self.low <= value <= self.high, Code.OUTOFRANGE)
        if self.texts is not None:
            require(value in self.texts, Code.INVALIDVALUE)
        elif self.kind == LONG:
            require((value - self.low) % self.step == 0, Code.INVALIDVALUE)


def _mode(texts: Mapping[int, str], access: int = IN_READY, default: int = 1) -> Limits:
    return Limits(MODE, min(texts), max(texts), 1.0, default, access, texts)


def _read_only(kind: int, high: float) -> Limits:
    return Limits(kind, 0.0, high, 0.0, access=None)


class Properties:
    """Values of the properties. Values that follow from others are worked out when they are read.

    Args:
        sensor_shape: (height, width) of the sensor.
        step_px: Step of the region.
    """

    def __init__(self, sensor_shape: tuple[int, int], step_px: int = STEP_PX) -> None:
        self.sensor_shape = height, width = sensor_shape
        self.limits: dict[Property, Limits] = {
            P.TRIGGER_SOURCE: _mode({1: "INTERNAL", 2: "EXTERNAL", 3: "SOFTWARE"}),
            P.TRIGGER_ACTIVE: _mode({1: "EDGE", 2: "LEVEL", 3: "SYNCREADOUT"}),
            P.TRIGGER_MODE: _mode({1: "NORMAL", 6: "START"}),
            P.TRIGGER_POLARITY: _mode({1: "NEGATIVE", 2: "POSITIVE"}),
            P.EXPOSURE_TIME: Limits(REAL, 7.2e-6, LONGEST_S, 1e-6, 0.01, ALWAYS),
            P.SENSOR_TEMPERATURE: _read_only(REAL, 100.0),
            P.SENSOR_COOLER: _mode({1: "OFF", 2: "ON"}, ALWAYS),
            P.SENSOR_TEMPERATURE_TARGET: Limits(REAL, COLDEST_C, WARMEST_C, 1.0, WARMEST_C, ALWAYS),
            P.READOUT_SPEED: Limits(LONG, 1, 2, 1, 2),
            P.BINNING: _mode({1: "1X1", 2: "2X2", 4: "4X4"}, 0),
            P.SUBARRAY_HPOS: Limits(LONG, 0, width - step_px, step_px, 0),
            P.SUBARRAY_HSIZE: Limits(LONG, step_px, width, step_px, width),
            P.SUBARRAY_VPOS: Limits(LONG, 0, height - step_px, step_px, 0),
            P.SUBARRAY_VSIZE: Limits(LONG, step_px, height, step_px, height),
            P.SUBARRAY_MODE: _mode({1: "OFF", 2: "ON"}, 0),
            P.TIMING_READOUT_TIME: _read_only(REAL, 10.0),
            P.TIMING_MIN_TRIGGER_INTERVAL: _read_only(REAL, LONGEST_S),
            P.INTERNAL_FRAME_INTERVAL: Limits(REAL, 0.0, LONGEST_S, 1e-6, 0.0, IN_READY),
            P.BIT_PER_CHANNEL: _read_only(LONG, 16),
            P.IMAGE_WIDTH: _read_only(LONG, width),
            P.IMAGE_HEIGHT: _read_only(LONG, height),
            P.CONVERSION_FACTOR_COEFF: _read_only(REAL, 1.0),
            P.CONVERSION_FACTOR_OFFSET: _read_only(REAL, 65535.0),
        }
        self.reset()

    def reset(self) -> None:
        """Set the defaults, as opening the camera does."""
        self._values: dict[Property, float] = {
            number: limits.default for number, limits in self.limits.items() if limits.access is not None
        }

    def get(self, number: int) -> float:
        """Value of a property."""
        prop = self.find(number)
        derived = {
            P.TIMING_READOUT_TIME: lambda: self.readout_s,
            P.TIMING_MIN_TRIGGER_INTERVAL: lambda: self.get(P.EXPOSURE_TIME) + self.readout_s,
            P.INTERNAL_FRAME_INTERVAL: lambda: self.period_s,
            P.BIT_PER_CHANNEL: lambda: 16.0,
            P.IMAGE_WIDTH: lambda: self._values[P.SUBARRAY_HSIZE] // self._values[P.BINNING],
            P.IMAGE_HEIGHT: lambda: self._values[P.SUBARRAY_VSIZE] // self._values[P.BINNING],
            P.CONVERSION_FACTOR_COEFF: lambda: ELECTRONS_PER_COUNT,
            P.CONVERSION_FACTOR_OFFSET: lambda: OFFSET_COUNTS,
        }
        return float(derived[prop]() if prop in derived else self._values[prop])

    def set(self, number: int, value: float, status: Status) -> None:
        """Set a property, in a state of the camera in which it may be set."""
        prop = self.find(number)
        limits = self.limits[prop]
        if limits.access is None:
            raise Refused(Code.NOTWRITABLE)
        needed = {Status.READY: ACCESS_READY, Status.BUSY: ACCESS_BUSY}.get(status, 0)
        require(limits.access & needed == needed, Code.ACCESSDENY)
        limits.check(value)
        before, self._values[prop] = self._values[prop], value
        if not self._fits():
            self._values[prop] = before
            raise Refused(Code.INVALIDSUBARRAY)

    def find(self, number: int) -> Property:
        """The property with a number."""
        require(number in self.limits, Code.INVALIDPROPERTYID)
        return Property(number)

    def next_to(self, number: int) -> Property:
        """The property that follows a number, 0 for the first."""
        following = [prop for prop in sorted(self.limits) if prop > number]
        require(following, Code.NOPROPERTY)
        return following[0]

    def text(self, number: int, value: float) -> str:
        """Text of a mode's value."""
        texts = self.limits[self.find(number)].texts
        require(
            texts is not None and value in texts, Code.NOVALUETEXT if texts is None else Code.INVALIDVALUE
        )
        return (texts or {})[int(value)]

    @property
    def mode(self) -> SensorMode:
        """Region and binning."""
        names = P.SUBARRAY_VPOS, P.SUBARRAY_HPOS, P.SUBARRAY_VSIZE, P.SUBARRAY_HSIZE
        y, x, height, width = (int(self._values[name]) for name in names)
        is_whole = (y, x, height, width) == (0, 0, *self.sensor_shape)
        return SensorMode(None if is_whole else (y, x, height, width), int(self._values[P.BINNING]))

    @property
    def readout_s(self) -> float:
        """Time to read the rows of the region, two at a time, in seconds."""
        n_pairs = -(-int(self._values[P.SUBARRAY_VSIZE]) // 2)
        return n_pairs * ROW_PAIR_S[int(self._values[P.READOUT_SPEED]) - 1]

    @property
    def period_s(self) -> float:
        """Time from one exposure to the next where the camera times them, in seconds. Read-out overlaps."""
        shortest_s = max(self._values[P.EXPOSURE_TIME], self.readout_s)
        return max(shortest_s, self._values[P.INTERNAL_FRAME_INTERVAL])

    def _fits(self) -> bool:
        """Whether the region is on the sensor. It is not checked without SUBARRAY MODE."""
        values, (height, width) = self._values, self.sensor_shape
        is_on = values[P.SUBARRAY_MODE] == 2
        fits_h = values[P.SUBARRAY_HPOS] + values[P.SUBARRAY_HSIZE] <= width
        return not is_on or (fits_h and values[P.SUBARRAY_VPOS] + values[P.SUBARRAY_VSIZE] <= height)
