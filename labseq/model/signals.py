"""Signals that devices play: tones, ramps of depth, samples."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from labseq.model.grid import read_only


class SegmentKind(IntEnum):
    """Purpose of a segment of a tone program."""

    IDLE = 0
    PICK_UP = 1
    TRANSPORT = 2
    DROP_OFF = 3


class FrequencyCourse(IntEnum):
    """Course of the frequencies from start to end of a segment, the same for all its tones.

    In a segment of duration T a tone is at ``f(t) = start_hz + (end_hz - start_hz) s(t / T)``, and its phase
    is ``phase_rad`` plus 2 pi times the integral of f from 0 to t. The course s rises from 0 to 1 and is
    symmetric, s(1 - u) = 1 - s(u), so that a tone's mean frequency in a segment is the mean of start and end.

    Attributes:
        LINEAR: s(u) = u, constant speed.
        MINIMUM_JERK: s(u) = 10 u^3 - 15 u^4 + 6 u^5, the course with the least
            mean square jerk that starts and ends at rest without acceleration
            (Flash and Hogan, J. Neurosci. 5, 1688, 1985). The greatest speed is 15/8 of the mean.
        CONSTANT_JERK: s(u) = 3 u^2 - 2 u^3, the cubic with constant negative jerk that
            starts and ends at rest (Bluvstein et al., Nature 604, 451, 2022). The greatest
            speed is 3/2 of the mean.
    """

    LINEAR = 0
    MINIMUM_JERK = 1
    CONSTANT_JERK = 2

    @property
    def fastest(self) -> float:
        """Greatest speed relative to the mean speed, which is the greatest slope of s(u)."""
        return (1.0, 15 / 8, 3 / 2)[self]

    def fraction(self, u: float) -> float:
        """The course s(u), the fraction of its path that a tone has completed.

        Args:
            u: Fraction of the segment's duration that has passed, 0 to 1.

        Example:
            >>> FrequencyCourse.CONSTANT_JERK.fraction(0.25)
            0.15625
        """
        if self is FrequencyCourse.LINEAR:
            return u
        if self is FrequencyCourse.MINIMUM_JERK:
            return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
        return u**2 * (3.0 - 2.0 * u)

    def integral(self, u: float) -> float:
        """Integral of the course from 0 to u, which is 1/2 at u = 1 for every course.

        In a segment of duration T a tone's phase has advanced by
        ``2 pi T (start_hz u + (end_hz - start_hz) integral(u))``.

        Args:
            u: Fraction of the segment's duration that has passed, 0 to 1.

        Example:
            >>> FrequencyCourse.LINEAR.integral(0.5)
            0.125
        """
        if self is FrequencyCourse.LINEAR:
            return 0.5 * u**2
        if self is FrequencyCourse.MINIMUM_JERK:
            return u**4 * (2.5 - 3.0 * u + u**2)
        return u**3 * (1.0 - 0.5 * u)


@dataclass(frozen=True, slots=True, eq=False)
class AxisTones:
    """The tones of one AOD axis, segment by segment, stored as flat arrays.

    Within a segment the frequency follows :class:`FrequencyCourse`. The depth of a tone, proportional to its
    amplitude squared, is linear in time. In a segment of duration T, the amplitude of a tone goes from a0 to
    a1 as ``a(t) = sqrt(a0^2 + (a1^2 - a0^2) t / T)``.

    Attributes:
        offsets: int32 (n_segments + 1,). Segment i has tones ``offsets[i]:offsets[i + 1]``.
        start_hz: float64 (n_tones,), frequency at the start of the segment.
        end_hz: float64 (n_tones,), frequency at its end.
        start_amplitude: float64 (n_tones,), fraction of full scale at its start.
        end_amplitude: float64 (n_tones,), fraction of full scale at its end.
        phase_rad: float64 (n_tones,), phase at its start, of cos(2 pi f t + phase).
    """

    offsets: NDArray[np.int32]
    start_hz: NDArray[np.float64]
    end_hz: NDArray[np.float64]
    start_amplitude: NDArray[np.float64]
    end_amplitude: NDArray[np.float64]
    phase_rad: NDArray[np.float64]

    def __post_init__(self) -> None:
        offsets = read_only(self.offsets, np.int32, (-1,), "offsets")
        object.__setattr__(self, "offsets", offsets)
        n_tones = int(offsets[-1])
        for name in ("start_hz", "end_hz", "start_amplitude", "end_amplitude", "phase_rad"):
            values = read_only(getattr(self, name), np.float64, (n_tones,), name)
            object.__setattr__(self, name, values)


@dataclass(frozen=True, slots=True, eq=False)
class TonesNow:
    """The tones of one axis at one time.

    Attributes:
        frequency_hz: float64 (n_tones,).
        amplitude: float64 (n_tones,), fraction of full scale.
        phase_rad: float64 (n_tones,), from 0 to 2 pi. The axis plays the sum of ``amplitude cos(phase)``.
    """

    frequency_hz: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    phase_rad: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TonesAt:
    """The tones of both axes at one time.

    Attributes:
        row: Tones of the row axis.
        column: Tones of the column axis.
    """

    row: TonesNow
    column: TonesNow


@dataclass(frozen=True, slots=True, eq=False)
class ToneProgram:
    """The tones of the mobile tweezers in one cycle, independent of the hardware.

    A tweezer exists at every crossing of a row tone and a column tone.

    Attributes:
        row: Tones of the row axis.
        column: Tones of the column axis.
        duration_s: float64 (n_segments,).
        kind: int8 (n_segments,), values of :class:`SegmentKind`.
        batch: int32 (n_segments,), the batch of the plan that a segment belongs to.
        course: int8 (n_segments,), values of :class:`FrequencyCourse`. LINEAR by default.
    """

    row: AxisTones
    column: AxisTones
    duration_s: NDArray[np.float64]
    kind: NDArray[np.int8]
    batch: NDArray[np.int32]
    course: NDArray[np.int8] = field(default_factory=lambda: np.zeros(0, np.int8))

    def __post_init__(self) -> None:
        n_segments = len(self.duration_s)
        course = self.course if len(self.course) else np.zeros(n_segments, np.int8)
        object.__setattr__(self, "course", read_only(course, np.int8, (n_segments,), "course"))
        for name, dtype in (("duration_s", np.float64), ("kind", np.int8), ("batch", np.int32)):
            values = read_only(getattr(self, name), dtype, (n_segments,), name)
            object.__setattr__(self, name, values)
        for axis in (self.row, self.column):
            if len(axis.offsets) != n_segments + 1:
                raise ValueError("both axes must have as many segments as durations")

    @property
    def n_segments(self) -> int:
        """Number of segments."""
        return len(self.duration_s)

    @property
    def total_duration_s(self) -> float:
        """Playing time of the whole program."""
        return float(self.duration_s.sum())

    @property
    def joint_s(self) -> NDArray[np.float64]:
        """Start of each segment, and end of the last, float64 (n_segments + 1,)."""
        return np.concatenate([[0.0], np.cumsum(self.duration_s)])

    def tones_at(self, t_s: float) -> TonesAt:
        """The tones at a time.

        At a joint these are the tones at the start of the next segment. Before and after the program there
        are no tones.

        Args:
            t_s: Time from the start of the program, in seconds.

        Raises:
            ValueError: The time is not a number.
        """
        if math.isnan(t_s):
            raise ValueError("the time is not a number; expected seconds from the start of the program")
        joint_s = self.joint_s
        segment = int(np.searchsorted(joint_s, t_s, side="right")) - 1
        if not 0 <= segment < self.n_segments:
            nothing = np.empty(0)
            silent = TonesNow(nothing, nothing, nothing)
            return TonesAt(silent, silent)
        passed_s, duration_s = t_s - joint_s[segment], float(self.duration_s[segment])
        course = FrequencyCourse(int(self.course[segment]))
        at = course, passed_s, duration_s
        return TonesAt(_tones_at(self.row, segment, *at), _tones_at(self.column, segment, *at))


def _tones_at(
    axis: AxisTones, segment: int, course: FrequencyCourse, passed_s: float, duration_s: float
) -> TonesNow:
    """The tones of an axis, some time after the start of a segment."""
    part = slice(axis.offsets[segment], axis.offsets[segment + 1])
    u = min(passed_s / duration_s, 1.0)
    start_hz, sweep_hz = axis.start_hz[part], axis.end_hz[part] - axis.start_hz[part]
    start, end = axis.start_amplitude[part] ** 2, axis.end_amplitude[part] ** 2
    cycles = start_hz * passed_s + sweep_hz * (duration_s * course.integral(u))
    phase_rad = (axis.phase_rad[part] + 2 * np.pi * (cycles % 1.0)) % (2 * np.pi)
    return TonesNow(start_hz + sweep_hz * course.fraction(u), np.sqrt(start + (end - start) * u), phase_rad)


@dataclass(frozen=True, slots=True)
class DepthRamp:
    """A linear change of the static tweezers' depth.

    Attributes:
        start: Depth at the start, as a fraction of the nominal depth.
        end: Depth at the end.
        duration_s: Duration of the ramp. 0 for a switch.
    """

    start: float
    end: float
    duration_s: float = 0.0


@dataclass(frozen=True, slots=True)
class TweezersFacts:
    """Facts about static tweezers that are known before they are opened.

    Attributes:
        resolution_s: Step of the clock that times their ramps and releases.
        shortest_release_s: Shortest time for which they can turn their light off. inf if they cannot.
        latency_s: Typical time from the call of ``ramp`` to its start at the outputs.
        control: The values that labseq can set: "tones" of rows and columns (``load``), "sites" with a weight
            each (``load_weights``), or "nothing".
        ramps: Whether they can have depths between off and nominal.
    """

    resolution_s: float = 0.0
    shortest_release_s: float = math.inf
    latency_s: float = 0.0
    control: Literal["tones", "sites", "nothing"] = "tones"
    ramps: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class TweezerAmplitudes:
    """Amplitudes of the static tweezers' tones, as fractions of full scale.

    Attributes:
        row: float64 (n_rows,).
        column: float64 (n_cols,).
        dark_s: How long the light was off just before, in seconds.
        site: float64 (n_rows, n_cols), power of each tweezer that is not made by tones, relative to the
            nominal power. None if it follows from the tones.
    """

    row: NDArray[np.float64]
    column: NDArray[np.float64]
    dark_s: float = 0.0
    site: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "row", read_only(self.row, np.float64, (-1,), "row"))
        object.__setattr__(self, "column", read_only(self.column, np.float64, (-1,), "column"))
        if self.site is not None:
            object.__setattr__(self, "site", read_only(self.site, np.float64, (-1, -1), "site"))


@dataclass(frozen=True, slots=True, eq=False)
class Waveform:
    """Samples for an AWG.

    Attributes:
        samples: int16 (n_channels, n_samples).
        sample_rate_hz: Sample rate, in Hz.
    """

    samples: NDArray[np.int16]
    sample_rate_hz: float

    def __post_init__(self) -> None:
        samples = read_only(self.samples, np.int16, (-1, -1), "samples")
        object.__setattr__(self, "samples", samples)
