"""The tones of the array, with local oscillator, length of the loop, phases, and the samples of the loop.

Tones are complex. At baseband each is ``a exp(i (2 pi f t + phase))``, where f is its distance from the
local oscillator. The functions are pure. :class:`ArrayTones` applies them to both axes of one radio.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from labseq_soapy_stream.messages import Facts
from labseq_soapy_stream.output import Samples
from numpy.typing import NDArray

from labseq.plugin import DeviceError, LimitError, format_quantity
from labseq.plugin.tweezers import Amplitudes, check_amplitudes
from labseq_soapy.radios import tunes_digitally
from labseq_soapy.settings import SoapySettings

Floats = NDArray[np.float64]

RATE_ERROR: Final = 1e-6
"""How far the sample rate may be from the requested one, as a fraction."""
TUNING_ERROR: Final = 0.01
"""How far the local oscillators may be from the requested frequency, as a fraction of the sample rate."""

USABLE: Final = 0.8
"""Part of the sample rate that tones may span. The radio's filters attenuate the rest."""

LONGEST: Final = 1 << 23
"""Longest loop in samples, 128 MiB for both channels."""

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
    """Frequency for which its leakage and the tones' images are farthest from all tones.

    It is near the middle of the tones. On a comb, a third of the spacing from a tone is best, because leakage
    and images are then a third of the spacing from the nearest tone. At half of it each image would be on a
    tone.

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
    """Smallest distance of a tone of an axis from the leakage or an image of a tone, in Hz."""
    spots = np.append(2 * oscillator_hz - tones_hz, oscillator_hz)
    return float(np.abs(spots[:, None] - tones_hz).min())


def check_span(what: str, tones_hz: Floats, zero_hz: float, rate_hz: float, setting: str) -> None:
    """Refuse tones that are too far from the zero of the samples for the sample rate.

    Raises:
        LimitError: They are.
    """
    farthest = float(np.abs(tones_hz - zero_hz).max())
    limit_hz = USABLE * rate_hz / 2
    if farthest > limit_hz:
        came = f"{_mhz(farthest)} from the local oscillator at {_mhz(zero_hz)}"
        limit = f"{_mhz(limit_hz)}, half of {USABLE:.0%} of the sample rate of {_mhz(rate_hz)}"
        other = "lo_offset" if setting == "lo_offset" else "local_oscillator"
        hint = f"choose a sample_rate above {_mhz(2 * farthest / USABLE)}, or another {other}"
        raise LimitError(f"{what}: the outermost tone", came, limit, hint, setting=(setting,))


def shortest_loop(what: str, offsets_hz: Floats, rate_hz: float, tolerance_hz: float) -> int:
    """Length of the shortest loop in which all tones make whole periods.

    Args:
        what: Name of the device, for the message.
        offsets_hz: Tones of all axes, relative to the local oscillator.
        rate_hz: Samples per second.
        tolerance_hz: How far a tone may be from its exact frequency.

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
        for offset_hz in offsets_hz:  # keep the lengths that suit this tone too
            cycles = offset_hz * lengths / rate_hz
            lengths = lengths[np.abs(cycles - np.rint(cycles)) * rate_hz < tolerance_hz * lengths]
        if len(lengths):
            return int(lengths[0])
    step = format_quantity(10 ** np.ceil(np.log10(rate_hz / LONGEST)), "frequency")
    raise LimitError(
        f"{what}: the loop that holds all tones to within {format_quantity(tolerance_hz, 'frequency')}",
        f"longer than {LONGEST} samples",
        f"{LONGEST} samples",
        f"round tones, local_oscillator and sample_rate to multiples of {step}",
    )


def axis_loop(offsets_hz: Floats, n_samples: int, rate_hz: float) -> AxisLoop:
    """Put the tones of an axis onto the grid of a loop, with phases for a low crest factor."""
    cycles = np.rint(offsets_hz * n_samples / rate_hz).astype(np.int64)
    return AxisLoop(n_samples, cycles, low_crest_phases(offsets_hz))


