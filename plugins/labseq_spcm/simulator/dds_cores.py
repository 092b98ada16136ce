"""The cores of the DDS: what each does now, and what they have put out from event to event."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq_spcm.simulator import registers as r
from labseq_spcm.simulator.output import Tone, ToneSpan

Masks = tuple[int, int]
"""For each channel the cores that it has, a bit each."""

FREQUENCY, FREQUENCY_SLOPE, AMPLITUDE, AMPLITUDE_SLOPE, PHASE = range(5)
"""Rows of what the cores do, in the order of their registers and of the fields of :class:`Tone`."""
KIND: Final = 1000
"""From the registers of one kind to those of the next."""


@dataclass(frozen=True, slots=True)
class CoreOutputs:
    """What all cores put out between two events.

    Attributes:
        start_s: When it was first at the output, on the session's clock.
        end_s: When the next event changed it.
        cores: float64 (5, n_cores), at the start: frequency in Hz, its slope, amplitude, its slope,
            phase in radians.
        masks: Which cores each channel had.
    """

    start_s: float
    end_s: float
    cores: NDArray[np.float64]
    masks: Masks

    def until(self, now_s: float) -> CoreOutputs:
        """What of it was put out by now."""
        return self if self.end_s <= now_s else replace(self, end_s=now_s)

    def spans(self, channel: int) -> list[ToneSpan]:
        """What a channel put out, the volts left to its amplifier; none if that was silence."""
        own = _in_mask(self.masks[channel])
        found = zip(own, self.cores[:, own].T.tolist(), strict=True)
        tones = tuple(Tone(core, *does) for core, does in found if does[AMPLITUDE] or does[AMPLITUDE_SLOPE])
        return [ToneSpan(self.start_s, self.end_s, 0.0, tones)] if tones else []


@lru_cache
def _in_mask(mask: int) -> list[int]:
    """The cores of a mask."""
    return [core for core in range(mask.bit_length()) if mask >> core & 1]


class Cores:
    """All cores of one card.

    Args:
        n_cores: How many there are.

    Attributes:
        chords: What was put out between events since the start, in time's order.
    """

    def __init__(self, n_cores: int) -> None:
        self._n_cores = n_cores
        self.chords: list[CoreOutputs] = []
        self.silence()

    def silence(self) -> None:
        """Everything to zero."""
        self._now = np.zeros((5, self._n_cores))
        self._phase_deg: dict[int, float] = {}
        self._since_s = math.inf

    def go_on(self, to_s: float, masks: Masks) -> None:
        """Keep what was put out up to the next event, and carry all cores on to it."""
        self.chords += self.current_outputs(to_s, masks)
        duration_s = to_s - self._since_s
        self._since_s = to_s
        if duration_s > 0:
            self._now = carried_on(self._now, duration_s)

    def write(self, register: int, value: float, *, shift: bool) -> None:
        """Give a core a new value; its phase is set, or shifted by what differs from the phase set before."""
        kind, core = divmod(register - r.SPC_DDS_CORE0_FREQ, KIND)
        if kind == PHASE:
            before_deg = self._phase_deg.get(core, 0.0)
            self._phase_deg[core] = value
            value = math.radians(value)
            if shift:
                value += self._now[PHASE, core] - math.radians(before_deg)
        self._now[kind, core] = value

    def current_outputs(self, until_s: float, masks: Masks) -> list[CoreOutputs]:
        """What has been put out since the last event."""
        silent = not self._now[AMPLITUDE : AMPLITUDE_SLOPE + 1].any()
        if self._since_s >= until_s or silent:
            return []
        return [CoreOutputs(self._since_s, until_s, self._now.copy(), masks)]


def carried_on(cores: NDArray[np.float64], duration_s: float) -> NDArray[np.float64]:
    """What cores do some time later: straight lines, amplitudes within full scale.

    Args:
        cores: float64 (5, n), as in :class:`CoreOutputs`.
        duration_s: How much later.
    """
    later = cores.copy()
    later[FREQUENCY] += duration_s * cores[FREQUENCY_SLOPE]
    amplitude = later[AMPLITUDE]
    amplitude += duration_s * cores[AMPLITUDE_SLOPE]
    np.minimum(amplitude, 1.0, out=amplitude)
    np.maximum(amplitude, -1.0, out=amplitude)
    turns = (cores[FREQUENCY] + 0.5 * duration_s * cores[FREQUENCY_SLOPE]) * duration_s
    later[PHASE] += math.tau * (turns - np.rint(turns))
    return later
