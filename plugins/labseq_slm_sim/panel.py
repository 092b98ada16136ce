"""The simulated SLM and its optics, which differ from the driver's settings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from labseq_slm.optics import Optics, beam, zernike_phase
from labseq_slm.retrieval import FarField
from labseq_slm.settings import SlmSettings
from numpy.typing import NDArray

from labseq.plugin import Context, DeviceError, TweezerAmplitudes
from labseq.plugin.simulation import ReceivesOutput

RESPONSE_S: Final = 8e-3
"""Time constant with which the phase of a liquid crystal follows (ours, makers say 5 to 30 ms)."""
FOLLOWED: Final = 7.0
"""Time constants after which the phase counts as reached."""
NOMINAL: Final = 0.75
"""Part of the light in the sites together, with which they have their nominal depth (ours)."""
DECIMALS: Final = 4
"""Decimals of the powers, coarser than the rounding of float32 and too fine to matter to an atom."""

Levels = NDArray[np.uint8]


class SimulatedSlm:
    """Takes grey levels, and gives each site of a simulation the light that its optics send there.

    The phase of a level, the beam and the optics have the errors that ``settings.errors`` says. Square
    pixels without gaps send less light to sites that are far from the zeroth order. Implements
    ``labseq.plugin.simulation.ToneSource``.

    Args:
        name: Name of the device.
        settings: Settings of the driver, with the errors.
        optics: Where the sites are.
        context: Grid, clock, and the simulation, which receives the powers if it implements
            ``ReceivesOutput``.
    """

    def __init__(self, name: str, settings: SlmSettings, optics: Optics, context: Context) -> None:
        self._name, self._settings, self._optics = name, settings, optics
        self._shape, self._clock, self._simulation = context.grid.shape, context.clock, context.simulation
        self._field: FarField | None = None
        self._optical = np.zeros(0, np.float32)
        self._before = self._phase = np.zeros(0, np.float32)
        self._shown_s = -math.inf
        self._is_new = False

    def open(self) -> None:
        """Connect to the simulation. The panel is at grey level 0."""
        errors, pixels = self._settings.errors, self._settings.pixels
        shift_px = errors.beam_shift / self._settings.pixel_pitch
        light = beam(pixels, self._optics.beam_px * (1 + errors.beam_waist), shift_px)
        self._field = FarField(self._optics, light)
        self._optical = zernike_phase(errors.aberration, pixels)
        self._before = self._phase = np.zeros(pixels, np.float32)
        self._shown_s, self._is_new = -math.inf, True
        if isinstance(self._simulation, ReceivesOutput):
            self._simulation.connect_outputs("static_tweezers", self)

    def close(self) -> None:
        """Disconnect. The panel keeps its picture."""
        self._field = None

    def show(self, levels: Levels) -> None:
        """Take grey levels.

        Raises:
            DeviceError: Not open, not 8 bits, or not one for each pixel.
        """
        pixels = self._settings.pixels
        if self._field is None:
            raise DeviceError(self._name, "the simulated SLM is not open")
        if levels.shape != pixels or levels.dtype != np.uint8:
            text = f"the simulated SLM got {levels.dtype} of shape {levels.shape}, not uint8 of {pixels}"
            raise DeviceError(self._name, text)
        self._before = self._phase_at(self._clock.now())
        errors, x = self._settings.errors, np.arange(256) / 256
        table = 2 * np.pi * x * (1 + errors.phase_range) + errors.phase_curve * np.sin(2 * np.pi * x)
        self._phase = table.astype(np.float32)[levels]
        self._shown_s, self._is_new = self._clock.now(), True

    def played(self, until_s: float) -> Sequence[TweezerAmplitudes]:
        """The powers of the sites, if they have changed since the last call."""
        if not self._is_new or self._field is None:
            return ()
        self._is_new = until_s < self._shown_s + FOLLOWED * RESPONSE_S
        rows, columns = (np.full(n, 1 / n) for n in self._shape)
        return [TweezerAmplitudes(rows, columns, site=self.powers(until_s))]

    def versions(self) -> dict[str, tuple[str, str]]:
        """None."""
        return {}

    def powers(self, t_s: float) -> NDArray[np.float64]:
        """Power at each site at a time, float64 (n_rows, n_cols), relative to the nominal one."""
        assert self._field is not None
        phase = self._phase_at(t_s) + self._optical
        reached = np.abs(self._field.at_sites(np.exp(1j * phase).astype(np.complex64))) ** 2
        half = self._optics.row_rad / (2 * np.pi), self._optics.column_rad / (2 * np.pi)
        envelope = (np.sinc(half[0]) * np.sinc(half[1])) ** 2  # of a square pixel
        power = reached * envelope * len(reached) / NOMINAL
        return np.round(power.astype(np.float64), DECIMALS).reshape(self._shape)

    def _phase_at(self, t_s: float) -> NDArray[np.float32]:
        passed = (t_s - self._shown_s) / RESPONSE_S
        if passed >= FOLLOWED:
            return self._phase
        left = np.float32(math.exp(-max(passed, 0.0)))
        return (self._phase + (self._before - self._phase) * left).astype(np.float32, copy=False)
