"""Tones off the atoms that keep the AODs warm between programs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Context, LimitError, format_quantity
from labseq_spcm.settings import KeepWarmSettings


@dataclass(frozen=True, slots=True)
class KeepWarm:
    """One tone per axis, first the row axis.

    Attributes:
        hz: Frequency of each tone.
        amplitude: Amplitude of each tone, of full scale.
    """

    hz: tuple[float, float]
    amplitude: tuple[float, float]


def keep_warm_tones(name: str, settings: KeepWarmSettings, context: Context) -> KeepWarm:
    """The tones for these settings, checked against grid, bands and amplifiers.

    Raises:
        LimitError: A frequency is outside the AOD's band or among the tones of the mobile tweezers, or the
            power is too much.
    """
    grid, motion = context.grid, context.motion
    rf, amplitudes = motion.rf, list[float]()
    for axis, hz, sites_hz, band, full, n_most in (
        ("row", settings.row_frequency, grid.row_frequency_hz, rf.row_band_hz, rf.row_amplitudes,
         motion.max_row_tones),
        ("column", settings.column_frequency, grid.column_frequency_hz, rf.column_band_hz,
         rf.column_amplitudes, motion.max_column_tones),
    ):  # fmt: skip
        _check_parking(name, axis, hz, sites_hz, motion.eject_slots, band)
        tone_amplitudes = full or (1 / n_most,) * n_most
        power = (
            sum(a**2 for a in sorted(tone_amplitudes)[-n_most:])
            if settings.amplitude is None
            else settings.amplitude**2
        )
        power_w = power * rf.full_scale_power_w
        if power_w > rf.max_mean_power_w:
            most, mean_power = (format_quantity(w, "power") for w in (rf.max_mean_power_w, power_w))
            quantity = f"{name}: mean power of the {axis} axis' keep-warm tone"
            raise LimitError(quantity, mean_power, f"{most} at the AOD", setting=("keep_warm", "amplitude"))
        amplitudes.append(math.sqrt(min(1.0, power)))
    return KeepWarm((settings.row_frequency, settings.column_frequency), (amplitudes[0], amplitudes[1]))


def _check_parking(
    name: str, axis: str, hz: float, sites_hz: NDArray[np.float64], slots: int, band: tuple[float, float]
) -> None:
    """Refuse a tone that could heat an atom, or that the AOD does not deflect."""
    step_hz = float(np.abs(np.diff(sites_hz)).max(initial=0.0))
    # half a tone spacing beyond the outermost place of a mobile tweezer (ours)
    reach_hz = (slots + 0.5) * step_hz
    below, above = float(sites_hz.min()) - reach_hz, float(sites_hz.max()) + reach_hz
    if band[0] <= hz <= band[1] and not below < hz < above:
        return
    ranges = [(low, high) for low, high in ((band[0], below), (above, band[1])) if low <= high]
    free = " or ".join(f"{low / 1e6:.6g} to {high / 1e6:.6g} MHz" for low, high in ranges)
    limit = f"{free}, within the AOD's band and off the atoms"
    if not ranges:
        limit = "none, since the mobile tweezers need the whole band; lower eject_slots"
    key = f"{axis}_frequency"
    setting = f"{name}: keep_warm.{key}"
    raise LimitError(setting, f"{hz / 1e6:.6g} MHz", limit, setting=("keep_warm", key))


def tone_samples(
    tones: KeepWarm, sample_rate_hz: float, row_channel: int, n_samples: int
) -> NDArray[np.int16]:
    """Samples of both outputs with a whole number of periods, to be repeated, int16 (n_samples, 2)."""
    frames = np.empty((n_samples, 2), np.int16)
    for axis, channel in enumerate((row_channel, 1 - row_channel)):
        periods = round(tones.hz[axis] / sample_rate_hz * n_samples)
        turns = np.arange(n_samples) * periods % n_samples / n_samples
        frames[:, channel] = np.rint(32767 * tones.amplitude[axis] * np.cos(2 * np.pi * turns))
    return frames
