"""Finds the tones in the signal that RF outputs have played.

The light that an AOD sends to a point in the focal plane is the Fourier component of the acoustic wave
inside the beam, the spectrum of the last microseconds in a window with the beam's profile. The spectra
here are therefore both a measurement and the response of the AOD. A jump of amplitude, phase or frequency
is smoothed over the time that the sound takes to cross the beam.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import LimitError, MotionSpec, SiteGrid, format_quantity
from labseq.plugin.simulation import RfSamples, RfSource, RfSpan, RfTones

BLOCK: Final = 1024
"""Samples tested together in the search for silence."""

BAND_HZ: Final = 50e6
"""Smallest width of the AODs' band (ours)."""
BESIDE: Final = 0.25
"""Distance beyond the last site or ejection slot at which a resting tone is dark, in tone spacings (ours)."""
EVERYWHERE: Final = (-math.inf, math.inf)


@dataclass(frozen=True, slots=True)
class Band:
    """The frequencies that an AOD deflects.

    Attributes:
        low_hz: The lowest frequency.
        width_hz: Width of the band. It sets the sample rate of the envelope, so bands of the same
            width are sampled at the same times.
    """

    low_hz: float
    width_hz: float


@dataclass(frozen=True, slots=True, eq=False)
class Envelope:
    """A signal as the real part of ``values[n] exp(2 pi i low_hz n / rate_hz)``.

    Attributes:
        start_s: Time of the first value.
        rate_hz: Values per second.
        low_hz: Frequency that is shifted to 0.
        values: complex64 (n,), in volts.
    """

    start_s: float
    rate_hz: float
    low_hz: float
    values: NDArray[np.complex64]


def bands(grid: SiteGrid) -> list[Band]:
    """The bands of the AODs of rows and columns, of the same width so that their frames coincide."""
    axes = (grid.row_frequency_hz, grid.column_frequency_hz)
    width_hz = max(BAND_HZ, *(1.4 * float(np.ptp(hz)) for hz in axes))
    return [Band(max(0.0, float(hz.max() + hz.min() - width_hz) / 2), width_hz) for hz in axes]


def reach_hz(sites_hz: NDArray[np.float64], eject_slots: int) -> tuple[float, float]:
    """The range of tones that send light to a site or an ejection slot. A tone at rest outside does not."""
    step_hz = float(np.abs(np.diff(sites_hz)).max(initial=0.0))
    margin_hz = (eject_slots + BESIDE) * step_hz
    return float(sites_hz.min()) - margin_hz, float(sites_hz.max()) + margin_hz


def active_spans(span: RfSpan, reach_hz: tuple[float, float] = EVERYWHERE) -> list[tuple[float, float]]:
    """Times when a span sends light to the atoms, as (start, end) in seconds, in order."""
    if isinstance(span, RfTones):
        low, high = reach_hz
        near = (span.frequency_hz > low) & (span.frequency_hz < high)
        lit = near.any() or span.frequency_slope.any() or span.amplitude_slope.any()
        return [(span.start_s, span.end_s)] if lit else []
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

    Samples are filtered by one Fourier transform of the whole interval, and tones are
    added up directly. The band's edges are soft.
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
    """Diffraction efficiency over the band. It falls to 0 over 5 % of the band at each end (ours)."""
    from_edge = np.minimum(np.arange(n) + 0.5, n - np.arange(n) - 0.5) / n
    return np.sin(np.pi / 2 * np.minimum(1.0, from_edge / 0.05)) ** 2


Floats = NDArray[np.float64]

WINDOW: Final = 2.5
"""Length of a window in transit times, at whose ends a Gaussian beam is down to e^-12.5."""
HOPS: Final = 8
"""Windows per transit time."""
REACH_HZ: Final = 800e3
"""Half the width of the part of a spectrum that belongs to one tone (ours)."""
APART_HZ: Final = 450e3
"""Smallest distance of two tones that can be resolved (ours)."""
FRAMES: Final = 8192
"""Number of spectra computed at once. 80 MB at a transit time of 10 us, for programs of any length."""


