"""The amplitudes of the tones that the simulated radio plays, for a simulation that receives them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import TweezerAmplitudes
from labseq_soapy_sim.ring import Ring

DECIMALS: Final = 6
"""Decimals of the amplitudes, coarser than the rounding of float32 and too fine to matter to an atom."""

Floats = NDArray[np.float64]


class CapturedOutputs:
    """The two connectors of a simulated radio.

    Implements ``labseq.plugin.simulation.ToneSource``. Amplitudes are measured at the frequencies where the
    tones should be. A signal at another frequency, because the local oscillator or the sample rate is wrong,
    makes no tweezers. Nor does the leakage of the oscillator, unless it is on a tone.

    Args:
        ring: The samples that the radio received.
        tones_hz: Tones of the rows and of the columns.
        channels: Channel of the rows and of the columns.
    """

    def __init__(self, ring: Ring, tones_hz: tuple[Floats, Floats], channels: tuple[int, int]) -> None:
        self._ring = ring
        self._axes = tuple(zip(tones_hz, channels, strict=True))
        self._changes: list[TweezerAmplitudes] = []
        self._last = tuple(np.zeros(len(tones)) for tones in tones_hz)
        self._underflows = int(ring["underflows"])
        self._filters: dict[tuple[int, float, float, float], NDArray[np.complex128]] = {}

    def measure(self) -> None:
        """Record the amplitudes if they have changed. An underflow is recorded as darkness in between."""
        underflows = int(self._ring["underflows"])
        if underflows != self._underflows:
            self._underflows = underflows
            self._record(tuple(np.zeros_like(values) for values in self._last))
        self._record(self._now())

    def end_silence(self) -> None:
        """Record the amplitudes after a silence, and how long it was in samples that the radio was sent."""
        self._record(self._now(), float(self._ring["silence"]) / float(self._ring["rate_hz"]))

    def played(self, until_s: float) -> Sequence[TweezerAmplitudes]:  # noqa: ARG002 - all changes are in the past
        """The amplitudes since the last call, in time's order, empty if unchanged."""
        self.measure()
        changes, self._changes = self._changes, []
        return changes

    def _record(self, amplitudes: tuple[Floats, ...], dark_s: float = 0.0) -> None:
        same = all(np.array_equal(now, last) for now, last in zip(amplitudes, self._last, strict=True))
        if same and not dark_s:
            return
        self._last = amplitudes
        rows, cols = amplitudes
        self._changes.append(TweezerAmplitudes(rows, cols, dark_s))

    def _now(self) -> tuple[Floats, ...]:
        if not self._ring.is_playing:
            return tuple(np.zeros_like(values) for values in self._last)
        return tuple(self._amplitudes(tones_hz, channel) for tones_hz, channel in self._axes)

    def _amplitudes(self, tones_hz: Floats, channel: int) -> Floats:
        rate_hz, zero_hz = float(self._ring["rate_hz"]), float(self._ring["frequency_hz"][channel])
        leaks_hz = float(self._ring["oscillator_hz"][channel])
        spacing_hz = float(np.diff(np.sort(tones_hz)).min()) if len(tones_hz) > 1 else rate_hz / 100
        n = int(np.clip(8 * rate_hz / spacing_hz, 2048, 1 << 16))
        key = channel, rate_hz, zero_hz, leaks_hz
        if key not in self._filters:
            is_apart = np.abs(tones_hz - leaks_hz).min() > rate_hz / n
            known_hz = np.append(tones_hz, leaks_hz) if is_apart else tones_hz
            self._filters[key] = _least_squares(known_hz - zero_hz, n, rate_hz)[: len(tones_hz)]
        samples = self._ring.output(n)[channel]
        if len(samples) < n:
            return np.zeros(len(tones_hz))
        found = np.einsum("ij,j", self._filters[key], samples)  # BLAS would wake its threads for this
        return np.round(np.abs(found), DECIMALS)


def _least_squares(offsets_hz: Floats, n: int, rate_hz: float) -> NDArray[np.complex128]:
    """Matrix that gives the tones' complex amplitudes from samples, complex128 (n_tones, n)."""
    waves = np.exp(-2j * np.pi * np.outer(offsets_hz, np.arange(n) / rate_hz))
    overlaps = np.einsum("it,jt", waves, waves.conj())
    return np.einsum("ij,jt", np.linalg.inv(overlaps), waves)
