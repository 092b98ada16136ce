"""Which tones are played: local oscillator, length of the loop, phases, and the loop itself.

All pure. Tones are complex: at baseband each is ``a exp(i (2 pi f t + phase))``, f from its distance to
the local oscillator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import LimitError, format_quantity

Floats = NDArray[np.float64]

USABLE: Final = 0.8
"""Part of the sample rate that tones may span: beyond it the radio's filters cut."""

LONGEST: Final = 1 << 23
"""Longest loop in samples: 128 MiB for both channels."""

_CHUNK: Final = 1 << 18
_ROUNDS: Final = 400


@dataclass(frozen=True, slots=True, eq=False)
class AxisLoop:
    """The tones of one axis on the grid of a loop.

    Attributes:
        n_samples: Length of the loop.
        cycles: int64 (n_tones,), whole periods of each tone in the loop, negative below the
            local oscillator.
        phase_rad: float64 (n_tones,), phases at the loop's start.
    """

    n_samples: int
    cycles: NDArray[np.int64]
    phase_rad: Floats

    def samples(self, amplitudes: Floats) -> NDArray[np.complex64]:
        """The loop, complex64 (n_samples,).

        Args:
            amplitudes: float64 (n_tones,), fractions of full scale.
        """
        spectrum = np.zeros(self.n_samples, np.complex128)
        np.add.at(spectrum, self.cycles % self.n_samples, amplitudes * np.exp(1j * self.phase_rad))
        return (np.fft.ifft(spectrum) * self.n_samples).astype(np.complex64)


def local_oscillator(axes: Sequence[Floats]) -> float:
    """Frequency whose leakage, and the images of the tones in it, stay farthest from all tones.

    Near the middle of the tones. A third of the spacing beside a tone is best on a comb: leakage and images
    are then a third of the spacing from the nearest tone. Half of it would put each image onto another tone.

    Args:
        axes: Tones of each axis, in Hz.

    Returns:
        The frequency in Hz.

    Example:
        >>> float(local_oscillator([np.array([99.1e6, 99.7e6, 100.3e6, 100.9e6])]))
        100100000.0
    """
    tones = np.concatenate(axes)
    spacing_hz = _least_spacing_hz(axes)
    middle_hz = (tones.min() + tones.max()) / 2
    steps = sorted(range(-12, 13), key=lambda step: (abs(step), -step))
    candidates = [middle_hz + step * spacing_hz / 12 for step in steps]
    clear = [round(min(clearance(axis, one) for axis in axes) / spacing_hz, 6) for one in candidates]
    return float(candidates[int(np.argmax(clear))])


def clearance(tones_hz: Floats, oscillator_hz: float) -> float:
    """Distance from any tone of an axis to the leakage or an image of a tone, the least one, in Hz."""
    spots = np.append(2 * oscillator_hz - tones_hz, oscillator_hz)
    return float(np.abs(spots[:, None] - tones_hz).min())


def check_span(what: str, tones_hz: Floats, oscillator_hz: float, rate_hz: float) -> None:
    """Refuse tones that are too far from the local oscillator for the sample rate.

    Raises:
        LimitError: With both.
    """
    farthest = float(np.abs(tones_hz - oscillator_hz).max())
    limit_hz = USABLE * rate_hz / 2
    if farthest > limit_hz:
        came = f"{_mhz(farthest)} from the local oscillator at {_mhz(oscillator_hz)}"
        limit = f"{_mhz(limit_hz)}, half of {USABLE:.0%} of the sample rate of {_mhz(rate_hz)}"
        hint = f"choose a sample_rate above {_mhz(2 * farthest / USABLE)}, or another local_oscillator"
        raise LimitError(f"{what}: the outermost tone", came, limit, hint)