MIN_TURNS: Final = 2.0
"""Smallest number of beats of two tones within a transit time. With fewer, their peaks merge."""
MAX_SITES: Final = 0.6
"""Largest motion of a tweezer in a transit time. A faster chirp is as broad as the gap to the next tone."""
PEAK_SPEED: Final = {"constant": 1.0, "minimum_jerk": 15 / 8, "constant_jerk": 3 / 2}
"""Greatest speed over the mean, see :class:`labseq.plugin.motion.FrequencyCourse`."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Tones over time, nan where a tone is off. A column may hold several tones, one after the other.

    Attributes:
        t_s: float64 (n_frames,), times, equally spaced.
        frequency_hz: float64 (n_frames, n_tracks).
        amplitude_v: float64 (n_frames, n_tracks), peak volts.
        phase_rad: float64 (n_frames, n_tracks), phase of the cosine at that time.
    """

    t_s: Floats
    frequency_hz: Floats
    amplitude_v: Floats
    phase_rad: Floats


def sites_in_transit(grid: SiteGrid, motion: MotionSpec, transit_s: float) -> float:
    """Greatest motion of a tweezer while the sound crosses the beam, in sites."""
    return PEAK_SPEED[motion.speed_profile] * motion.speed_m_s * transit_s / grid.spacing_m


def check_resolvable(grid: SiteGrid, motion: MotionSpec, transit_s: float) -> None:
    """Check that :func:`track_tones` can resolve the tones. Otherwise the analysis would lose atoms.

    Raises:
        LimitError: The tones of two neighbours are too close, or move too fast.
    """
    hint = "change `transit_time`, `speed` or `grid`, or run without the physics (--dry-run=fast)"
    transit = format_quantity(transit_s, "time")
    steps_hz = [np.abs(np.diff(hz)) for hz in (grid.row_frequency_hz, grid.column_frequency_hz)]
    step_hz = float(np.concatenate(steps_hz).min(initial=np.inf))
    if step_hz < (min_hz := max(APART_HZ, MIN_TURNS / transit_s)):
        step, least = (format_quantity(hz, "frequency") for hz in (step_hz, min_hz))
        quantity = f"the smallest step of the sites' tones at a transit_time of {transit}"
        raise LimitError(quantity, step, f"at least {least} (closer tones cannot be resolved)", hint)
    if (sites := sites_in_transit(grid, motion, transit_s)) > MAX_SITES:
        quantity = f"the motion of a mobile tweezer in a transit_time of {transit}"
        raise LimitError(
            quantity, f"{sites:.2g} sites", f"{MAX_SITES:g} (a faster chirp blurs the tones)", hint
        )


def track_tones(
    spans: Sequence[RfSpan],
    start_s: float,
    end_s: float,
    band: Band,
    transit_s: float,
    min_v: float,
    slew_hz: float,
) -> Tracks:
    """Recover the tones from an output's signal, without knowing the program.

    Frequency, amplitude and phase are means over the beam, weighted with its intensity
    ``exp(-2 (2 t / transit)^2)``. The amplitude is coherent, the overlap with a tone without jumps
    in the beam. A tone that jumps by pi in the middle of the beam has none for a moment.

    Args:
        spans: Signal of the output, in order of time.
        start_s: Start of the interval.
        end_s: End of the interval.
        band: The AOD's band.
        transit_s: Time that the sound takes across the beam, 1/e^2 of the intensity at both ends.
        min_v: Smallest amplitude of a tone, in volts.
        slew_hz: Largest change of a tone's frequency in a transit time.
    """
    from labseq_virtual.rf_kernels import find_tones, link_tones, measure_tones

    signal = envelope(spans, start_s, end_s, band)
    sound = _Spectra(signal.values, transit_s * signal.rate_hz)
    bin_hz = signal.rate_hz / sound.n_window
    reach, apart = (max(2, round(hz / bin_hz)) for hz in (REACH_HZ, APART_HZ))
    parts = range(0, sound.n_frames, FRAMES)
    n_most = 64  # simultaneous tones of an axis
    powers = (power for k in parts for power in _powers(sound.spectra(k)))
    tones = [find_tones(power, min_v**2, apart, reach, n_most) for power in powers]
    centroid, count = (np.concatenate(part) for part in zip(*tones, strict=True))
    tracks, n_tracks = link_tones(centroid, count, slew_hz / HOPS / bin_hz)
    tracks = np.ascontiguousarray(tracks[:, :n_tracks])
    width, hop = sound.tau / sound.n_window, sound.hop / sound.n_window
    measured = [measure_tones(sound.spectra(k), tracks, k, reach, width, hop) for k in parts]
    amplitude, phase = (np.concatenate(part) for part in zip(*measured, strict=True))
    t_s = signal.start_s + (np.arange(sound.n_frames) * sound.hop + sound.middle) / signal.rate_hz
    phase += 2 * np.pi * ((t_s - signal.start_s) * signal.low_hz % 1.0)[:, None]
    return Tracks(t_s, signal.low_hz + tracks * bin_hz, amplitude, phase)


