"""Steps that hold atoms displaced from their sites, and steps that watch for drifts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from labseq.builtin.overlay import FastOffset, SurvivalShape, fast_offset, group_counts
from labseq.builtin.rearrange import play
from labseq.detection.drift import measure_shift
from labseq.motion.hold import cross_offsets_m, hold_program, hold_time_s
from labseq.plugin import (
    ConfigError,
    DeviceError,
    Duration,
    Length,
    Occupancy,
    PositiveDuration,
    ReportsSignals,
    Settings,
    Shot,
    SiteGrid,
    Step,
    StepContext,
    TimedBy,
    TimelineEntry,
    format_quantity,
)

PositiveLength: TypeAlias = Annotated[Length, Field(gt=0)]
"""A length above 0, such as "0.9 um", in metres."""


class ProbeSettings(Settings):
    """``probe``: pick atoms up, hold them and set them down, displaced from their sites."""

    offset: tuple[Length, Length] = Field(
        default=(0.0, 0.0),
        description="displacement of the tweezers from the sites, as [along a row, from row to row]",
    )
    hold: Duration = Field(default=0.2e-3, description="time between pick-up and drop-off")
    drop_off: Duration = Field(
        default=5e-6, description="duration of the drop-off. A slow drop-off leads atoms back to their sites"
    )
    pattern: Literal["same", "cross"] = Field(
        default="same",
        description="whether all sites have the same offset, or four groups are displaced forwards and "
        "backwards along a row, and forwards and backwards from row to row",
    )
    sites: Literal["seen", "all"] = Field(
        default="seen", description="sites to probe: where the last image shows an atom, or all"
    )


class ProbeStep(Step):
    """Picks atoms up, holds them and sets them down, displaced from their sites by an offset.

    The survival on the next image shows where the mobile tweezers are.
    """

    needs_image = True
    notes = ()

    def __init__(self, settings: ProbeSettings) -> None:
        self.settings = settings

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """One entry, with all sites held.

        Raises:
            LimitError: At this offset, tones of the grid break a limit.
        """
        settings = self.settings
        duration_s = longest_s(context, self._offsets_m(context.grid), settings)
        min_duration_s = duration_s if settings.sites == "all" else 0.0
        return [TimelineEntry("probe", duration_s, min_duration_s, timed_by=TimedBy("mobile_tweezers"))]

    def run(self, shot: Shot) -> None:
        """Hold the atoms seen on the last image, or the atoms of all sites."""
        occupancy = shot.occupancy
        if occupancy is None:
            raise ConfigError("probe needs an image before it in the shot")
        sites = np.ones_like(occupancy) if self.settings.sites == "all" else occupancy
        hold(shot, sites, self._offsets_m(shot.grid), self.settings)

    def _offsets_m(self, grid: SiteGrid) -> NDArray[np.float64]:
        offset_m = self.settings.offset
        if self.settings.pattern == "cross":
            return cross_offsets_m(grid.shape, offset_m)
        return np.broadcast_to(np.asarray(offset_m, np.float64), (*grid.shape, 2))


def hold(
    shot: Shot,
    sites: Occupancy,
    offsets_m: NDArray[np.float64],
    settings: ProbeSettings | CheckOverlaySettings,
) -> None:
    """Pick up, hold and drop the atoms of some sites, each displaced from its site by an offset.

    Args:
        shot: The running shot.
        sites: bool (n_rows, n_cols). Without sites, nothing is played.
        offsets_m: float64 (n_rows, n_cols, 2), along a1 and a2.
        settings: Durations of hold and drop-off.
    """
    if sites.any():
        start_s = shot.clock.now()
        times_s = settings.hold, settings.drop_off
        play(shot, lambda: hold_program(shot.grid, shot.motion, sites, offsets_m, *times_s), start_s)


def longest_s(
    context: StepContext, offsets_m: NDArray[np.float64], settings: ProbeSettings | CheckOverlaySettings
) -> float:
    """How long :func:`hold` takes if every site holds an atom.

    Raises:
        LimitError: The tone of a site leaves its band.
    """
    time_s = hold_time_s(context.grid, context.motion, offsets_m, settings.hold, settings.drop_off)
    return context.motion.overhead_per_cycle_s + time_s


Exceeded = Literal["warn", "stop"]

MIN_ATOMS: Final = 10
"""Minimum number of atoms, because with fewer, noise may look like displaced atoms."""
SURE: Final = 1.0
"""A shift counts as too large if it exceeds the limit by this many standard errors."""


class CheckSitesSettings(Settings):
    """``check_sites``: check on the last image whether the sites have moved on the camera."""

    every: int = Field(default=1, ge=1, description="check once in this many shots, from the first")
    limit_px: float = Field(default=0.5, gt=0, description="largest shift that is accepted, in pixels")
    spot_px: float = Field(
        default=1.2, gt=0, description="width (1 sigma of a Gaussian) of an atom's image, in pixels"
    )
    exceeded: Literal["warn", "stop"] = Field(
        default="warn", description="whether a larger shift is a warning or stops the run"
    )


class CheckSitesStep(Step):
    """Checks on the last image whether the atoms are still where the detector looks for them."""

    needs_image = True
    takes_time = False
    repeatable = True
    notes = ("sites.",)

    def __init__(self, settings: CheckSitesSettings) -> None:
        self.settings = settings

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:  # noqa: ARG002 - of the role
        """One entry without a length. The check takes some milliseconds of the computer's time."""
        return [TimelineEntry("check sites", 0.0, 0.0)]

    def run(self, shot: Shot) -> None:
        """Measure the common shift, record it, and warn or stop if it is too large.

        Raises:
            ConfigError: The detector does not report where it looks for the atoms.
            DeviceError: The shift is too large, and ``exceeded`` is "stop".
        """
        settings, detector = self.settings, shot.detector
        if shot.index % settings.every:
            return
        if shot.frame is None or shot.occupancy is None:
            raise ConfigError("check_sites needs an image before it in the shot")
        if not isinstance(detector, ReportsSignals):
            raise ConfigError(
                "check_sites needs a detector that reports where it looks for the atoms; "
                "use 'threshold' or 'weighted'"
            )
        image, sites_px = shot.frame.image, detector.sites_px[shot.occupancy]
        dy = dx = error = math.inf
        if len(sites_px) >= MIN_ATOMS:
            with shot.stage("check sites"):
                limit_s = shot.call_timeout_s
                dy, dx, error = shot.call(
                    "detector", limit_s, measure_shift, image, sites_px, settings.spot_px
                )
        if not error <= settings.limit_px:
            _warn(
                shot,
                f"check_sites cannot locate the sites from {len(sites_px)} atoms, because "
                "few were loaded or the sites are far from where the detector looks",
            )
            return
        for name, value in (("shift_y_px", dy), ("shift_x_px", dx), ("shift_error_px", error)):
            shot.note(f"sites.{name}", value)
        if math.hypot(dy, dx) > settings.limit_px + SURE * error:
            _handle_exceeded(
                shot,
                settings.exceeded,
                "camera",
                f"the sites have moved by {dy:+.2f} px down and {dx:+.2f} px to the right on the frame "
                f"(+-{error:.2f}, limit {settings.limit_px:g} px); run `labseq calibrate sites`",
            )


