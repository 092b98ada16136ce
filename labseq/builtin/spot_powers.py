"""The power of each tweezer, fitted on frames of a camera or measured by another device."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any, Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from labseq.config.profile import PowerMeterSettings
from labseq.detection.lattice import find_lattice
from labseq.detection.spots import KnownSpots, without_hot_pixels
from labseq.errors import ConfigError, DeviceError, TransientError
from labseq.model import Frame, SiteGrid
from labseq.motion.hold import all_on_program
from labseq.roles import Shot

Floats = NDArray[np.float64]


MIN_CONTRAST: Final = 100
"""Counts above the median at which equal counts of several pixels mean saturation."""


NAMED: Final = 5
"""Maximum number of sites that a message names."""


class SpotPowers:
    """Fits the power of each spot on frames of one camera.

    The first frame gives the position of every spot and their common Gaussian shape. With these fixed, the
    powers and the stray light between the spots are fitted on each frame by least squares. An error of the
    shape changes all powers by the same factor.

    Args:
        grid: The grid of sites, which must be on the frame as a whole (see :func:`find_lattice`).
        camera: Name of the camera, for messages.
    """

    def __init__(self, grid: SiteGrid, camera: str) -> None:
        self._grid, self._camera = grid, camera
        self._known: KnownSpots | None = None

    def fit(self, frame: Frame) -> Floats:
        """The power of each spot, float64 (n_rows, n_cols), in counts.

        Raises:
            DeviceError: A spot is saturated or missing, or the spots are not a lattice like the grid.
        """
        self._refuse_saturated(frame.image)
        spots = self._known = self._known or self._find(frame)
        power = spots.fit(without_hot_pixels(frame.image))
        faint = power < 0.2 * np.median(power)  # counts as missing
        if faint.any():
            self._refuse_missing(faint.reshape(self._grid.shape))
        return power.reshape(self._grid.shape)

    def _refuse_saturated(self, image: NDArray[np.uint16]) -> None:
        """Raise if a pixel has the largest count of 8 to 16 bits, or if several share the largest count."""
        highest, n_sites = int(image.max()), self._grid.n_rows * self._grid.n_cols
        n_equal = int(np.count_nonzero(image == highest))
        is_full = highest >= 0xFF and highest & (highest + 1) == 0
        is_flat = n_equal > max(4, n_sites // 50) and highest > np.median(image) + MIN_CONTRAST
        if is_full or is_flat:
            pixels = "1 pixel is" if n_equal == 1 else f"{n_equal} pixels are"
            self._refuse(f"{pixels} saturated ({highest} counts); shorten the exposure")

    def _find(self, frame: Frame) -> KnownSpots:
        try:
            lattice = find_lattice(frame.image, self._grid)
        except DeviceError as error:
            self._refuse(str(error).partition(": ")[2])
        if not lattice.found.all():
            self._refuse_missing(~lattice.found)
        places = lattice.positions_px + lattice.residuals_px
        return KnownSpots(lattice.frame, places.reshape(-1, 2), lattice.spot_px)

    def _refuse_missing(self, missing: NDArray[np.bool_]) -> NoReturn:
        sites = [f"({row}, {col})" for row, col in np.argwhere(missing).tolist()]
        more = ", ..." if len(sites) > NAMED else ""
        fault = f"{len(sites)} of {missing.size} spots are missing or not on the lattice of the others"
        self._refuse(
            f"{fault}: {', '.join(sites[:NAMED])}{more}; check that all tones are on and unobstructed"
        )

    def _refuse(self, why: str) -> NoReturn:
        raise DeviceError(self._camera, f"no powers from its frame of the tweezers: {why}")


def without_losses(take: Callable[[], Frame]) -> Frame:
    """Take a frame. If it is lost in transit, try up to three times, because no atoms are needed."""
    for _ in range(3):
        try:
            return take()
        except TransientError:
            continue
    return take()


class MobileTweezerMeter:
    """Plays all tones of the mobile tweezers, and measures the powers on frames of a camera.

    Each frame is taken during its own program, with the static tweezers off.

    Args:
        shot: The devices.
        settings: The camera and its exposure time.

    Raises:
        ConfigError: The device is not a camera.
    """

    def __init__(self, shot: Shot, settings: PowerMeterSettings) -> None:
        self._shot, self._settings, name = shot, settings, settings.device
        if name != "camera" and not hasattr(shot.device(name), "arm"):
            raise ConfigError(f"'{name}' is not a camera; choose a camera for mobile tweezers")
        self._spots = SpotPowers(shot.grid, name)
        self._motion = shot.motion
        shot.call("static_tweezers", shot.call_timeout_s, shot.static_tweezers.ramp, 0.0, 1e-3)

    def apply(self, rows: Floats, cols: Floats) -> None:
        """Use amplitudes of rows and columns from now on, fractions of full scale."""
        rf = replace(self._shot.motion.rf, row_amplitudes=tuple(rows), column_amplitudes=tuple(cols))
        self._motion = replace(self._shot.motion, rf=rf)

    def measure(self) -> Floats:
        """Measure the powers once, float64 (n_rows, n_cols), in counts.

        Raises:
            DeviceError: The frame shows no measurable spots, or the mobile tweezers fail.
            LimitError: The tones break a limit.
        """
        return self._spots.fit(without_losses(self._frame))

    def _frame(self) -> Frame:
        shot, settings = self._shot, self._settings
        on_s = 2 * settings.lead + settings.mobile_exposure
        program = all_on_program(shot.grid, self._motion, on_s)
        with shot.stage("prepare"):
            shot.call("mobile_tweezers", shot.call_timeout_s, shot.mobile_tweezers.prepare, program)
        light = self._light(program.total_duration_s)
        return shot.take_frame(settings.device, settings.mobile_exposure, light)

    @contextmanager
    def _light(self, duration_s: float) -> Generator[None]:
        """Play the prepared program to its end. All tones are on inside the context."""
        lost: TransientError | None = None
        shot, mobile, limit_s = self._shot, self._shot.mobile_tweezers, self._shot.call_timeout_s
        shot.check_interlocks()
        start = partial(shot.call, "mobile_tweezers", limit_s, mobile.play)
        with shot.lines_on("rearrange", duration_s, start):
            shot.clock.sleep(self._motion.pick_up_s + self._settings.lead)
            try:
                yield
            except TransientError as error:
                lost = error
            shot.call("mobile_tweezers", duration_s + 2 * limit_s, mobile.wait, duration_s + limit_s)
        if lost is not None:
            raise lost


class TweezerMeter:
    """Plays amplitudes of the static tweezers' tones, and measures the powers of the tweezers.

    The value of a device other than a camera is an array (n_rows, n_cols) proportional to the depths, nan
    where it has none, or one number proportional to the light of all tweezers. For one number each row is
    turned on alone with all columns, then each column with all rows. This gives the factors of rows and
    columns, but no values of single tweezers.

    Args:
        shot: The devices.
        settings: The measuring device.
    """

    def __init__(self, shot: Shot, settings: PowerMeterSettings) -> None:
        self._shot, self._settings = shot, settings
        self._device: Any = None if settings.device == "camera" else shot.device(settings.device)
        is_camera = self._device is None or hasattr(self._device, "arm")
        self._spots = SpotPowers(shot.grid, settings.device) if is_camera else None
        self._is_total = False
        self._playing: tuple[Floats, ...] = ()

    def apply(self, *values: Floats) -> None:
        """Play amplitudes of rows and columns (fractions of full scale), or weights of the sites."""
        shot, static = self._shot, self._shot.static_tweezers
        if len(values) == 1:
            shot.call("static_tweezers", shot.call_timeout_s, static.load_weights, values[0])
        else:
            rows, cols = values
            shot.call("static_tweezers", shot.call_timeout_s, static.load, (rows, cols))
        shot.clock.sleep(self._settings.settle)
        self._playing = values

    def measure(self) -> Floats:
        """Measure the powers once, float64 (n_rows, n_cols), in any unit.

        Raises:
            DeviceError: The frame shows no measurable spots, or the value is neither an array nor a number.
        """
        if self._spots is not None:
            name, exposure_s = self._settings.device, self._settings.exposure
            return self._spots.fit(without_losses(lambda: self._shot.take_frame(name, exposure_s)))
        if not self._is_total:
            power = self._read()
            self._is_total = power.ndim == 0
            if power.ndim:
                return power
        return self._by_tone()

    def _by_tone(self) -> Floats:
        """The products of the light of each row and of each column, minus the light without tones."""
        if len(self._playing) == 1:
            text = f"its value '{self._settings.value}' is one number, the power of all tweezers"
            raise DeviceError(self._settings.device, f"{text}; for weights of sites use a camera or an array")
        rows, cols = self._playing
        each_row, each_col = np.diag(rows), np.diag(cols)
        dark = self._total(0 * rows, 0 * cols)
        of_row = np.maximum(0.0, [self._total(row, cols) - dark for row in each_row])
        of_col = np.maximum(0.0, [self._total(rows, col) - dark for col in each_col])
        self.apply(rows, cols)
        return np.outer(of_row, of_col) / max(float(of_col.sum()), 1e-300)

    def _total(self, rows: Floats, cols: Floats) -> float:
        self.apply(rows, cols)
        return float(self._read())

    def _read(self) -> Floats:
        """The value of the device, float64 (n_rows, n_cols) or ()."""
        name, value, shape = self._settings.device, self._settings.value, self._shot.grid.shape
        answer = self._shot.call(name, self._shot.call_timeout_s, self._device.read, value)
        try:
            power = np.asarray(answer, np.float64)
        except (TypeError, ValueError):
            power = np.array(np.nan)
        is_number = isinstance(answer, int | float | np.number) and np.isfinite(power)
        if not (is_number or power.shape == shape) or (self._is_total and power.ndim):
            kind = power.shape if power.ndim else type(answer).__name__
            message = f"its value '{value}' is {kind}; expected the power of each of {shape} tweezers"
            raise DeviceError(name, f"{message}, or one number, the power of all")
        return power