def shortest_loop(what: str, offsets_hz: Floats, rate_hz: float, tolerance_hz: float) -> int:
    """Length of the shortest loop in which all tones make whole periods.

    Args:
        what: Name of the device, for the message.
        offsets_hz: Tones of all axes, relative to the local oscillator.
        rate_hz: Samples per second.
        tolerance_hz: How far a tone may be from the one that was asked for.

    Returns:
        The length in samples.

    Raises:
        LimitError: No loop of up to :data:`LONGEST` samples has them all.

    Example:
        >>> shortest_loop("array", np.array([-1.2e6, 0.4e6]), 40e6, 1.0)
        100
    """
    for start in range(1, LONGEST + 1, _CHUNK):
        lengths = np.arange(start, min(start + _CHUNK, LONGEST + 1), dtype=np.float64)
        for offset_hz in offsets_hz:  # each tone leaves fewer
            cycles = offset_hz * lengths / rate_hz
            lengths = lengths[np.abs(cycles - np.rint(cycles)) * rate_hz < tolerance_hz * lengths]
        if len(lengths):
            return int(lengths[0])
    step_hz = 10 ** np.ceil(np.log10(rate_hz / LONGEST))
    raise LimitError(
        f"{what}: the loop that holds all tones to within {_hz(tolerance_hz)}",
        f"longer than {LONGEST} samples",
        f"{LONGEST} samples",
        f"round tones, local_oscillator and sample_rate to multiples of {_hz(step_hz)}",
    )


def axis_loop(offsets_hz: Floats, n_samples: int, rate_hz: float) -> AxisLoop:
    """Put the tones of an axis onto the grid of a loop, with phases for a low crest factor."""
    cycles = np.rint(offsets_hz * n_samples / rate_hz).astype(np.int64)
    return AxisLoop(n_samples, cycles, low_crest_phases(offsets_hz))


def low_crest_phases(frequency_hz: Floats) -> Floats:
    """Phases of equal tones for a low crest factor of their complex sum; always the same for the same tones.

    They start from Schroeder's (IEEE Trans. Inf. Theory 16, 85, 1970). Then the sum is clipped again and
    again, and the phases of what remains are taken (van der Ouderaa et al., IEEE Trans. Instrum. Meas. 37,
    145, 1988).

    Args:
        frequency_hz: float64 (n_tones,).

    Returns:
        float64 (n_tones,), in radians.
    """
    n_tones = len(frequency_hz)
    order = np.argsort(np.argsort(frequency_hz))
    best = phases = -np.pi * order * (order - 1.0) / n_tones
    if n_tones < 3:
        return best
    turns = np.exp(2j * np.pi * np.outer(_times_s(frequency_hz), frequency_hz - frequency_hz.min()))
    back, lowest = turns.conj(), np.inf
    for clip in np.linspace(0.8, 0.99, _ROUNDS):
        total = np.einsum("ij,j", turns, np.exp(1j * phases))  # BLAS would wake its threads for this
        size = np.abs(total)
        peak = float(size.max())
        if peak < lowest:
            lowest, best = peak, phases
        clipped = total * np.minimum(1.0, clip * peak / np.maximum(size, 1e-12))
        phases = np.angle(np.einsum("ij,i", back, clipped))
    return best


def crest_factor(samples: NDArray[np.complex64]) -> float:
    """Highest magnitude over the r.m.s. one; 0 for silence."""
    size = np.abs(samples)
    rms = float(np.sqrt(np.mean(np.square(size, dtype=np.float64))))
    return float(size.max()) / rms if rms > 0.0 else 0.0


def _times_s(frequency_hz: Floats) -> Floats:
    """When to look for peaks: over a period of a comb, or many beats of other tones."""
    spacings = np.diff(np.sort(frequency_hz))
    is_comb = np.ptp(spacings) < 1e-3 * spacings.min()
    n_beats = 1 if is_comb else 4
    n_times = 16 * len(frequency_hz) * n_beats
    return np.arange(n_times) / n_times * n_beats / spacings.min()


def _least_spacing_hz(axes: Sequence[Floats]) -> float:
    spacings = np.concatenate([np.diff(np.sort(tones)) for tones in axes])
    return float(spacings.min()) if len(spacings) else 1e6


def _mhz(value: float) -> str:
    return f"{value / 1e6:.7g} MHz"


def _hz(value: float) -> str:
    return format_quantity(value, "frequency")
