"""Tones that an AOD or its amplifier would not bear are refused before anything plays."""

from __future__ import annotations

from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from labseq.errors import LimitError
from labseq.model import RfSpec
from labseq.motion.axes import AXES, AxisIndex, Drive
from labseq.units import format_quantity


def refuse_excess(
    axis: AxisIndex,
    drive: Drive,
    rf: RfSpec,
    batch: NDArray[np.int32],
    offsets: NDArray[np.int32],
    values: NDArray[np.float64],
) -> None:
    """Refuse the tones of an axis that break a limit.

    Args:
        axis: 0 for the rows' tones, 1 for the columns'.
        drive: What the axis is driven with, and its limits.
        rf: The limits in the words of the profile.
        batch: int32 (>= n_segments,), batch of each segment.
        offsets: int32 (n_segments + 1,), where each segment's tones start.
        values: float64 (5, >= n_tones), the tones, see :mod:`labseq.kernels.tone_build`.

    Raises:
        LimitError: Too many tones, one outside of the AOD's band, two too close to one another,
            amplitudes that add up to more than full scale or than the amplifier bears, or too
            much mean power. It names the batch and the tone.
    """
    from labseq.kernels.tone_limits import WITHIN, first_excess

    n_tones = np.diff(offsets)
    if len(n_tones) and n_tones.max() > drive.max_tones:
        worst = int(n_tones.argmax())
        what = f"the number of {AXES[axis]} tones in batch {batch[worst]}"
        raise LimitError(what, n_tones[worst], drive.max_tones)
    fault, tone, value = first_excess(offsets, values, drive.limits)
    if fault != WITHIN:
        segment = int(np.searchsorted(offsets, tone, side="right")) - 1
        first, last = (int(n) for n in offsets[segment : segment + 2])
        _refuse(fault, value, axis, tone - first, last - first, int(batch[segment]), rf)


def _refuse(
    fault: int, value: float, axis: AxisIndex, tone: int, n_tones: int, batch: int, rf: RfSpec
) -> NoReturn:
    """Put an excess into words."""
    from labseq.kernels.tone_limits import AMPLITUDES, BAND, SPACING

    name = AXES[axis]
    in_batch = f"in batch {batch}"
    all_tones = f"{name} tones 0 to {n_tones - 1} {in_batch}" if n_tones > 1 else f"{name} tone 0 {in_batch}"
    if fault == BAND:
        low, high = (f"{hz / 1e6:.6g}" for hz in (rf.row_band_hz, rf.column_band_hz)[axis])
        what, limit = f"the frequency of {name} tone {tone} {in_batch}", f"the band of {low} to {high} MHz"
        raise LimitError(what, f"{value / 1e6:.6g} MHz", limit)
    if fault == SPACING:
        what = f"the distance of {name} tones {tone - 1} and {tone} {in_batch}"
        least = format_quantity(rf.min_spacing_hz, "frequency")
        raise LimitError(what, f"{value / 1e6:.6g} MHz", f"{least} at least, in the order of the sites")
    if fault == AMPLITUDES and rf.full_scale_v > rf.max_peak_v:
        what, came = f"the peak voltage of {all_tones}", format_quantity(value * rf.full_scale_v, "voltage")
        raise LimitError(what, came, f"{format_quantity(rf.max_peak_v, 'voltage')}: more ruins the amplifier")
    if fault == AMPLITUDES:
        what = f"the sum of the amplitudes of {all_tones}"
        raise LimitError(what, f"{value:.6g} of full scale", "1: the output would clip")
    power_w = value * rf.full_scale_power_w
    limit = f"{format_quantity(rf.max_mean_power_w, 'power')} at the AOD"
    raise LimitError(f"the mean RF power of {all_tones}", format_quantity(power_w, "power"), limit)
