"""What frequencies samples hold, and how far they swing, in the columns of a picture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.motion import Renderer
from labseq.motion.rendering import FULL_SCALE

WINDOW_S: Final = 6e-6
"""Length of a Hann window: tones 0.5 MHz apart are told from one another, and a chirp of 1.6 MHz
per site, of about 35 us, moves by less than that."""

MAX_WINDOWS: Final = 8
"""Windows whose power is averaged in a column, at most; a long program is only sampled."""

AT_ONCE: Final = 32
"""Windows that are transformed together: a few megabytes."""

CHUNK: Final = 1 << 18
"""Samples that are looked at together."""

FLOOR: Final = 1e-12
"""Power that counts as none, relative to a tone at full scale."""


@dataclass(frozen=True, slots=True)
class WaveformPieces:
    """Pieces of a waveform, laid end to end: what a picture shows of it.

    Attributes:
        first: int64 (n,), first sample of each piece in the waveform.
        at: int64 (n + 1,), where each piece starts in the picture, in samples, and the end.
    """

    first: NDArray[np.int64]
    at: NDArray[np.int64]

    @classmethod
    def of(cls, pieces: list[tuple[int, int]]) -> WaveformPieces:
        """Lay pieces end to end.

        Args:
            pieces: First sample of each, and the one after its last.

        Example:
            >>> Stretches.of([(10, 14), (20, 25)]).at.tolist()
            [0, 4, 9]
        """
        bounds = np.array(pieces, np.int64).reshape(-1, 2)
        lengths = bounds[:, 1] - bounds[:, 0]
        return cls(bounds[:, 0], np.concatenate([[0], np.cumsum(lengths)]))

    @property
    def n_samples(self) -> int:
        """Samples in all pieces together."""
        return int(self.at[-1])

    def in_waveform(self, place: NDArray[np.int64]) -> NDArray[np.int64]:
        """Samples of the waveform at places in the picture, in samples."""
        piece = np.searchsorted(self.at[1:-1], place, side="right")
        return place - self.at[piece] + self.first[piece]


def spectrogram(
    renderer: Renderer, channel: int, stretches: WaveformPieces, n_columns: int, band_hz: tuple[float, float]
) -> tuple[NDArray[np.float32], tuple[float, float]]:
    """Find out how strong each frequency is, column by column, without ever holding all samples.

    Args:
        renderer: Makes the samples.
        channel: 0 for the row tones, 1 for the column tones.
        stretches: What is shown.
        n_columns: How many columns.
        band_hz: Lowest and highest frequency that are asked for.

    Returns:
        float32 (n_bins, n_columns), in dB relative to a tone at full scale, low frequencies first,
        and the frequencies of the lower edge of the first bin and the upper edge of the last.
    """
    rate_hz = renderer.sample_rate_hz
    length = max(16, round(WINDOW_S * rate_hz))
    n_fft = 2 << (length - 1).bit_length()
    window = np.hanning(length).astype(np.float32)
    low, high = (int(np.rint(hz / rate_hz * n_fft)) for hz in band_hz)
    low, high = max(0, low), min(n_fft // 2, max(low, high))
    wide = stretches.n_samples / n_columns
    n_windows = min(MAX_WINDOWS, math.ceil(2 * wide / length))
    centre = (np.arange(n_columns * n_windows) + 0.5) * (wide / n_windows)
    start = np.maximum(0, stretches.in_waveform(centre.astype(np.int64)) - length // 2)
    samples = np.empty((AT_ONCE, length), np.int16)
    power = np.empty((len(start), high - low + 1), np.float32)
    for i in range(0, len(start), AT_ONCE):
        its = start[i : i + AT_ONCE]
        for out, first in zip(samples, its, strict=False):
            renderer.write(channel, int(first), out)
        spectrum = np.fft.rfft(samples[: len(its)] * window, n_fft)[:, low : high + 1]
        power[i : i + len(its)] = (2 / (window.sum() * FULL_SCALE) * np.abs(spectrum)) ** 2
    mean = power.reshape(n_columns, n_windows, -1).mean(axis=1)
    level_db = 10 * np.log10(np.maximum(mean, FLOOR))
    edges_hz = (low - 0.5) * rate_hz / n_fft, (high + 0.5) * rate_hz / n_fft
    return level_db.T.astype(np.float32), edges_hz


def envelope(renderer: Renderer, channel: int, stretches: WaveformPieces, n_columns: int) -> NDArray[np.float64]:
    """Find the largest sample of each column, looking at every sample.

    Args:
        renderer: Makes the samples.
        channel: 0 for the row tones, 1 for the column tones.
        stretches: What is shown.
        n_columns: How many columns.

    Returns:
        float64 (n_columns,), absolute values as fractions of full scale.
    """
    edges = np.rint(np.linspace(0, stretches.n_samples, n_columns + 1)).astype(np.int64)
    cuts = np.unique(np.concatenate([edges, stretches.at]))
    column = np.searchsorted(edges, cuts[:-1], side="right") - 1
    first = stretches.in_waveform(cuts[:-1])
    out = np.empty(CHUNK, np.int16)
    largest = np.zeros(n_columns)
    for k, start, n in zip(column.tolist(), first.tolist(), np.diff(cuts).tolist(), strict=True):
        for at in range(0, n, CHUNK):
            part = out[: min(CHUNK, n - at)]
            renderer.write(channel, start + at, part)
            largest[k] = max(largest[k], int(part.max()), -int(part.min()))
    return largest / FULL_SCALE
