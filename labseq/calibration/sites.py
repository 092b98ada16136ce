"""Calibration of the site positions, from the lattice on an averaged frame or from a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from labseq.calibration.lattice import FoundLattice, find_lattice
from labseq.calibration.method import AnalysisResult, CalibrationData
from labseq.calibration.pictures import draw_sites
from labseq.detection.sites import read_sites
from labseq.errors import ConfigError, Problem
from labseq.session.profile import ResolvedProfile
from labseq.units import format_quantity


def analyse_sites(data: CalibrationData) -> AnalysisResult:
    """Find the lattice on the mean of the run's frames.

    Raises:
        DeviceError: No lattice was found; says why.
        ConfigError: The run has no frames.
    """
    total, n_frames = np.zeros(1), 0
    for frame in data.frames():
        total, n_frames = total + frame.image, n_frames + 1
    mean = total / n_frames
    found = find_lattice(mean, data.hardware.grid)
    quality = {
        "residual_px": found.residual_px,
        "n_sites_found": float(found.n_sites_found),
        "spacing_px": sum(found.spacing_px) / 2,
        "angle_rad": found.angle_rad,
        "stretch": found.stretch,
        "spot_px": found.spot_px,
        "pixel_size_m": found.pixel_size_m,
    }
    return AnalysisResult(
        {"positions_px": found.positions_px, "frame": found.frame},
        quality,
        _summary_lines(found, n_frames),
        draw=lambda: draw_sites(mean, found.positions_px, found.residuals_px),
    )


def read_site_file(path: Path, hardware: ResolvedProfile) -> AnalysisResult:
    """Read the positions of the sites from a file, on frames of the size in the detector's settings.

    Raises:
        ConfigError: The file has an error, or the detector has no setting for the size of its frames.
    """
    settings: Any = hardware.chosen["detector"].settings
    frame = getattr(settings, "frame", None)
    if frame is None:
        what = "the detector does not say how large the frames are that the sites are on"
        raise ConfigError(Problem(what, expected="a detector with the setting 'frame'"))
    positions = read_sites(path, hardware.grid.shape)
    if np.any((positions < 0) | (positions > np.array(frame) - 1)):
        what = f"some of the sites are outside of the frame of {frame[0]} x {frame[1]} pixels"
        raise ConfigError(Problem(what, str(path), expected="(y, x) of each site on the frame"))
    summary_lines = (f"{positions[..., 0].size} sites read from {path}",)
    return AnalysisResult({"positions_px": positions, "frame": frame}, {}, summary_lines)


def _summary_lines(found: FoundLattice, n_frames: int) -> tuple[str, ...]:
    along, down = found.spacing_px
    angle, pixel = format_quantity(found.angle_rad, "angle"), format_quantity(found.pixel_size_m, "length")
    seen = f"{found.n_sites_found} of {found.found.size} sites found on the mean of {n_frames} frames"
    size = f"spacing {along:.2f} px along rows, {down:.2f} px from row to row"
    form = f"rotated by {angle}, stretched by {100 * (found.stretch - 1):.1f} %"
    return (
        f"{seen}, {found.residual_px:.3f} px r.m.s. from a smooth lattice",
        f"{size}; {form}; a pixel is {pixel} wide if the grid's spacing is true",
    )
