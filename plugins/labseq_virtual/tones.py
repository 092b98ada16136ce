"""The tones that an AOD finds in what it is driven with.

The light that an AOD sends to one place of the focal plane is the Fourier component of the
acoustic wave within the beam: the spectrum of the last microseconds, in a window that is
the beam's profile. So the spectra here are both a measurement and the AOD's own answer: a jump
of amplitude, phase or frequency acts as softly as the sound crosses the beam.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import LimitError, MotionSpec, RfSpan, SiteGrid, format_quantity
from labseq_virtual.envelope import Band, envelope

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
    from labseq_virtual._kernels_tones import find_tones, link_tones, measure_tones

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
