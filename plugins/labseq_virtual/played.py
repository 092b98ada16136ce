"""What outputs have played, as tones and envelopes.

The light that an AOD sends to one place of the focal plane is the Fourier component of the
acoustic wave within the beam: the spectrum of the last microseconds, in a window that is
the beam's profile. So the spectra here are both a measurement and the AOD's own answer: a jump
of amplitude, phase or frequency acts as softly as the sound crosses the beam.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import (
    LimitError,
    MotionSpec,
    RfSamples,
    RfSource,
    RfSpan,
    RfTones,
    SiteGrid,
    format_quantity,
)

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


Floats = NDArray[np.float64]

WINDOW: Final = 2.5
"""Length of the windows, in transit times: at its ends a Gaussian beam is down to e^-12.5."""
HOPS: Final = 8
"""Windows per transit time."""
REACH_HZ: Final = 800e3
"""Half the width of the part of a spectrum that is taken for one tone."""
APART_HZ: Final = 450e3
"""Least distance of two tones that are told apart."""
MOST: Final = 64
"""Most tones of an axis at once."""
FRAMES: Final = 4096
"""Spectra worked out together: 40 MB at 10 us of transit, however long a program is."""


MIN_TURNS: Final = 2.0
"""Least number of beats of two tones within a transit time: with fewer, their peaks are one."""
MAX_SITES: Final = 0.6
"""Most sites that a tweezer moves in a transit time: a faster chirp is as broad as the gap to the next."""
PEAK_SPEED: Final = {"constant": 1.0, "minimum_jerk": 15 / 8, "constant_jerk": 2.0}
"""Greatest speed over the mean, see :class:`labseq.model.FrequencyCourse`."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Tones over time, nan where one is off; a column may hold several, one after the other.

    Attributes:
        t_s: float64 (n_frames,), times, equally spaced.
        frequency_hz: float64 (n_frames, n_tracks).
        amplitude_v: float64 (n_frames, n_tracks), peak volts.
        phase_rad: float64 (n_frames, n_tracks), of cos(phase) at that time.
    """

    t_s: Floats
    frequency_hz: Floats
    amplitude_v: Floats
    phase_rad: Floats


def refuse_blur(grid: SiteGrid, motion: MotionSpec, transit_s: float) -> None:
    """Refuse what :func:`track_tones` could not tell apart, so that it is no loss of atoms.

    Args:
        grid: The grid, with the tones of its sites.
        motion: The speed.
        transit_s: Time that the sound takes across the beam.

    Raises:
        LimitError: The tones of two neighbours are too near to one another, or too fast.
    """
    hint = "change `transit_time`, `speed` or `grid`, or leave the physics out (--dry-run=fast)"
    transit = format_quantity(transit_s, "time")
    steps_hz = [np.abs(np.diff(hz)) for hz in (grid.row_frequency_hz, grid.column_frequency_hz)]
    step_hz = float(np.concatenate(steps_hz).min(initial=np.inf))
    if step_hz < (min_hz := max(APART_HZ, MIN_TURNS / transit_s)):
        step, least = (format_quantity(hz, "frequency") for hz in (step_hz, min_hz))
        what = f"the smallest step of the sites' tones at a transit_time of {transit}"
        raise LimitError(what, step, f"at least {least}: less cannot be told apart", hint)
    sites = PEAK_SPEED[motion.speed_profile] * motion.speed_m_s * transit_s / grid.spacing_m
    if sites > MAX_SITES:
        what = f"the way of a mobile tweezer in a transit_time of {transit}"
        raise LimitError(what, f"{sites:.2g} sites", f"{MAX_SITES:g}: a faster chirp blurs the tones", hint)


def track_tones(
    spans: Sequence[RfSpan],
    start_s: float,
    end_s: float,
    band: Band,
    transit_s: float,
    min_v: float,
    slew_hz: float,
) -> Tracks:
    """Recover the tones from what an output played, without knowing what was meant.

    Frequency, amplitude and phase are means over the beam, weighted with its intensity
    ``exp(-2 (2 t / transit)^2)``. The amplitude is coherent, the overlap with the beam of a tone
    that does not jump: one that jumps by pi in the middle of the beam has none for a moment.

    Args:
        spans: What the output played, in time's order.
        start_s: Start of the stretch.
        end_s: Its end.
        band: The AOD's band.
        transit_s: Time that the sound takes across the beam, 1/e^2 of the intensity at both ends.
        min_v: Least amplitude of a tone.
        slew_hz: Most that a tone's frequency changes in a transit time.
    """
    from labseq_virtual.atom_kernels import find_tones, link_tones, measure_tones

    signal = envelope(spans, start_s, end_s, band)
    sound = _Spectra(signal.values, transit_s * signal.rate_hz)
    bin_hz = signal.rate_hz / sound.n_window
    reach, apart = (max(2, round(hz / bin_hz)) for hz in (REACH_HZ, APART_HZ))
    parts = range(0, sound.n_frames, FRAMES)
    found = [find_tones(_power(sound.spectra(k)), min_v**2, apart, reach, MOST) for k in parts]
    centroid, count = (np.concatenate(part) for part in zip(*found, strict=True))
    tracks, n_tracks = link_tones(centroid, count, slew_hz / HOPS / bin_hz)
    tracks = np.ascontiguousarray(tracks[:, :n_tracks])
    width, hop = sound.tau / sound.n_window, sound.hop / sound.n_window
    measured = [measure_tones(sound.spectra(k), tracks, k, reach, width, hop) for k in parts]
    amplitude, phase = (np.concatenate(part) for part in zip(*measured, strict=True))
    t_s = signal.start_s + (np.arange(sound.n_frames) * sound.hop + sound.middle) / signal.rate_hz
    phase += 2 * np.pi * ((t_s - signal.start_s) * signal.low_hz % 1.0)[:, None]
    return Tracks(t_s, signal.low_hz + tracks * bin_hz, amplitude, phase)


class _Spectra:
    """What is in the beam from frame to frame.

    Args:
        values: An output's slowly varying part.
        transit: The transit time, in values.
    """

    def __init__(self, values: NDArray[np.complex64], transit: float) -> None:
        from scipy import fft

        self.hop = max(1, round(transit / HOPS))
        self.n_window = n = cast("int", fft.next_fast_len(round(WINDOW * transit)))
        self.middle = n // 2
        self.tau = transit / 2
        window = np.exp(-(((np.arange(n) - self.middle) / self.tau) ** 2))
        self._window = (window / window.sum()).astype(np.float32)
        self._frames = np.lib.stride_tricks.sliding_window_view(values, n)[:: self.hop]
        self._turn = np.exp(2j * np.pi * (np.arange(n) * self.middle % n) / n).astype(np.complex64)
        self.n_frames = len(self._frames)
        self._last: tuple[int, NDArray[np.complex64]] | None = None

    def spectra(self, first: int) -> NDArray[np.complex64]:
        """The spectra of the next frames, phases as of the middle of each; the last ones are kept."""
        from scipy import fft

        if self._last is None or self._last[0] != first:
            part = self._frames[first : first + FRAMES] * self._window
            found = cast("NDArray[np.complex64]", fft.fft(part, overwrite_x=True))
            found *= self._turn
            self._last = first, found
        return self._last[1]


def _power(spectra: NDArray[np.complex64]) -> NDArray[np.float32]:
    return spectra.real**2 + spectra.imag**2


ROUNDING_S: Final = 1e-8
"""How near to a cut a sound must begin to be the same sound."""


@dataclass(frozen=True, slots=True, eq=False)
class RfPulse:
    """A time in which light is on, from silence to silence.

    Attributes:
        start_s: When the first output begins to sound.
        end_s: When the last one has ended.
        rows: What the row output played, in time's order.
        columns: What the column output played.
        continued: Whether the light was on when the episode before was cut off.
    """

    start_s: float
    end_s: float
    rows: tuple[RfSpan, ...]
    columns: tuple[RfSpan, ...]
    continued: bool


class PulseReceiver:
    """Hears what a driver's outputs play, and parts it at the silences.

    Args:
        source: The outputs.
        silence_s: Shortest silence that ends an episode.
    """

    def __init__(self, source: RfSource, silence_s: float) -> None:
        self._source = source
        self._silence_s = silence_s
        self._cut_s = -math.inf

    def receive_until(self, until_s: float) -> Iterator[RfPulse]:
        """What was played until a time, in episodes; the last one is cut off there if it must be.

        Args:
            until_s: The time; what the source plays later is left for the next call.
        """
        heard = self._source.played(until_s)
        cut_s, self._cut_s = self._cut_s, until_s
        times = [times for spans in heard for span in spans for times in active_spans(span)]
        for start_s, end_s in _joined(times, self._silence_s):
            rows, columns = (_between(spans, start_s, end_s) for spans in heard)
            yield RfPulse(start_s, end_s, rows, columns, start_s < cut_s + ROUNDING_S)


def _between(spans: Sequence[RfSpan], start_s: float, end_s: float) -> tuple[RfSpan, ...]:
    return tuple(span for span in spans if span.end_s > start_s and span.start_s < end_s)


def _joined(times: list[tuple[float, float]], silence_s: float) -> list[tuple[float, float]]:
    """Times in order, with the silences that are too short left out."""
    joined: list[tuple[float, float]] = []
    for start_s, end_s in sorted(times):
        if joined and start_s - joined[-1][1] < silence_s:
            joined[-1] = joined[-1][0], max(joined[-1][1], end_s)
        else:
            joined.append((start_s, end_s))
    return joined
