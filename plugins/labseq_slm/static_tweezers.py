"""Static tweezers by an SLM."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Context, DeviceError, LimitError, Problem, StaticTweezers, TweezersFacts
from labseq.plugin.tweezers import Amplitudes, calibrated_weights, check_weights
from labseq_slm.levels import BadFileError, levels_of, nearest_levels, read_correction, read_look_up_table
from labseq_slm.optics import beam, optics_of, zernike_phase
from labseq_slm.outputs import choose_output
from labseq_slm.retrieval import FarField, phasors_of, retrieve
from labseq_slm.settings import SlmSettings

Floats = NDArray[np.float64]


class SlmStaticTweezers(StaticTweezers):
    """Shows the phases that send the light to the sites, each with its weight.

    An SLM distributes the light and cannot switch it. While the array is off it shows random phases,
    which spread the light over the whole field, so neither the sites nor the zeroth order are bright.

    Args:
        settings: The SLM, its optics and corrections.
        context: Name, grid, clock, simulation, calibrated weights.

    Raises:
        LimitError: The sites do not fit into the field, are on the zeroth order, or too close together.
    """

    def __init__(self, settings: SlmSettings, context: Context) -> None:
        self._name = context.name or "static_tweezers"
        self._settings, self._grid, self._clock = settings, context.grid, context.clock
        self._optics = optics_of(self._name, settings, context.grid)
        self._calibrated = calibrated_weights(context)
        self._weights: Floats | None = None
        self._output = choose_output(self._name, settings, self._optics, context)
        self._depth = 0.0
        self._nearest: NDArray[np.uint8] | None = None  # None while not open
        self._added = np.zeros(0, np.float32)
        self._efficiency = 0.0

    @property
    def facts(self) -> TweezersFacts:
        """Each site has a weight. The light cannot be ramped."""
        return TweezersFacts(control="sites", ramps=False)

    def check_settings(self) -> Mapping[str, Problem]:
        """Files that are missing or wrong."""
        problems: dict[str, Problem] = {}
        for setting, read in (
            ("look_up_table", lambda: read_look_up_table(self._settings.look_up_table)),
            ("correction", lambda: read_correction(self._settings.correction, self._settings.pixels)),
        ):
            try:
                read()
            except BadFileError as error:
                problem = error.problem
                problems[setting] = Problem(f"{problem.source}: {problem.what}", expected=problem.expected)
        return problems

    def warm(self) -> None:
        """Find the phases for the calibrated weights, which the cache then has."""
        retrieve(self._optics, self._calibrated.ravel())

    def open(self) -> None:
        """Read the files and show random phases. No effect if it is open.

        Raises:
            DeviceError: A file is wrong, or the output cannot be opened.
        """
        if self._nearest is not None:
            return
        settings = self._settings
        try:
            nearest = nearest_levels(read_look_up_table(settings.look_up_table))
            correction = read_correction(settings.correction, settings.pixels)
        except BadFileError as error:
            raise DeviceError(self._name, str(error)) from error
        self._added = correction + zernike_phase(settings.zernike, settings.pixels)
        self._output.open()
        self._nearest = nearest
        self._darken()

    def close(self) -> None:
        """Show random phases and disconnect. Legal in any state."""
        try:
            self.safe_state()
        finally:
            self._nearest, self._weights = None, None
            self._output.close()

    def safe_state(self) -> None:
        """Show random phases. No effect if it does already."""
        if self._nearest is not None and self._depth:
            self._darken()

    def load(self, amplitudes: Amplitudes | None) -> None:
        """Go back to the calibrated weights.

        Raises:
            LimitError: Amplitudes of tones, which an SLM does not have.
        """
        self._opened()
        if amplitudes is not None:
            limit = "None, or weights of the sites (load_weights)"
            raise LimitError(f"{self._name}: amplitudes of tones", "given", limit)
        self._load(None)

    def load_weights(self, weights: Floats) -> None:
        """Set the share of the light that each site is to have, float64 (n_rows, n_cols).

        Raises:
            LimitError: A wrong shape, or weights that are not above 0.
        """
        self._opened()
        check_weights(self._name, weights, self._grid.shape)
        self._load(weights / weights.mean())

    def start(self) -> None:
        """Show the array. No effect if it is shown."""
        self._opened()
        if self._depth != 1.0:
            self._show_array()

    def ramp(self, depth: float, duration_s: float) -> None:
        """Switch the array on (1) or off (0).

        Raises:
            LimitError: Another depth, or a negative duration.
        """
        self._opened()
        if depth not in (0.0, 1.0) or not 0 <= duration_s < np.inf:
            value = f"to {depth:g} of the nominal depth within {duration_s:g} s"
            limit = "0 or 1, since an SLM only distributes the light"
            raise LimitError(f"{self._name}: ramp", value, limit)
        self.start() if depth else self.safe_state()

    def self_test(self) -> None:
        """Check that the SLM takes grey levels. It shows random phases again.

        Raises:
            DeviceError: It is not open, or does not take them.
        """
        self._opened()
        self._darken()

    def versions(self) -> Mapping[str, tuple[str, str]]:
        """Versions of the packages that the output uses."""
        return self._output.versions()

    def describe(self) -> Mapping[str, Any]:
        """Settings, depth, weights, and the part of the light that reaches the sites by computation."""
        return {
            "model": f"SLM, {self._settings.output}",
            "depth": self._depth,
            "weights": "calibrated" if self._weights is None else self._weights.tolist(),
            "efficiency": self._efficiency,
            **self._settings.model_dump(mode="json"),
        }

    def _load(self, weights: Floats | None) -> None:
        self._weights = weights
        if self._depth:
            self._show_array()

    def _show_array(self) -> None:
        weights = self._calibrated if self._weights is None else self._weights
        coefficients = retrieve(self._optics, weights.ravel())
        field = FarField(self._optics, beam(self._optics.pixels, self._optics.beam_px))
        phasors = phasors_of(field.light(coefficients))
        self._efficiency = float((np.abs(field.at_sites(phasors)) ** 2).sum())
        self._show(np.angle(phasors))
        self._depth = 1.0

    def _darken(self) -> None:
        phases = np.random.default_rng(0).uniform(0, 2 * np.pi, self._settings.pixels)
        self._show(phases.astype(np.float32))
        self._depth = 0.0

    def _show(self, phase: NDArray[np.float32]) -> None:
        self._output.show(levels_of(phase + self._added, self._opened()))
        self._clock.sleep(self._settings.settle)

    def _opened(self) -> NDArray[np.uint8]:
        if self._nearest is None:
            raise DeviceError(self._name, "not open; call open() first")
        return self._nearest
