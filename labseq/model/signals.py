"""What the devices play: tones, ramps of depth, samples."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from labseq.model.arrays import read_only


class SegmentKind(IntEnum):
    """What a segment of a tone program is there for."""

    IDLE = 0
    PICK_UP = 1
    TRANSPORT = 2
    DROP_OFF = 3


@dataclass(frozen=True, slots=True, eq=False)
class AxisTones:
    """The tones of one AOD axis, segment by segment, held as flat arrays.

    Attributes:
        offsets: int32 (n_segments + 1,); segment i has tones ``offsets[i]:offsets[i + 1]``.
        start_hz: float64 (n_tones,), frequency at the start of the segment.
        end_hz: float64 (n_tones,), frequency at its end.
        start_amplitude: float64 (n_tones,), fraction of full scale at its start.
        end_amplitude: float64 (n_tones,), fraction of full scale at its end.
        phase_rad: float64 (n_tones,), phase at its start.
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
        for item in fields(self)[1:]:
            values = read_only(getattr(self, item.name), np.float64, (n_tones,), item.name)
            object.__setattr__(self, item.name, values)


@dataclass(frozen=True, slots=True, eq=False)
class ToneProgram:
    """What the mobile tweezers shall play in one cycle, independent of the hardware.

    A tweezer exists at every crossing of a row tone and a column tone.

    Attributes:
        row: Tones of the row axis.
        column: Tones of the column axis.
        duration_s: float64 (n_segments,).
        kind: int8 (n_segments,), values of :class:`SegmentKind`.
        batch: int32 (n_segments,), the batch of the plan that a segment belongs to.
    """

    row: AxisTones
    column: AxisTones
    duration_s: NDArray[np.float64]
    kind: NDArray[np.int8]
    batch: NDArray[np.int32]

    def __post_init__(self) -> None:
        n_segments = len(self.duration_s)
        for name, dtype in (("duration_s", np.float64), ("kind", np.int8), ("batch", np.int32)):
            values = read_only(getattr(self, name), dtype, (n_segments,), name)
            object.__setattr__(self, name, values)
        for axis in (self.row, self.column):
            if len(axis.offsets) != n_segments + 1:
                raise ValueError("both axes must have as many segments as there are durations")

    @property
    def n_segments(self) -> int:
        """Number of segments."""
        return len(self.duration_s)

    @property
    def total_duration_s(self) -> float:
        """Playing time of the whole program."""
        return float(self.duration_s.sum())


@dataclass(frozen=True, slots=True)
class DepthRamp:
    """A linear change of the static tweezers' depth.

    Attributes:
        start: Depth at the start, as a fraction of the nominal depth.
        end: Depth at the end.
        duration_s: Duration of the ramp; 0 for a switch.
    """

    start: float
    end: float
    duration_s: float = 0.0


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
