"""The step that equalises the static tweezers in a closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from labseq.errors import DeviceError
from labseq.imaging.equalising_loop import LoopLimits, equalise_loop
from labseq.model import TimelineEntry
from labseq.roles import Device, Shot, StepContext

Floats = NDArray[np.float64]

READINGS: Final = "equalise."
"""What the names of the readings begin with that the step leaves."""


class _Settings(Protocol):
    @property
    def device(self) -> str: ...
    @property
    def value(self) -> str: ...
    @property
    def spread(self) -> float: ...
    @property
    def gain(self) -> float: ...
    @property
    def max_sum(self) -> float: ...
    @property
    def max_averages(self) -> int: ...
    @property
    def max_rounds(self) -> int: ...


class EqualiseStep:
    """Measures the power of each static tweezer, and corrects the rows' and columns' tones until it is even.

    A device of the profile measures: its value is an array (n_rows, n_cols) of spot powers on a camera, light
    shifts, or anything else that goes with the depth; nan where it cannot tell.
    """

    needs_image = False
    takes_image = False

    def __init__(self, settings: _Settings) -> None:
        self.settings = settings

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:  # noqa: ARG002 - Protocol
        """One bar without a known length."""
        return [TimelineEntry(f"equalise by {self.settings.device}", 0.0, 0.0)]

    def run(self, shot: Shot) -> None:
        """Turn the array on and run the loop; what it found stays in force, and among the shot's readings.

        Raises:
            DeviceError: The loop does not arrive; it says why. Or the device's value is no such array.
        """
        settings, tweezers = self.settings, shot.static_tweezers
        limit_s, device = shot.call_timeout_s, shot.device(settings.device)
        shot.call("static_tweezers", limit_s, tweezers.start)
        limits = LoopLimits(
            settings.spread, settings.gain, settings.max_sum, settings.max_averages, settings.max_rounds
        )

        def apply(rows: Floats, cols: Floats) -> None:
            shot.call("static_tweezers", limit_s, tweezers.load, (rows, cols))

        before: list[Floats] = []

        def measure() -> Floats:
            power = self._measure(shot, device)
            before.append(power) if not before else None
            return power

        rows, cols = _in_force(shot)
        with shot.stage("equalise"):
            found = equalise_loop(measure, apply, rows, cols, limits)
            after = self._measure(shot, device)
        equalised = found.equalised
        shot.note(READINGS + "row_amplitudes", equalised.row_amplitudes.tolist())
        shot.note(READINGS + "column_amplitudes", equalised.column_amplitudes.tolist())
        shot.note(READINGS + "separable_spread", equalised.separable_spread)
        shot.note(READINGS + "residual_spread", equalised.residual_spread)
        shot.note(READINGS + "noise", found.noise)
        shot.note(READINGS + "spreads", list(found.spreads))
        shot.note(READINGS + "n_measured", found.n_measured)
        shot.note(READINGS + "power_before", before[0].tolist())
        shot.note(READINGS + "power_after", after.tolist())

    def _measure(self, shot: Shot, device: Device) -> Floats:
        """One measurement, float64 (n_rows, n_cols)."""
        name, value = self.settings.device, self.settings.value
        answer = shot.call(name, shot.call_timeout_s, device.read, value)
        try:
            power = np.asarray(answer, np.float64)
        except (TypeError, ValueError):
            power = np.array(np.nan)
        if power.shape != shot.grid.shape:
            came = power.shape if power.ndim else type(answer).__name__
            text = f"its value '{value}' is {came}; expected the power of each of {shot.grid.shape} tweezers"
            raise DeviceError(name, text)
        return power


def _in_force(shot: Shot) -> tuple[Floats, Floats]:
    """Where to begin: the calibration in use; without one all equal, full scale together."""
    entry = shot.calibrations.get("tweezers")
    if entry is not None:
        return entry.values["row_amplitudes"], entry.values["column_amplitudes"]
    n_rows, n_cols = shot.grid.shape
    return np.full(n_rows, 1 / n_rows), np.full(n_cols, 1 / n_cols)
