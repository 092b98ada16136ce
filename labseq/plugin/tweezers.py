"""Limits of tone programs, amplitudes and ramps, for drivers of tweezers."""

from __future__ import annotations

import math
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from labseq.errors import LimitError
from labseq.kernels.kernel import const, kernel
from labseq.model import AxisTones, ToneProgram
from labseq.roles import Context

__all__ = [
    "Amplitudes",
    "calibrated_amplitudes",
    "calibrated_weights",
    "check_amplitudes",
    "check_ramp",
    "check_tone_program",
    "check_weights",
]

Floats = NDArray[np.float64]
Amplitudes: TypeAlias = tuple[Floats, Floats]
"""Amplitudes of the row tones (n_rows,) and of the column tones (n_cols,), fractions of full scale."""

ROUNDING: Final = 1e-9
"""Amount by which rounding may raise a sum of amplitudes above its limit."""
REALS: Final = const("float64", 1)


def check_tone_program(
    name: str,
    program: ToneProgram,
    row_band_hz: tuple[float, float],
    column_band_hz: tuple[float, float],
    most: float = 1.0,
) -> None:
    """Refuse a tone program that must not reach the outputs, whatever made it.

    Args:
        name: Name of the device, for the message.
        program: The program to play.
        row_band_hz: Band of the row axis' AOD.
        column_band_hz: Band of the column axis' AOD.
        most: Largest sum of the amplitudes of an axis, of full scale.

    Raises:
        LimitError: The program has no length, leaves an AOD's band, clips, or has values that are not finite.
    """
    durations = program.duration_s
    if not (np.isfinite(durations).all() and (durations >= 0).all()):
        raise LimitError(f"{name}: a segment's duration", "negative or not finite", "0 s or more")
    if not program.total_duration_s > 0:
        raise LimitError(f"{name}: length of the program", "0 s", "more than 0 s")
    for axis_name, axis, band_hz in (
        ("row", program.row, row_band_hz),
        ("column", program.column, column_band_hz),
    ):
        tones = axis.start_hz, axis.end_hz, axis.start_amplitude, axis.end_amplitude, axis.phase_rad
        # one pass by a kernel, because only the error needs the number of the tone
        if not is_within(*tones, axis.offsets, *band_hz, most + ROUNDING):
            raise _excess(name, axis_name, axis, program.batch, band_hz, most)


def _excess(
    name: str,
    axis_name: str,
    axis: AxisTones,
    batch: NDArray[np.int32],
    band_hz: tuple[float, float],
    most: float,
) -> LimitError:
    """The error for the first tone outside of its limits, or for a sum of amplitudes that is too high."""
    band = f"the AOD's band, {band_hz[0] / 1e6:.6g} to {band_hz[1] / 1e6:.6g} MHz"
    amplitudes, full = (axis.start_amplitude, axis.end_amplitude), "of full scale"
    for quantity, values_at_ends, (least, greatest), scale, unit, limit in (
        ("frequency", (axis.start_hz, axis.end_hz), band_hz, 1e6, "MHz", band),
        ("phase", (axis.phase_rad,), (-math.inf, math.inf), 1.0, "rad", "a finite number of radians"),
        ("amplitude", amplitudes, (0.0, most + ROUNDING), 1.0, full, f"0 to {most:g} {full}"),
    ):
        values = np.stack(values_at_ends, axis=1)
        wrong = ~(np.isfinite(values) & (values >= least) & (values <= greatest))
        if wrong.any():
            tone, end = np.argwhere(wrong)[0]
            segment = int(np.searchsorted(axis.offsets, tone, "right")) - 1
            number, place = tone - axis.offsets[segment], f"segment {segment} (batch {batch[segment]})"
            value = f"{values[tone, end] / scale:.9g} {unit}"
            return LimitError(f"{name}: {quantity} of {axis_name} tone {number} in {place}", value, limit)
    # sums over the tones of each segment, as differences of running sums
    running = np.pad(np.cumsum(amplitudes, axis=1), ((0, 0), (1, 0)))
    sums = np.diff(running[:, axis.offsets]).max(axis=0)
    segment = int(sums.argmax())
    quantity_name = f"{name}: sum of the {axis_name} amplitudes in segment {segment} (batch {batch[segment]})"
    return LimitError(quantity_name, f"{sums[segment]:.9g} {full}", f"{most:g}, above which the output clips")


