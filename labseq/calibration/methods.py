"""Analyses the runs that calibrate sites, tweezers, frequencies, overlay and timing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.assembly.profile import ResolvedProfile
from labseq.builtin.equalise import READINGS
from labseq.builtin.overlay import (
    MIN_P,
    OverlayFit,
    SurvivalShape,
    checked_counts,
    distance_m,
    fit_overlay,
    overlay_offset,
    unit_axes,
)
from labseq.calibration.method import AnalysisResult, CalibrationData, ProbeCounts, count_probed
from labseq.calibration.pictures import draw_powers, draw_sites, draw_survival, draw_tone_offsets
from labseq.data.reader import Run
from labseq.detection.lattice import FoundLattice, find_lattice
from labseq.detection.sites import read_sites
from labseq.errors import ConfigError, DeviceError, Problem
from labseq.model import MotionSpec, SiteGrid
from labseq.motion.axes import drive
from labseq.units import format_quantity

Floats = NDArray[np.float64]

ROUNDS: Final = 30
"""Maximum number of rounds of the fit of rows and columns."""
KNOWN_BEFORE_M: Final = 0.5e-6
"""Prior distance of a row or column from the common centre, 1 sigma."""
WORST_ERROR_M: Final = 50e-9
SLOPE_STEP_M: Final = 1e-9


def analyse_sites(data: CalibrationData) -> AnalysisResult:
    """Find the lattice on the mean of the run's frames.

    Raises:
        DeviceError: No lattice was found. The message says why.
        ConfigError: The run has no frames.
    """
    # added one by one, so that only one frame is in memory
    total, n_frames = np.zeros(1), 0
    for frame in data.frames():
        total, n_frames = total + frame.image, n_frames + 1
    mean = total / n_frames
    lattice = find_lattice(mean, data.hardware.grid, centre_px=data.centre_px)
    spacings = [spacing for spacing in lattice.spacing_px if np.isfinite(spacing)]
    figures = {
        "residual_px": lattice.residual_px,
        "n_sites_found": float(lattice.n_sites_found),
        "spacing_px": float(np.mean(spacings)) if spacings else np.nan,
        "angle_rad": lattice.angle_rad,
        "stretch": lattice.stretch,
        "spot_px": lattice.spot_px,
        "pixel_size_m": lattice.pixel_size_m,
    }
    quality = {name: value for name, value in figures.items() if np.isfinite(value)}
    return AnalysisResult(
        {"positions_px": lattice.positions_px, "frame": lattice.frame},
        quality,
        _summary_lines(lattice, n_frames),
        draw=lambda: draw_sites(mean, lattice.positions_px, lattice.residuals_px),
    )


def read_site_file(path: Path, hardware: ResolvedProfile) -> AnalysisResult:
    """Read the positions of the sites from a file, on frames of the size in the detector's settings.

    Raises:
        ConfigError: The file has an error, or the detector has no setting for the size of its frames.
    """
    settings: Any = hardware.chosen["detector"].settings
    frame = getattr(settings, "frame", None)
    if frame is None:
        problem = "the detector does not know the size of the frames with the sites"
        raise ConfigError(Problem(problem, expected="a detector with the setting 'frame'"))
    positions = read_sites(path, hardware.grid.shape)
    if np.any((positions < 0) | (positions > np.array(frame) - 1)):
        problem = f"some of the sites are outside of the frame of {frame[0]} x {frame[1]} pixels"
        raise ConfigError(Problem(problem, str(path), expected="(y, x) of each site on the frame"))
    summary_lines = (f"{positions[..., 0].size} sites read from {path}",)
    return AnalysisResult({"positions_px": positions, "frame": frame}, {}, summary_lines)


def _summary_lines(lattice: FoundLattice, n_frames: int) -> tuple[str, ...]:
    count = f"{lattice.n_sites_found} of {lattice.found.size} sites found on the mean of {n_frames} frames"
    first = f"{count}, {lattice.residual_px:.3f} px r.m.s. from a smooth lattice"
    ways = zip(lattice.spacing_px, ("along rows", "from row to row"), strict=True)
    spacings = ", ".join(f"{px:.2f} px {way}" for px, way in ways if np.isfinite(px))
    if not spacings:
        return (first,)
    angle, pixel = (
        format_quantity(lattice.angle_rad, "angle"),
        format_quantity(lattice.pixel_size_m, "length"),
    )
    form = f", stretched by {100 * (lattice.stretch - 1):.1f} %" if np.isfinite(lattice.stretch) else ""
    size = f"a pixel is {pixel} wide if the grid's spacing is right"
    return first, f"spacing {spacings}; rotated by {angle}{form}; {size}"


def analyse_tweezers(data: CalibrationData) -> AnalysisResult:
    """Read the amplitudes or weights from the step ``equalise`` in the run's last shot.

    Raises:
        ConfigError: No shot of the run equalised the tweezers of this grid.
    """
    readings = _readings(data.run)
    before, after = (np.array(readings[name], np.float64) for name in ("power_before", "power_after"))
    if before.shape != data.hardware.grid.shape:
        raise _wrong_run(data.run, f"this run equalised {len(before)} x {len(before[0])} tweezers")
    # tweezers without tones get equal amplitudes, so that every driver can read the calibration
    equal = [[1 / n] * n for n in before.shape]
    rows, cols = (
        np.array(readings.get(name, value), np.float64)
        for name, value in zip(("row_amplitudes", "column_amplitudes"), equal, strict=True)
    )
    values = {"row_amplitudes": rows, "column_amplitudes": cols}
    weights = np.array(readings["weights"], np.float64) if "weights" in readings else None
    names = ("separable_spread", "residual_spread", "noise", "n_measured")
    quality = {name: float(readings[name]) for name in names}
    n_rounds = len(readings["spreads"])
    work = f"{n_rounds} round{'s' * (n_rounds > 1)}, {readings['n_measured']} measurements"
    spread = f"{quality['separable_spread']:.2%} (before: {readings['spreads'][0]:.2%})"
    if weights is not None:
        return AnalysisResult(
            values | {"weights": weights},
            quality,
            (
                f"{work}: sites are equal to {spread}",
                f"the weights of the sites are {weights.min():.3g} to {weights.max():.3g}",
            ),
            draw=lambda: draw_powers(before, after, weights.mean(axis=1), weights.mean(axis=0), "weight (%)"),
        )
    return AnalysisResult(
        values,
        quality,
        (
            f"{work}: rows and columns are equal to {spread}",
            f"a spread of {quality['residual_spread']:.1%} remains, which the tones cannot change",
        ),
        draw=lambda: draw_powers(before, after, rows, cols),
    )


def analyse_timing(data: CalibrationData) -> AnalysisResult:
    """Find the time from the start of a rearrangement cycle until its light is on.

    The stage ``light`` of a shot starts at the frame and so includes the detection. The clock of a simulated
    run stops while the computer works, so the computer's time is added.

    Raises:
        ConfigError: No shot of the run moved atoms.
    """
    taken_s: list[float] = []
    for shot in data.run.shots:
        detect = None
        for stage in shot.timing:
            if stage.stage == "detect":
                detect = stage
            elif stage.stage == "light" and detect is not None:
                host_s = stage.host_s - detect.host_s if data.run.simulated else 0.0
                taken_s.append(stage.duration_s - detect.duration_s + host_s)
    if not taken_s:
        problem = "no shot of this run moved atoms; choose a target that random loadings do not meet"
        raise ConfigError(Problem(problem, str(data.run.path), expected="a run that rearranges"))
    median_s, p99_s = (float(value) for value in np.quantile(taken_s, (0.5, 0.99)))
    median, p99 = (format_quantity(value, "time") for value in (median_s, p99_s))
    return AnalysisResult(
        {"overhead_s": [median_s]},
        {"p99_s": p99_s, "n_cycles": float(len(taken_s))},
        (f"{len(taken_s)} cycles: {median} from the start of a cycle to the light, 99 % within {p99}",),
    )


def _readings(run: Run) -> dict[str, Any]:
    """The readings of ``equalise`` in the last shot that has them."""
    for shot in reversed(run.shots):
        readings = {
            name.removeprefix(READINGS): value
            for name, value in shot.readings.items()
            if name.startswith(READINGS)
        }
        if readings:
            return readings
    raise _wrong_run(run, "no shot of this run equalised the tweezers")


def _wrong_run(run: Run, problem: str) -> ConfigError:
    return ConfigError(
        Problem(problem, str(run.path), expected="a run with the step 'equalise', on this grid")
    )


@dataclass(frozen=True, slots=True, eq=False)
class FrequenciesFit:
    """Tone frequencies at which the mobile tweezers are centred on the sites.

    Attributes:
        row_hz: float64 (n_rows,), frequency of each row's tone.
        column_hz: float64 (n_cols,), frequency of each column's tone.
        row_offset_m: float64 (n_rows,), distance of each row's tweezers from their sites, along a2.
        column_offset_m: float64 (n_cols,), the same for the columns, along a1.
        row_error_m: float64 (n_rows,), standard errors.
        column_error_m: float64 (n_cols,), standard errors.
        overlay: The fit of all sites together.
    """

    row_hz: Floats
    column_hz: Floats
    row_offset_m: Floats
    column_offset_m: Floats
    row_error_m: Floats
    column_error_m: Floats
    overlay: OverlayFit

    @property
    def error_m(self) -> float:
        """The rms of all standard errors, in metres."""
        return float(np.sqrt(np.mean(np.concatenate([self.row_error_m, self.column_error_m]) ** 2)))


def fit_frequencies(
    offset_m: ArrayLike,
    n_before: ArrayLike,
    n_survived: ArrayLike,
    grid: SiteGrid,
    motion: MotionSpec,
    worst_error_m: float = WORST_ERROR_M,
) -> FrequenciesFit:
    """Find the position of each row's and column's tweezers, and the tones that centre them on the sites.

    All sites have the same survival peak (:func:`fit_overlay`). Its centre on the site (i, j) is the centre
    of column j along a1 and of row i along a2. All centres are fitted together by maximum likelihood. Each
    centre is then shrunk towards a parabola through the others of its axis, as much as its error and the
    scatter about the parabola require. A row or column with few atoms takes the value of its neighbours. The
    tones include the common shift, so the overlay from the measurement is no longer needed.

    Args:
        offset_m: float64 (n_points, 2), commanded offsets along a1 and a2.
        n_before: int (n_points, n_rows, n_cols), number of probed atoms on each site.
        n_survived: int, of the same shape, number of these atoms seen afterwards.
        grid: The grid of sites, with the tones that were played.
        motion: How the tweezers move.
        worst_error_m: Maximum allowed r.m.s. error of rows and columns, in metres.

    Raises:
        DeviceError: As :func:`fit_overlay`, or there are too few atoms for a fit by rows.
        ValueError: The shapes of the arrays do not match.
    """
    offset, n, k = checked_counts(offset_m, n_before, n_survived)
    if n.shape[1:] != grid.shape:
        raise ValueError(f"counts of shape {n.shape}; expected (n_points, {grid.n_rows}, {grid.n_cols})")
    overlay = fit_overlay(offset, n, k, grid)
    # beyond the reach no atom survives, wherever the centre is
    near = distance_m(offset - overlay.centre_m, unit_axes(grid)) < overlay.shape.reach_m
    columns_m, rows_m, spread = _centres(offset[near], n[near], k[near], overlay, grid)
    errors_m = np.sqrt(np.diag(spread))
    columns_m, column_error_m = smoothed(columns_m, errors_m[: grid.n_cols])
    rows_m, row_error_m = smoothed(rows_m, errors_m[grid.n_cols :])
    hz = [
        driven.site_hz + driven.step_hz * centre_m / grid.spacing_m
        for driven, centre_m in ((drive(grid, motion, 0), rows_m), (drive(grid, motion, 1), columns_m))
    ]
    fit = FrequenciesFit(hz[0], hz[1], -rows_m, -columns_m, row_error_m, column_error_m, overlay)
    if fit.error_m > worst_error_m:
        reached, required = (format_quantity(m, "length") for m in (fit.error_m, worst_error_m))
        factor = math.ceil((fit.error_m / worst_error_m) ** 2)
        problem = f"no frequencies found, as with too few atoms rows and columns are only known to {reached}"
        remedy = f"for {required} take {factor} times as many `repeats`"
        raise DeviceError("mobile_tweezers", f"{problem}; {remedy}")
    return fit


def smoothed(values: Floats, errors: Floats) -> tuple[Floats, Floats]:
    """Shrink measured values towards the parabola through all of them, according to their errors.

    The scatter about the parabola in excess of the errors is chosen so that chi squared equals its degrees of
    freedom (Paule and Mandel, J. Res. Natl. Bur. Stand. 87, 377, 1982). Each value becomes the mean of itself
    and the parabola, weighted by the inverse squares of its error and of that scatter. A value more than
    three times both away from the parabola is not changed.

    Args:
        values: float64 (n,), in the order of rows or columns.
        errors: float64 (n,), above 0.

    Returns:
        The values and their errors, float64 (n,).

    Example:
        >>> measured = np.array([0.0, 1.0, 2.0, 9.0, 4.0])
        >>> value, _ = smoothed(measured, np.array([0.1, 0.1, 0.1, 50.0, 0.1]))
        >>> value.round(2).tolist()
        [0.0, 1.0, 2.0, 3.0, 4.0]
    """
    n = len(values)
    degree = 2 if n >= 6 else 1 if n >= 3 else 0
    basis = np.vander(np.linspace(-1, 1, n), degree + 1)
    # bisection, because chi squared falls as the scatter rises
    low, high = 0.0, float(np.ptp(values)) + 1e-30
    for _ in range(60):
        middle = (low + high) / 2
        curve, _ = _through(basis, values, errors**2 + middle**2)
        is_too_small = ((values - curve) ** 2 / (errors**2 + middle**2)).sum() > n - degree - 1
        low, high = (middle, high) if is_too_small else (low, middle)
    variance = errors**2 + high**2
    curve, curve_variance = _through(basis, values, variance)
    weight = np.where(np.abs(values - curve) > 3 * np.sqrt(variance), 1.0, high**2 / variance)
    return curve + weight * (values - curve), np.sqrt(weight * errors**2 + (1 - weight) ** 2 * curve_variance)


def _through(basis: Floats, values: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """The least-squares curve at each place, and its variance there."""
    covariance = np.linalg.inv((basis.T / variance) @ basis)
    curve = basis @ (covariance @ (basis.T @ (values / variance)))
    return curve, ((basis @ covariance) * basis).sum(axis=1)


def _centres(
    offset: Floats, n: Floats, k: Floats, overlay: OverlayFit, grid: SiteGrid
) -> tuple[Floats, Floats, Floats]:
    """The most likely centres of columns and rows, by Fisher scoring, and their covariance."""
    common = np.concatenate([np.full(m, c) for m, c in zip(grid.shape[::-1], overlay.centre_m, strict=True)])
    centres, n_cols = common.copy(), grid.n_cols
    spread: Floats = np.zeros((len(centres), len(centres)))
    for _ in range(ROUNDS):
        site_centres = np.stack(np.broadcast_arrays(centres[:n_cols], centres[n_cols:, None]), axis=-1)
        p, slopes = _slopes(offset[:, None, None] - site_centres, overlay.shape, grid)
        certainty, surprise = n / (p * (1 - p)), (k - n * p) / (p * (1 - p))
        information = np.zeros_like(spread)
        crossed = (certainty * slopes[..., 0] * slopes[..., 1]).sum(axis=0)
        information[n_cols:, :n_cols], information[:n_cols, n_cols:] = crossed, crossed.T
        squared = (certainty[..., None] * slopes**2).sum(axis=0)
        diagonal = np.concatenate([squared[..., 0].sum(axis=0), squared[..., 1].sum(axis=1)])
        np.fill_diagonal(information, diagonal + KNOWN_BEFORE_M**-2)
        pull = (surprise[..., None] * slopes).sum(axis=0)
        force = np.concatenate([pull[..., 0].sum(axis=0), pull[..., 1].sum(axis=1)])
        spread = np.asarray(np.linalg.inv(information), np.float64)
        step = spread @ (force - (centres - common) * KNOWN_BEFORE_M**-2)
        # a first step from far out would jump over the peak
        centres += np.clip(step, -overlay.shape.edge_m, overlay.shape.edge_m)
        if np.abs(step).max() < 0.1e-9:
            break
    # a row or column averages over the excess scatter of single sites
    excess = 1 + (overlay.dispersion - 1) / min(grid.shape)
    return centres[:n_cols], centres[n_cols:], spread * excess


def _slopes(offset: Floats, shape: SurvivalShape, grid: SiteGrid) -> tuple[Floats, Floats]:
    """Survival at some offsets from the centre, and its derivatives by the centre, (..., 2)."""
    axes = unit_axes(grid)
    distance = distance_m(offset, axes)
    p = np.clip(shape.survival(distance), MIN_P, 1 - MIN_P)
    outwards = (shape.survival(distance + SLOPE_STEP_M) - shape.survival(distance - SLOPE_STEP_M)) / (
        2 * SLOPE_STEP_M
    )
    direction = (offset @ axes) @ axes.T / np.maximum(distance, SLOPE_STEP_M)[..., None]
    return p, -outwards[..., None] * direction


def analyse_frequencies(data: CalibrationData) -> AnalysisResult:
    """Find the tones that centre the tweezers of each row and column on the sites.

    The tones include the correction of the active overlay calibration.

    Raises:
        DeviceError: There are too few atoms, or no offset at which most survive. The message says why.
        ConfigError: The run is not a scan of a probe's offset.
    """
    probed = count_probed(data.run)
    fit = fit_frequencies(probed.offset_m, probed.n_before, probed.n_survived, probed.grid, probed.motion)
    row_m, column_m = fit.row_offset_m, fit.column_offset_m
    worst_m = float(np.abs(np.concatenate([row_m - row_m.mean(), column_m - column_m.mean()])).max())
    worst, error = (format_quantity(value, "length") for value in (worst_m, fit.error_m))
    return AnalysisResult(
        {"row_hz": fit.row_hz, "column_hz": fit.column_hz},
        {
            "error_m": fit.error_m,
            "spread_m": float(np.sqrt((row_m.var() + column_m.var()) / 2)),
            "n_atoms": float(fit.overlay.n_atoms),
        },
        (
            offset_text(fit.overlay, probed),
            f"single rows and columns were up to {worst} away from that; r.m.s. uncertainty {error}",
        ),
        {"calibrations": probed.calibrations},
        lambda: draw_tone_offsets((row_m, fit.row_error_m), (column_m, fit.column_error_m)),
    )


def analyse_overlay(data: CalibrationData) -> AnalysisResult:
    """Find the offset at which most atoms survive.

    Raises:
        DeviceError: There is no such offset. The message says why, and where to look.
        ConfigError: The run is not a scan of a probe's offset.
    """
    probed = count_probed(data.run)
    fit = fit_overlay(probed.offset_m, probed.n_before, probed.n_survived, probed.grid)
    shape, error_m = fit.shape.values(), float(fit.error_m.max())
    n_before, n_survived = (counts.sum(axis=(1, 2)) for counts in (probed.n_before, probed.n_survived))
    axes = unit_axes(probed.grid)
    return AnalysisResult(
        {"offset_m": overlay_offset(fit.centre_m, probed.in_use_m), **shape},
        {"error_m": error_m, "dispersion": fit.dispersion, "n_atoms": float(fit.n_atoms), **shape},
        (f"{offset_text(fit, probed)}; uncertainty {format_quantity(error_m, 'length')}",),
        {"calibrations": probed.calibrations},
        lambda: draw_survival(
            probed.offset_m,
            n_before,
            n_survived,
            lambda offset_m: fit.shape.survival(distance_m(offset_m - fit.centre_m, axes)),
        ),
    )


def offset_text(fit: OverlayFit, probed: ProbeCounts) -> str:
    """The position of the mobile tweezers in the run, as text."""
    along, across = (format_quantity(float(-centre), "length") for centre in fit.centre_m)
    use = ", in addition to the correction in use" if np.any(probed.in_use_m) else ""
    where = f"from the sites by {along} along rows and {across} from row to row{use}"
    return f"{fit.n_atoms} atoms: the mobile tweezers were offset {where}"
