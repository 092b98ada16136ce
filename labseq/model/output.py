"""What a device really puts out, as whoever listens at its connectors finds it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from labseq.model.arrays import read_only


@dataclass(frozen=True, slots=True, eq=False)
class RfSamples:
    """Samples that an output played without a break.

    Attributes:
        start_s: When the first sample was at the output, on the session's clock.
        sample_rate_hz: Samples per second.
        samples: int16 (n,).
        volts_per_step: Volts into 50 Ohm that a sample of 1 stands for.
    """

    start_s: float
    sample_rate_hz: float
    samples: NDArray[np.int16]
    volts_per_step: float

    @property
    def end_s(self) -> float:
        """When the last sample ended."""
        return self.start_s + len(self.samples) / self.sample_rate_hz


@dataclass(frozen=True, slots=True, eq=False)
class RfTones:
    """Tones that an output made by itself, without a break.

    At the time t after the start, tone i is
    ``(amplitude_v + amplitude_slope t) cos(phase_rad + 2 pi (frequency_hz t + frequency_slope t^2 / 2))``.

    Attributes:
        start_s: When they began, on the session's clock.
        end_s: When they ended.
        frequency_hz: float64 (n,), at the start.
        frequency_slope: float64 (n,), in Hz/s.
        amplitude_v: float64 (n,), peak volts into 50 Ohm at the start.
        amplitude_slope: float64 (n,), in V/s.
        phase_rad: float64 (n,), at the start.
    """

    start_s: float
    end_s: float
    frequency_hz: NDArray[np.float64]
    frequency_slope: NDArray[np.float64]
    amplitude_v: NDArray[np.float64]
    amplitude_slope: NDArray[np.float64]
    phase_rad: NDArray[np.float64]

    def __post_init__(self) -> None:
        n_tones = len(self.frequency_hz)
        for item in fields(self)[2:]:
            values = read_only(getattr(self, item.name), np.float64, (n_tones,), item.name)
            object.__setattr__(self, item.name, values)


RfSpan: TypeAlias = RfSamples | RfTones
"""A stretch of an output; between two of them it is silent."""