def low_crest_phases(frequency_hz: Floats) -> Floats:
    """Phases of equal tones for a low crest factor of their complex sum, the same for the same tones.

    Start from Schroeder's phases (IEEE Trans. Inf. Theory 16, 85, 1970). Then repeatedly clip the sum and
    take the phases of the result (van der Ouderaa et al., IEEE Trans. Instrum. Meas. 37, 145, 1988).

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
    """Ratio of the highest to the r.m.s. magnitude, 0 for silence."""
    size = np.abs(samples)
    rms = float(np.sqrt(np.mean(np.square(size, dtype=np.float64))))
    return float(size.max()) / rms if rms > 0.0 else 0.0


def _times_s(frequency_hz: Floats) -> Floats:
    """Times at which to look for peaks, one period of a comb or four beats of other tones."""
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


class ArrayTones:
    """Tones, local oscillator and loops of the array.

    Args:
        name: Name of the device, for messages.
        settings: Settings of the driver.
        shape: (n_rows, n_cols).

    Attributes:
        tones_hz: Tones of the rows and of the columns.
        oscillator_hz: Frequency requested for the local oscillators.
        crest_factor: Crest factor of the complex sums of the rows' and the columns' tones, in the last loop.
        loops: The tones on the grid of the loop, none before :meth:`tune`.

    Raises:
        LimitError: The tones span more than 80 % of the sample rate, no loop holds them all, or the offset of
            the local oscillator leaves it among the tones or moves them out of the radio's filters.
    """

    def __init__(self, name: str, settings: SoapySettings, shape: tuple[int, int]) -> None:
        self._name, self._settings = name, settings
        n_rows, n_cols = shape
        self.tones_hz = settings.row_frequency.tones(n_rows), settings.column_frequency.tones(n_cols)
        chosen = settings.local_oscillator
        self.oscillator_hz = local_oscillator(self.tones_hz) if chosen is None else chosen
        self.crest_factor: tuple[float, ...] = ()
        self.loops: tuple[AxisLoop, ...] = ()
        shift_hz = 0.0 if tunes_digitally(settings.device) else settings.lo_offset
        self._check_offset()
        self._n_samples(settings.sample_rate, [self.oscillator_hz + shift_hz] * 2)

    def tune(self, facts: Facts) -> None:
        """Fit the loops to the sample rate and local oscillators that the radio really has.

        Raises:
            DeviceError: They are not as requested.
            LimitError: No loop holds all tones.
        """
        wanted_hz = self._settings.sample_rate
        if abs(facts.rate_hz - wanted_hz) > RATE_ERROR * wanted_hz:
            text = f"the radio makes {facts.rate_hz:.10g} samples per second, not {wanted_hz:.10g}"
            raise DeviceError(self._name, f"{text}; choose a sample_rate that it has")
        expected_hz = self.oscillator_hz + self._settings.lo_offset
        for found_hz in facts.oscillator_hz:
            if abs(found_hz - expected_hz) > TUNING_ERROR * wanted_hz:
                text = f"the radio tuned its local oscillator to {found_hz:.10g} Hz"
                raise DeviceError(self._name, f"{text}, not {expected_hz:.10g} Hz; check its tuning range")
        n_samples = self._n_samples(facts.rate_hz, facts.zero_hz)
        self.loops = tuple(
            axis_loop(tones_hz - zero_hz, n_samples, facts.rate_hz)
            for tones_hz, zero_hz in zip(self.tones_hz, facts.zero_hz, strict=True)
        )

    def samples(self, amplitudes: Amplitudes) -> Samples:
        """One loop of both axes, in the order of their channels, float32 (2, 2 n), I and Q in turn.

        Args:
            amplitudes: Amplitudes of the rows (n_rows,) and columns (n_cols,), fractions of full scale.

        Raises:
            LimitError: Not one amplitude for each tone, a bad one, or their sum exceeds full scale.
        """
        made: list[NDArray[np.complex64]] = []
        n_rows, n_cols = (len(loop.cycles) for loop in self.loops)
        check_amplitudes(self._name, amplitudes, (n_rows, n_cols))
        for axis, values, loop in zip(("row", "column"), amplitudes, self.loops, strict=True):
            made.append(loop.samples(values))
            peak = float(np.abs(made[-1]).max()) * max(1.0, self._settings.max_depth) ** 0.25
            if peak > 1.0 + 1e-6:
                hint = "lower the amplitudes, or max_depth, and raise the gain"
                raise LimitError(
                    f"{self._name}: peak of the {axis} tones", f"{peak:.3g} of full scale", "1", hint
                )
        self.crest_factor = tuple(crest_factor(axis) for axis in made)
        order = np.argsort([self._settings.row_channel, self._settings.column_channel])
        return np.stack([made[axis].view(np.float32) for axis in order])

    def _check_offset(self) -> None:
        """Refuse an offset that leaves the oscillator among the tones, or the tones outside the filters."""
        offset_hz, bandwidth_hz = self._settings.lo_offset, self._settings.bandwidth
        if not offset_hz:
            return
        all_hz = np.concatenate(self.tones_hz) - self.oscillator_hz
        margin_hz = _least_spacing_hz(self.tones_hz) / 3
        low_hz, high_hz = float(all_hz.min()) - margin_hz, float(all_hz.max()) + margin_hz
        if low_hz < offset_hz < high_hz:
            came = f"{_mhz(offset_hz)}, which leaves it among the tones"
            limit = f"{_mhz(low_hz)} or less, or {_mhz(high_hz)} or more"
            raise LimitError(f"{self._name}: lo_offset", came, limit, setting=("lo_offset",))
        farthest_hz = float(np.abs(all_hz - offset_hz).max())
        if bandwidth_hz is not None and farthest_hz > bandwidth_hz / 2:
            what = f"{self._name}: the distance of the outermost tone from the local oscillator"
            limit = f"{_mhz(bandwidth_hz / 2)}, half of the bandwidth"
            raise LimitError(what, _mhz(farthest_hz), limit, setting=("bandwidth",))

    def _n_samples(self, rate_hz: float, zeros_hz: Sequence[float]) -> int:
        offsets_hz: list[Floats] = []
        for axis, tones_hz, zero_hz in zip(("row", "column"), self.tones_hz, zeros_hz, strict=True):
            setting = "lo_offset" if self._settings.lo_offset else "sample_rate"
            check_span(f"{self._name}: {axis} tones", tones_hz, zero_hz, rate_hz, setting)
            offsets_hz.append(tones_hz - zero_hz)
        all_hz = np.unique(np.concatenate(offsets_hz))
        return shortest_loop(self._name, all_hz, rate_hz, self._settings.tone_tolerance)