class _Spectra:
    """Spectra of the acoustic wave inside the beam, frame by frame."""

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
        """Spectra of the frames from ``first`` on, with phases in the middle of each frame. Cached."""
        from scipy import fft

        if self._last is None or self._last[0] != first:
            part = self._frames[first : first + FRAMES] * self._window
            spectra = cast("NDArray[np.complex64]", fft.fft(part, overwrite_x=True))
            spectra *= self._turn
            self._last = first, spectra
        return self._last[1]


def _powers(spectra: NDArray[np.complex64]) -> Iterator[NDArray[np.float32]]:
    """The squared magnitudes, some frames at a time, because all together would double the memory."""
    for first in range(0, len(spectra), 256):
        part = spectra[first : first + 256]
        yield part.real**2 + part.imag**2


def forget_transforms() -> None:
    """Free the tables that SciPy keeps for the latest 16 lengths, 20 MB per program, as no length recurs.

    SciPy has no call for that, so 16 short transforms of each kind replace them.
    """
    from scipy import fft

    for n in range(1, 17):
        fft.rfft(np.zeros(n, np.float32))
        fft.fft(np.zeros(n, np.complex64))


ROUNDING_S: Final = 1e-8
"""A pulse that begins within this time of the last cut continues the pulse before it, in seconds."""


@dataclass(frozen=True, slots=True, eq=False)
class RfPulse:
    """An interval during which the light is on, from silence to silence.

    Attributes:
        start_s: Time when the first output begins to play.
        end_s: Time when the last output has ended.
        rows: Signal of the row output, in order of time.
        columns: Signal of the column output, in order of time.
        continued: Whether the pulse continues a pulse that was cut off at the end of the previous call.
    """

    start_s: float
    end_s: float
    rows: tuple[RfSpan, ...]
    columns: tuple[RfSpan, ...]
    continued: bool


class PulseReceiver:
    """Splits the signals of a driver's outputs into pulses, at the silences.

    Args:
        source: The outputs.
        silence_s: Shortest silence that ends a pulse.
        reach_hz: For each axis the tones that send light to the atoms. Other tones at rest count as silence.
    """

    def __init__(
        self,
        source: RfSource,
        silence_s: float,
        reach_hz: Sequence[tuple[float, float]] = (EVERYWHERE, EVERYWHERE),
    ) -> None:
        self._source = source
        self._silence_s = silence_s
        self._reach_hz = reach_hz
        self._cut_s = -math.inf
        self._seen: tuple[list[RfSpan], list[RfSpan]] = [], []

    def look(self, until_s: float) -> tuple[Sequence[RfSpan], Sequence[RfSpan], bool]:
        """Signals of rows and columns since the last received pulse, and whether light is on at a time.

        The next call of ``receive_until`` returns the same signals.
        """
        for seen, spans in zip(self._seen, self._source.played(until_s), strict=True):
            seen += spans
        is_on = any(
            end_s > until_s - self._silence_s
            for spans, reach_hz in zip(self._seen, self._reach_hz, strict=True)
            for span in spans
            for _, end_s in active_spans(span, reach_hz)
        )
        return *self._seen, is_on

    def receive_until(self, until_s: float) -> Iterator[RfPulse]:
        """The pulses played until a time. The last one is cut off there if it has not ended."""
        self.look(until_s)
        played, self._seen = self._seen, ([], [])
        cut_s, self._cut_s = self._cut_s, until_s
        times = [
            times
            for spans, reach_hz in zip(played, self._reach_hz, strict=True)
            for span in spans
            for times in active_spans(span, reach_hz)
        ]
        for start_s, end_s in _merged(times, self._silence_s):
            rows, columns = (_between(spans, start_s, end_s) for spans in played)
            yield RfPulse(start_s, end_s, rows, columns, start_s < cut_s + ROUNDING_S)


def _between(spans: Sequence[RfSpan], start_s: float, end_s: float) -> tuple[RfSpan, ...]:
    return tuple(span for span in spans if span.end_s > start_s and span.start_s < end_s)


def _merged(times: list[tuple[float, float]], silence_s: float) -> list[tuple[float, float]]:
    """Intervals in order, merged across silences that are too short."""
    joined: list[tuple[float, float]] = []
    for start_s, end_s in sorted(times):
        if joined and start_s - joined[-1][1] < silence_s:
            joined[-1] = joined[-1][0], max(joined[-1][1], end_s)
        else:
            joined.append((start_s, end_s))
    return joined
