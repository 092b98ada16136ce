"""From what an output plays to its slowly varying part within an AOD's band."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import RfSamples, RfSpan, RfTones

BLOCK: Final = 1024
"""Samples that are looked at together when silence is searched for."""

EDGE: Final = 0.05
"""Fraction of the band at each end in which the AOD's response falls to nothing."""


@dataclass(frozen=True, slots=True)
class Band:
    """The frequencies that an AOD deflects.

    Attributes:
        low_hz: The lowest one.
        width_hz: From there to the highest. It sets the rate of the envelope: bands of the same
            width have their values at the same times.
    """

    low_hz: float
    width_hz: float


@dataclass(frozen=True, slots=True, eq=False)
class Envelope:
    """A signal as the real part of ``values[n] exp(2 pi i low_hz n / rate_hz)``.

    Attributes:
        start_s: Time of the first value.
        rate_hz: Values per second.
        low_hz: Frequency that stands at 0.
        values: complex64 (n,), in volts.
    """

    start_s: float
    rate_hz: float
    low_hz: float
    values: NDArray[np.complex64]


def active_spans(span: RfSpan) -> list[tuple[float, float]]:
    """When a span is not silent: (start, end) in seconds, in time's order."""
    if isinstance(span, RfTones):
        return [(span.start_s, span.end_s)] if len(span.frequency_hz) else []
    n_blocks = math.ceil(len(span.samples) / BLOCK)
    loud = np.zeros(n_blocks, np.bool_)
    whole = len(span.samples) // BLOCK
    loud[:whole] = span.samples[: whole * BLOCK].reshape(whole, BLOCK).any(axis=1)
    loud[whole:] = span.samples[whole * BLOCK :].any()
    edges = np.flatnonzero(np.diff(loud, prepend=False, append=False)).reshape(-1, 2) * BLOCK
    times_s = span.start_s + np.minimum(edges, len(span.samples)) / span.sample_rate_hz
    return [(float(start_s), float(end_s)) for start_s, end_s in times_s]


def envelope(spans: Sequence[RfSpan], start_s: float, end_s: float, band: Band) -> Envelope:
    """The part of an output within a band, between two times.

    Samples are taken to the band by one Fourier transform of the whole stretch; tones are
    added up as they are. The band's edges are soft.

    Args:
        spans: What the output played, in time's order, all samples at one rate.
        start_s: Start of the stretch.
        end_s: Its end.
        band: The AOD's band.
    """
    sampled = [span for span in spans if isinstance(span, RfSamples)]
    if sampled:
        return _of_samples(sampled, start_s, end_s, band)
    return _of_tones([span for span in spans if isinstance(span, RfTones)], start_s, end_s, band)


def _of_samples(spans: Sequence[RfSamples], start_s: float, end_s: float, band: Band) -> Envelope:
    from scipy import fft

    rate_hz = spans[0].sample_rate_hz
    origin = spans[0].start_s
    first, last = (math.floor((time_s - origin) * rate_hz) for time_s in (start_s, end_s))
    n = cast("int", fft.next_fast_len(last - first, real=True))
    volts = np.zeros(n, np.float32)
    for span in spans:
        at = round((span.start_s - origin) * rate_hz) - first
        low, high = max(at, 0), min(at + len(span.samples), last - first)
        if low < high:
            volts[low:high] = span.samples[low - at : high - at]
            volts[low:high] *= span.volts_per_step
    spectrum = cast("NDArray[np.complex64]", fft.rfft(volts, overwrite_x=True))
    bottom = math.floor(band.low_hz * n / rate_hz)
    n_values = cast("int", fft.next_fast_len(math.ceil(band.width_hz * n / rate_hz)))
    part = np.zeros(n_values, np.complex64)
    inside = spectrum[bottom : bottom + n_values]
    part[: len(inside)] = inside
    part *= _response(n_values).astype(np.float32) * np.float32(2 * n_values / n)
    values = cast("NDArray[np.complex64]", fft.ifft(part, overwrite_x=True))
    return Envelope(origin + first / rate_hz, n_values * rate_hz / n, bottom * rate_hz / n, values)


def _of_tones(spans: Sequence[RfTones], start_s: float, end_s: float, band: Band) -> Envelope:
    rate_hz = band.width_hz
    n_values = math.ceil((end_s - start_s) * rate_hz)
    values = np.zeros(n_values, np.complex64)
    for span in spans:
        first = max(0, math.ceil((span.start_s - start_s) * rate_hz))
        last = min(n_values, math.ceil((span.end_s - start_s) * rate_hz))
        t_s = start_s + np.arange(first, last) / rate_hz - span.start_s
        shift = (start_s - span.start_s) * band.low_hz
        for hz, slope, volts, rise, phase_rad in zip(
            span.frequency_hz,
            span.frequency_slope,
            span.amplitude_v,
            span.amplitude_slope,
            span.phase_rad,
            strict=True,
        ):
            inside = (hz > band.low_hz) & (hz < band.low_hz + band.width_hz)
            turns = (hz - band.low_hz + 0.5 * slope * t_s) * t_s + shift
            wave = np.exp((2j * np.pi * (turns % 1.0) + 1j * phase_rad).astype(np.complex64))
            values[first:last] += inside * (volts + rise * t_s).astype(np.float32) * wave
    return Envelope(start_s, rate_hz, band.low_hz, values)


def _response(n: int) -> NDArray[np.float64]:
    """How well each frequency of the band is deflected: 1 but for the soft edges."""
    from_edge = np.minimum(np.arange(n) + 0.5, n - np.arange(n) - 0.5) / n
    return np.sin(np.pi / 2 * np.minimum(1.0, from_edge / EDGE)) ** 2
