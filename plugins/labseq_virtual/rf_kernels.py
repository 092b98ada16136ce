"""Kernels that find the tones in the spectra of an output, follow them and measure them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

POWER = const("float32", 2)
LINES = "float64[:, ::1]"
SPECTRA = const("complex64", 2)

YOUNG = 8
"""A track with fewer frames than this gives way to an older one."""


@helper_kernel()
def find_peaks(power: NDArray[np.float32], k: int, threshold: float, reach: int, found: Ints) -> int:
    """Find the peaks of spectrum k, each the greatest within ``reach`` bins, rising. Returns their number."""
    n = 0
    for b in range(1, power.shape[1] - 1):
        here = power[k, b]
        if here < threshold or here < power[k, b - 1] or here <= power[k, b + 1]:
            continue
        if n > 0 and b - found[n - 1] < reach:  # one of the two is a shoulder of the other
            if here > power[k, found[n - 1]]:
                found[n - 1] = b
        elif n < len(found):
            found[n] = b
            n += 1
    return n


@kernel(f"Tuple(({LINES}, int64[::1]))({POWER}, float64, int64, int64, int64)")
def find_tones(
    power: NDArray[np.float32], threshold: float, apart: int, reach: int, max_tones: int
) -> tuple[Floats, Ints]:
    """Find the tones in each spectrum as centroids of the power around its peaks.

    The centroid of a chirp is its mean frequency in the window. A tone includes the bins within
    ``reach`` of its peak, up to the middle between it and the next peak.

    Args:
        power: (n_frames, n_bins), squared magnitudes.
        threshold: Smallest power of a peak.
        apart: Smallest distance of two peaks, in bins.
        reach: Half the width of the part of a spectrum that belongs to a tone, in bins.
        max_tones: Maximum number of tones in a spectrum. Further tones are ignored.

    Returns:
        The tones in bins (n_frames, max_tones), rising, and their numbers (n_frames,).
    """
    n_frames, n_bins = power.shape
    centroid = np.full((n_frames, max_tones), np.nan)
    count = np.zeros(n_frames, np.int64)
    peak = np.zeros(max_tones, np.int64)
    for k in range(n_frames):
        count[k] = find_peaks(power, k, threshold, apart, peak)
        for i in range(count[k]):
            low, high = max(peak[i] - reach, 0), min(peak[i] + reach + 1, n_bins)
            if i > 0:
                low = max(low, (peak[i - 1] + peak[i] + 1) // 2)
            if i + 1 < count[k]:
                high = min(high, (peak[i] + peak[i + 1] + 1) // 2)
            total, moment = 0.0, 0.0
            for b in range(low, high):
                total += power[k, b]
                moment += power[k, b] * b
            centroid[k, i] = moment / total
    return centroid, count


@kernel(f"Tuple(({LINES}, int64))({LINES}, int64[::1], float64)")
def link_tones(centroid: Floats, count: Ints, slew: float) -> tuple[Floats, int]:
    """Follow tones from frame to frame by linear extrapolation of their last two frequencies.

    A tone that jumps may look like two tones for a moment. Then the older track continues.

    Args:
        centroid: Tones of each frame, rising, in bins (n_frames, most).
        count: Number of tones in each frame.
        slew: Largest distance of a tone from its extrapolated frequency, in bins.

    Returns:
        Tracks in bins (n_frames, n_columns), nan where off, and the number of used columns. A
        column may hold several tones one after the other, with a frame of nan between them.
    """
    n_frames, most = centroid.shape
    tracks = np.full((n_frames, 2 * most), np.nan)
    since = np.zeros(2 * most, np.int64)
    used = 0
    for k in range(n_frames):
        for i in range(count[k]):
            best, least = -1, slew
            for column in range(used if k > 0 else 0):
                place = tracks[k - 1, column]
                if math.isnan(place) or not math.isnan(tracks[k, column]):
                    continue
                if k - since[column] > 1:
                    place += place - tracks[k - 2, column]
                away = abs(centroid[k, i] - place)
                if k - since[column] < YOUNG:
                    away += slew / 2
                if away < least:
                    best, least = column, away
            for column in range(2 * most if best < 0 else 0):
                if math.isnan(tracks[k, column]) and (k == 0 or math.isnan(tracks[k - 1, column])):
                    best, since[column] = column, k
                    break
            if best >= 0:
                tracks[k, best] = centroid[k, i]
                used = max(used, best + 1)
    return tracks, used


@kernel(f"Tuple(({LINES}, {LINES}))({SPECTRA}, {LINES}, int64, int64, float64, float64)")
def measure_tones(
    spectra: NDArray[np.complex64], tracks: Floats, first: int, reach: int, width: float, hop: float
) -> tuple[Floats, Floats]:
    """Amplitude and phase of followed tones, from their overlap with a tone of the same chirp.

    A tone of amplitude 1 and phase 0 in the middle of the window ``exp(-(n / tau)^2)``, with a
    chirp of c bins per frame, has the spectrum ``sqrt(pi / p) exp(-pi^2 f^2 / p)`` with
    ``p = 1 / tau^2 - i pi c``. The overlap of the measured spectrum with this spectrum is the mean of the
    amplitude in the squared window. A tone ends in the middle between it and the next.

    Args:
        spectra: (n_frames, n_bins), with phases in the middle of the frames.
        tracks: (at least first + n_frames, n_tracks), in bins.
        first: Frame of the tracks for the first spectrum.
        reach: Half the width of a tone's part of a spectrum, in bins.
        width: The window's tau times the width of a bin, dimensionless.
        hop: From frame to frame, in units of one over the width of a bin.

    Returns:
        Amplitude and phase (rad) of each tone, (n_frames, n_tracks), nan where off. The
        amplitude is for a window of sum 1.
    """
    n_frames, n_bins = spectra.shape
    n_tracks = tracks.shape[1]
    amplitude = np.full((n_frames, n_tracks), np.nan)
    phase = np.full((n_frames, n_tracks), np.nan)
    for k in range(n_frames):
        for j in range(n_tracks):
            at = first + k
            here = tracks[at, j]
            if math.isnan(here):
                continue
            before = tracks[at - 1, j] if at > 0 else np.nan
            after = tracks[at + 1, j] if at + 1 < len(tracks) else np.nan
            chirp = 0.0
            if not math.isnan(before) and not math.isnan(after):
                chirp = (after - before) / (2 * hop)
            p = 1.0 / width**2 - 1j * math.pi * chirp
            scale = np.sqrt(1.0 / (width**2 * p))
            product, norm = 0j, 0.0
            low, high = max(here - reach, 0.0), min(here + reach, n_bins - 1.0)
            for other in tracks[at]:
                if other < here:
                    low = max(low, (here + other) / 2)
                elif other > here:
                    high = min(high, (here + other) / 2)
            for b in range(math.ceil(low), math.floor(high) + 1):
                shape = scale * np.exp(-((math.pi * (b - here)) ** 2) / p)
                product += spectra[k, b] * np.conj(shape)
                norm += shape.real**2 + shape.imag**2
            value = product / norm
            amplitude[k, j] = abs(value)
            phase[k, j] = math.atan2(value.imag, value.real)
    return amplitude, phase
