"""The virtual static tweezers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Context, DepthRamp, DeviceError, LimitError, TweezerAmplitudes
from labseq_virtual.driver import VirtualDriver
from labseq_virtual.settings import StaticTweezersSettings

Amplitudes = tuple[NDArray[np.float64], NDArray[np.float64]]


class VirtualStaticTweezers(VirtualDriver):
    """The static array of the simulated world.

    The world's depths follow the tones' amplitudes, ``start`` and ``ramp``.

    Args:
        settings: Limits.
        context: Grid, clock and the simulated world.
    """

    def __init__(self, settings: StaticTweezersSettings, context: Context) -> None:
        super().__init__(context, "static_tweezers")
        self._settings = settings
        self._grid = context.grid
        self._amplitudes: Amplitudes | None = None
        self._calibrated = _calibrated(context)
        self._depth = 0.0

    def load(self, amplitudes: Amplitudes | None) -> None:
        """Set the tone amplitudes of the rows (n_rows,) and columns (n_cols,); None: as calibrated.

        Raises:
            LimitError: Wrong number of tones, negative or not finite, or too much together.
        """
        self._check_open()
        if amplitudes is not None:
            self._check(amplitudes)
        self._amplitudes = amplitudes
        rows, cols = self._calibrated if amplitudes is None else amplitudes
        self._world.play("static_tweezers", TweezerAmplitudes(rows, cols), self._clock.now())

    def start(self) -> None:
        """Bring the array to its nominal depth; no effect if it is there."""
        self._check_open()
        if self._depth == 0.0:
            self.load(self._amplitudes)
        if self._depth != 1.0:
            self._play(1.0, 0.0)

    def ramp(self, depth: float, duration_s: float) -> None:
        """Change the depth linearly; returns when the ramp has ended.

        Raises:
            LimitError: A depth or duration that the array cannot have.
        """
        self._check_open()
        deepest = self._settings.max_depth
        if not 0 <= depth <= deepest:
            raise LimitError(
                f"{self._name}: depth", f"{depth:g} of the nominal depth", f"0 to {deepest:g} of it"
            )
        if not 0 <= duration_s < float("inf"):
            raise LimitError(f"{self._name}: duration of the ramp", f"{duration_s:g} s", "0 or more")
        self._play(depth, duration_s)
        self._clock.sleep(duration_s)

    def safe_state(self) -> None:
        """Turn the array off at once."""
        if self._depth > 0.0:
            self._play(0.0, 0.0)

    def self_test(self) -> None:
        """See whether the array can have the calibrated amplitudes; no light goes on.

        Raises:
            DeviceError: Not open, or it cannot.
        """
        self._check_open()
        try:
            self._check(self._calibrated)
        except LimitError as error:
            raise DeviceError(self._name, f"it cannot have the calibrated amplitudes: {error}") from error

    def describe(self) -> Mapping[str, Any]:
        """Model, settings, depth and amplitudes in force."""
        tones = self._amplitudes
        amplitudes = (
            "calibrated" if tones is None else {"row": tones[0].tolist(), "column": tones[1].tolist()}
        )
        return {
            "model": "virtual static tweezers",
            "depth": self._depth,
            "amplitudes": amplitudes,
            **self._settings.model_dump(mode="json"),
        }

    def _play(self, depth: float, duration_s: float) -> None:
        start, self._depth = self._depth, depth
        self._world.play("static_tweezers", DepthRamp(start, depth, duration_s), self._clock.now())

    def _check(self, amplitudes: Amplitudes) -> None:
        rows, cols = amplitudes
        self._check_axis("row", rows, self._grid.n_rows)
        self._check_axis("column", cols, self._grid.n_cols)

    def _check_axis(self, axis: str, amplitudes: NDArray[np.float64], n_tones: int) -> None:
        if amplitudes.shape != (n_tones,):
            raise LimitError(f"{self._name}: shape of the {axis} amplitudes", amplitudes.shape, (n_tones,))
        if not (np.isfinite(amplitudes).all() and (amplitudes >= 0).all()):
            raise LimitError(f"{self._name}: a {axis} amplitude", "negative or not finite", "0 or more")
        total, most = float(amplitudes.sum()), self._settings.max_amplitude_sum
        if total > most + 1e-9:
            raise LimitError(f"{self._name}: sum of the {axis} amplitudes", f"{total:g}", f"{most:g}")


def _calibrated(context: Context) -> Amplitudes:
    """The amplitudes of the calibration in use; without one all equal, full scale together."""
    found = context.calibrations.get("tweezers")
    if found is None:
        n_rows, n_cols = context.grid.shape
        return np.full(n_rows, 1 / n_rows), np.full(n_cols, 1 / n_cols)
    return found.values["row_amplitudes"], found.values["column_amplitudes"]
