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

from labseq.model import RfSpan
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
"""Spectra worked out together: they stay in the cache."""


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


def follow_tones(
    spans: Sequence[RfSpan],
    start_s: float,
    end_s: float,
    band: Band,
    transit_s: float,
    least_v: float,
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
        least_v: Least amplitude of a tone.
        slew_hz: Most that a tone's frequency changes in a transit time.
    """
    from scipy import fft

    from labseq_virtual._kernels_tones import find_tones, link_tones, measure_tones

    signal = envelope(spans, start_s, end_s, band)
    hop = max(1, round(transit_s / HOPS * signal.rate_hz))
    n_window = cast("int", fft.next_fast_len(round(WINDOW * transit_s * signal.rate_hz)))
    middle = n_window // 2
    tau = transit_s / 2 * signal.rate_hz
    window = np.exp(-(((np.arange(n_window) - middle) / tau) ** 2))
    window = (window / window.sum()).astype(np.float32)
    n_frames = max(0, (len(signal.values) - n_window) // hop + 1)
    frames = np.lib.stride_tricks.sliding_window_view(signal.values, n_window)[::hop][:n_frames]
    spectra = np.empty((n_frames, n_window), np.complex64)
    for first in range(0, n_frames, FRAMES):
        part = slice(first, first + FRAMES)
        spectra[part] = cast("NDArray[np.complex64]", fft.fft(frames[part] * window, overwrite_x=True))
    turn = np.exp(2j * np.pi * (np.arange(n_window) * middle % n_window) / n_window)
    spectra *= turn.astype(np.complex64)  # phases of the middle, not of the start
    bin_hz = signal.rate_hz / n_window
    reach = max(2, round(REACH_HZ / bin_hz))
    power = spectra.real**2 + spectra.imag**2
    apart = max(2, round(APART_HZ / bin_hz))
    centroid, count = find_tones(power, least_v**2, apart, reach, MOST)
    tracks, n_tracks = link_tones(centroid, count, slew_hz / HOPS / bin_hz)
    tracks = np.ascontiguousarray(tracks[:, :n_tracks])
    amplitude, phase = measure_tones(spectra, tracks, reach, tau / n_window, hop / n_window)
    t_s = signal.start_s + (np.arange(n_frames) * hop + middle) / signal.rate_hz
    phase += 2 * np.pi * ((t_s - signal.start_s) * signal.low_hz % 1.0)[:, None]
    return Tracks(t_s, signal.low_hz + tracks * bin_hz, amplitude, phase)
