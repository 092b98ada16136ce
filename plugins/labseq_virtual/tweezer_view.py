"""The view of a camera that images the light of the tweezers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Frame, LimitError, RandomStream, SensorMode, Signal, Simulation, SiteGrid
from labseq.plugin.simulation import WHOLE_SENSOR
from labseq_virtual.images import Images, Light
from labseq_virtual.mobile_light import MobileLight, MobileTones
from labseq_virtual.sensors import View
from labseq_virtual.settings import TweezerImageSettings

DEEPER: Final = 7.0
"""Light of a mobile tweezer relative to a static one, like the depths (paper: 2.1 mK and 0.3 mK)."""


class TweezerSource(Protocol):
    """The simulation with the imaged tweezers."""

    def tweezer_light(self) -> tuple[NDArray[np.float64], MobileTones | None]:
        """Present power of each static tweezer, float64 (n_rows, n_cols), and the mobile tweezers' tones."""
        ...


class TweezerView(Simulation):
    """Frames of the tweezers, with their positions and powers at the start of the exposure.

    The camera receives no light from atoms, and its exposures do not affect them.

    Args:
        source: The simulation.
        mobile: The light of the mobile tweezers.
        grid: The grid of sites.
        settings: Settings of the camera's images.
        seed: Seed of the machine, for the camera's own patterns.
        random: The random numbers of the simulation.
    """

    def __init__(
        self,
        source: TweezerSource,
        mobile: MobileLight,
        grid: SiteGrid,
        settings: TweezerImageSettings,
        seed: int,
        random: RandomStream,
    ) -> None:
        self._source, self._mobile, self._grid, self._random = source, mobile, grid, random
        self._settings, self._seed = settings.image(), seed
        self._images: dict[SensorMode, Images] = {}

    @property
    def sensor_shape(self) -> tuple[int, int]:
        """(height, width) of the sensor in pixels."""
        return self._settings.frame

    def readout_fraction(self, mode: SensorMode) -> float:
        """Time to read a frame, relative to the whole sensor without binning."""
        return View.of(self._settings, mode).readout_fraction

    def prepare_sensor(self, mode: SensorMode) -> None:
        """Compute the data shared by all frames of a mode."""
        self._images_of(mode).warm()

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        """Take a frame.

        Raises:
            LimitError: The exposure is not longer than 0, or the sensor has no such mode.
        """
        if not exposure_s > 0:
            raise LimitError("the exposure", f"{exposure_s} s", "more than 0")
        tweezers = self._light() if mode.shutter_open else ()
        none, rng = np.empty(0, np.int64), self._random.shot
        image = self._images_of(mode).take(none, none, np.empty(0), exposure_s, rng, tweezers)
        image.flags.writeable = False
        return Frame(image, exposure_s, t_start_s)

    def describe(self) -> Mapping[str, Any]:
        """The light that the camera sees, in SI."""
        return self._settings.model_dump(mode="json")

    def _light(self) -> list[Light]:
        static, tones = self._source.tweezer_light()
        light = [Light(self._grid.positions_m, self._settings.tweezer_light * static)]
        if tones is not None:
            power = tones.row_power[:, None] * tones.column_power
            light.append(
                Light(self._mobile.positions_m(tones), DEEPER * self._settings.tweezer_light * power)
            )
        return light

    def _images_of(self, mode: SensorMode) -> Images:
        if mode not in self._images:
            self._images[mode] = Images(self._settings, self._grid, self._seed, mode)
        return self._images[mode]

    def open(self) -> None:
        """Do nothing, like the four methods below, because the simulation itself does it."""

    def close(self) -> None:
        """Do nothing."""

    def begin_shot(self) -> None:
        """Do nothing."""

    def load(self, t_start_s: float, duration_s: float) -> None:
        """Do nothing."""

    def play(self, role: str, signal: Signal, t_start_s: float) -> None:
        """Do nothing."""