class CheckOverlaySettings(Settings):
    """``check_overlay``: check by a probe whether the mobile tweezers are still centred on the sites."""

    every: int = Field(default=20, ge=1, description="check once in this many shots, from the first")
    offset: PositiveLength = Field(
        default=0.9e-6,
        description="offset of the probe in each of four directions, on the edge of the survival peak",
    )
    hold: Duration = Field(default=0.2e-3, description="time between pick-up and drop-off")
    drop_off: Duration = Field(
        default=5e-6, description="duration of the drop-off. A slow drop-off leads atoms back to their sites"
    )
    exposure: PositiveDuration = Field(default=45e-3, description="exposure time of the image after it")
    limit: PositiveLength = Field(default=100e-9, description="largest offset that is accepted, on each axis")
    exceeded: Literal["warn", "stop"] = Field(
        default="warn", description="whether a larger offset is a warning or stops the run"
    )
    half_width: PositiveLength = Field(
        default=0.93e-6,
        description="distance at which half of the probed atoms survive, without a calibration",
    )
    edge: PositiveLength = Field(
        default=0.23e-6, description="width (1 sigma) of the survival peak's edge, without a calibration"
    )


class CheckOverlayStep(Step):
    """Checks by probing four groups of sites whether the mobile tweezers are still centred on the sites.

    It loses the probed atoms, so it should be the last step. It runs in one of `every` shots.
    """

    needs_image = True
    takes_time = False
    notes = ("overlay.",)

    def __init__(self, settings: CheckOverlaySettings) -> None:
        self.settings = settings

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:
        """Probe and image, left out in most shots.

        Raises:
            LimitError: At this offset, tones of the grid break a limit.
        """
        settings = self.settings
        offsets_m = self._offsets_m(context.grid.shape)
        probe_s = longest_s(context, offsets_m, settings)
        image_s = settings.exposure + context.camera.readout_s
        min_s = image_s if settings.every == 1 else 0.0
        awg, camera = TimedBy("mobile_tweezers"), TimedBy("camera")
        return [
            TimelineEntry("check overlay: probe", probe_s, 0.0, timed_by=awg),
            TimelineEntry("check overlay: image", image_s, min_s, 1, settings.exposure, timed_by=camera),
        ]

    def run(self, shot: Shot) -> None:
        """Probe, take an image, record the offset, and warn or stop if it is too large.

        Raises:
            DeviceError: The offset is too large, and ``exceeded`` is "stop".
        """
        settings, before = self.settings, shot.occupancy
        if shot.index % settings.every:
            return
        if before is None:
            raise ConfigError("check_overlay needs an image before it in the shot")
        offsets_m = self._offsets_m(shot.grid.shape)
        with shot.stage("check overlay"):
            hold(shot, before, offsets_m, settings)
            after = shot.take_image(settings.exposure)
        entry = shot.calibrations.get("overlay")
        calibrated = None if entry is None else SurvivalShape.from_values(entry.values)
        shape = calibrated or SurvivalShape(settings.half_width, settings.edge)
        overlay = fast_offset(*group_counts(offsets_m, before, after), shape, shot.grid)
        if overlay.n_atoms:
            along_m, across_m = (float(value) for value in overlay.offset_m)
            shot.note("overlay.along_row_m", along_m)
            shot.note("overlay.row_to_row_m", across_m)
            shot.note("overlay.error_m", float(overlay.error_m.max()))
        self._judge(shot, overlay)

    def _judge(self, shot: Shot, overlay: FastOffset) -> None:
        settings = self.settings
        offset_m, error_m = np.abs(overlay.offset_m), overlay.error_m
        parts = " and ".join(
            f"{format_quantity(float(at), 'length')} {direction} "
            f"(+-{format_quantity(float(error), 'length')})"
            for at, error, direction in zip(
                overlay.offset_m, error_m, ("along a row", "from row to row"), strict=True
            )
        )
        limit = format_quantity(settings.limit, "length")
        if not overlay.fits:
            message = "the survival of the probed atoms fits no small offset of the mobile tweezers"
            _handle_exceeded(
                shot, settings.exceeded, "mobile_tweezers", f"{message}; run `labseq calibrate overlay`"
            )
        elif (offset_m > settings.limit + SURE * error_m).any():
            message = f"the mobile tweezers are {parts} from the sites, more than the limit of {limit}"
            _handle_exceeded(
                shot, settings.exceeded, "mobile_tweezers", f"{message}; run `labseq calibrate overlay`"
            )
        elif not (error_m <= settings.limit).all():
            n_atoms = "1 atom" if overlay.n_atoms == 1 else f"{overlay.n_atoms} atoms"
            _warn(shot, f"check_overlay cannot measure the overlay to {limit} with {n_atoms} in this shot")

    def _offsets_m(self, shape: tuple[int, int]) -> NDArray[np.float64]:
        return cross_offsets_m(shape, (self.settings.offset, self.settings.offset))


def _handle_exceeded(shot: Shot, exceeded: Exceeded, device: str, message: str) -> None:
    if exceeded == "stop":
        raise DeviceError(device, message)
    _warn(shot, message)


def _warn(shot: Shot, message: str) -> None:
    shot.log("warning", text=f"shot {shot.index}: {message}")
