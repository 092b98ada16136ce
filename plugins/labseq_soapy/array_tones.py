"""The tones of both axes, on the radio at hand."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import DeviceError, LimitError
from labseq_soapy import tones
from labseq_soapy.output import Samples
from labseq_soapy.radio import Facts
from labseq_soapy.settings import SoapySettings

Floats = NDArray[np.float64]
Amplitudes = tuple[Floats, Floats]

RATE_ERROR: Final = 1e-6
"""How far the sample rate may be from the one that was asked for, as a fraction."""
TUNING_ERROR: Final = 0.01
"""How far the local oscillators may be from where they were asked to be, as a fraction of the sample rate."""


class ArrayTones:
    """Tones, local oscillator and loops of the array.

    Args:
        name: Name of the device, for messages.
        settings: Of the driver.
        shape: (n_rows, n_cols).

    Attributes:
        tones_hz: Tones of the rows and of the columns.
        oscillator_hz: Where the local oscillators shall be.
        crest_factor: Of the complex sums of the rows' and the columns' tones, as last made.
        loops: The tones on the grid of the loop; none before :meth:`tune`.

    Raises:
        LimitError: The tones span more than 80 % of the sample rate, or no loop holds them all.
    """

    def __init__(self, name: str, settings: SoapySettings, shape: tuple[int, int]) -> None:
        self._name, self._settings = name, settings
        n_rows, n_cols = shape
        self.tones_hz = settings.row_frequency.tones(n_rows), settings.column_frequency.tones(n_cols)
        chosen = settings.local_oscillator
        self.oscillator_hz = tones.local_oscillator(self.tones_hz) if chosen is None else chosen
        self.crest_factor: tuple[float, ...] = ()
        self.loops: tuple[tones.AxisLoop, ...] = ()
        self._n_samples(settings.sample_rate, (self.oscillator_hz, self.oscillator_hz))

    def tune(self, facts: Facts) -> None:
        """Lay the loops out for the rate and the local oscillators that the radio really has.

        Raises:
            DeviceError: They are others than asked for.
            LimitError: No loop holds all tones.
        """
        asked_hz = self._settings.sample_rate
        if abs(facts.rate_hz - asked_hz) > RATE_ERROR * asked_hz:
            text = f"the radio makes {facts.rate_hz:.10g} samples per second; expected {asked_hz:.10g}"
            raise DeviceError(self._name, f"{text}: choose a sample_rate that it has")
        for found_hz in facts.oscillator_hz:
            if abs(found_hz - self.oscillator_hz) > TUNING_ERROR * asked_hz:
                text = f"the radio tuned its local oscillator to {found_hz:.10g} Hz"
                raise DeviceError(self._name, f"{text}; expected {self.oscillator_hz:.10g} Hz: see its range")
        n_samples = self._n_samples(facts.rate_hz, facts.oscillator_hz)
        self.loops = tuple(
            tones.axis_loop(tones_hz - oscillator_hz, n_samples, facts.rate_hz)
            for tones_hz, oscillator_hz in zip(self.tones_hz, facts.oscillator_hz, strict=True)
        )

    def samples(self, amplitudes: Amplitudes) -> Samples:
        """One loop of both axes, in the order of their channels, float32 (2, 2 n), I and Q in turn.

        Args:
            amplitudes: Of the rows (n_rows,) and columns (n_cols,), fractions of full scale.

        Raises:
            LimitError: Not one amplitude for each tone, a bad one, or their sum exceeds full scale.
        """
        made: list[NDArray[np.complex64]] = []
        for axis, values, loop in zip(("row", "column"), amplitudes, self.loops, strict=True):
            what, shape = f"{self._name}: shape of the {axis} amplitudes", loop.cycles.shape
            if values.shape != shape:
                raise LimitError(what, values.shape, shape)
            if not (np.isfinite(values).all() and (values >= 0).all()):
                raise LimitError(f"{self._name}: a {axis} amplitude", "negative or not finite", "0 or more")
            made.append(loop.samples(values))
            peak = float(np.abs(made[-1]).max()) * max(1.0, self._settings.max_depth) ** 0.25
            if peak > 1.0 + 1e-6:
                hint = "lower the amplitudes, or max_depth, and raise the gain"
                raise LimitError(
                    f"{self._name}: peak of the {axis} tones", f"{peak:.3g} of full scale", "1", hint
                )
        self.crest_factor = tuple(tones.crest_factor(axis) for axis in made)
        order = np.argsort([self._settings.row_channel, self._settings.column_channel])
        return np.stack([made[axis].view(np.float32) for axis in order])

    def _n_samples(self, rate_hz: float, oscillators_hz: tuple[float, float]) -> int:
        offsets_hz: list[Floats] = []
        for axis, tones_hz, oscillator_hz in zip(
            ("row", "column"), self.tones_hz, oscillators_hz, strict=True
        ):
            tones.check_span(f"{self._name}: {axis} tones", tones_hz, oscillator_hz, rate_hz)
            offsets_hz.append(tones_hz - oscillator_hz)
        all_hz = np.unique(np.concatenate(offsets_hz))
        return tones.shortest_loop(self._name, all_hz, rate_hz, self._settings.tone_tolerance)