@kernel(
    f"boolean({REALS}, {REALS}, {REALS}, {REALS}, {REALS}, {const('int32', 1)}, float64, float64, float64)"
)
def is_within(
    start_hz: Floats, end_hz: Floats, start: Floats, end: Floats, phase_rad: Floats,
    offsets: NDArray[np.int32], low_hz: float, high_hz: float, most: float,
) -> bool:  # fmt: skip
    """Whether the tones of an axis are in a band, and the sums of their amplitudes at most ``most``."""
    for segment in range(len(offsets) - 1):
        sum_start = sum_end = 0.0
        for i in range(offsets[segment], offsets[segment + 1]):
            if not (low_hz <= start_hz[i] <= high_hz and low_hz <= end_hz[i] <= high_hz):
                return False
            if not (start[i] >= 0.0 and end[i] >= 0.0 and abs(phase_rad[i]) < np.inf):
                return False
            sum_start += start[i]
            sum_end += end[i]
        if not (sum_start <= most and sum_end <= most):
            return False
    return True


def calibrated_amplitudes(context: Context) -> Amplitudes:
    """The amplitudes of the active calibration, or equal amplitudes with a sum of full scale."""
    calibration = context.calibrations.get("tweezers")
    if calibration is None:
        return tuple(np.full(n, 1 / n) for n in context.grid.shape)  # pyright: ignore[reportReturnType]
    return calibration.values["row_amplitudes"], calibration.values["column_amplitudes"]


def check_amplitudes(name: str, amplitudes: Amplitudes, shape: tuple[int, int]) -> None:
    """Refuse amplitudes of static tweezers unless there is one of 0 or more for each of (n_rows, n_cols).

    Raises:
        LimitError: Their number is wrong, or one is negative or not finite.
    """
    for axis, values, n_tones in zip(("row", "column"), amplitudes, shape, strict=True):
        if values.shape != (n_tones,):
            raise LimitError(f"{name}: shape of the {axis} amplitudes", values.shape, (n_tones,))
        if not (np.isfinite(values).all() and (values >= 0).all()):
            raise LimitError(f"{name}: a {axis} amplitude", "negative or not finite", "0 or more")


def calibrated_weights(context: Context) -> Floats:
    """Weight of each site in the active calibration, float64 (n_rows, n_cols), with a mean of 1.

    All are 1 without a calibration, and for an array of tones, whose calibration has no weights of sites.
    """
    calibration = context.calibrations.get("tweezers")
    weights = None if calibration is None else calibration.values.get("weights")
    return np.ones(context.grid.shape) if weights is None else weights / weights.mean()


def check_weights(name: str, weights: Floats, shape: tuple[int, int]) -> None:
    """Refuse weights of static tweezers unless there is one above 0 for each of (n_rows, n_cols).

    Raises:
        LimitError: Their shape is wrong, or one is not above 0 or not finite.
    """
    if weights.shape != shape:
        raise LimitError(f"{name}: shape of the weights", weights.shape, shape)
    if not (np.isfinite(weights).all() and (weights > 0).all()):
        raise LimitError(f"{name}: a weight", "not above 0 or not finite", "more than 0")


def check_ramp(name: str, depth: float, duration_s: float, deepest: float) -> None:
    """Refuse a ramp of static tweezers to an impossible depth, or with an impossible duration.

    Raises:
        LimitError: The depth or the duration is impossible.
    """
    if not 0 <= depth <= deepest:
        raise LimitError(f"{name}: depth", f"{depth:g} of the nominal depth", f"0 to {deepest:g} of it")
    if not 0 <= duration_s < math.inf:
        raise LimitError(f"{name}: duration of the ramp", f"{duration_s:g} s", "0 or more")
