"""Making the outputs harmless, whatever state the card is in."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Final

from labseq.plugin import LabseqError
from labseq_spcm import limits
from labseq_spcm.card import AwgCard
from labseq_spcm.setup import output_registers

RAMP_S: Final = 0.3e-3
"""How long the amplifiers take to ramp a program down that is cut short."""
RAMP_STEPS: Final = 15


def make_safe(card: AwgCard, amplitude_mv: int, give_up: Callable[[], object]) -> None:
    """Ramp down what plays, stop the card, open the output relays.

    Args:
        card: The open card, in any state, its driver perhaps locked by an error.
        amplitude_mv: What the outputs' amplitude is, and shall be again.
        give_up: Forgets the program that is cut short.

    Raises:
        DeviceError: The card refused something; all the rest was done nevertheless.
    """
    actions: list[Callable[[], object]] = [card.stop]
    actions += [partial(card.set, register, 0, "output") for register in output_registers(card.spcm)]
    actions += [partial(_set_amplitudes, card, amplitude_mv), give_up]
    with suppress(LabseqError):
        card.clear_error()
        if card.running:
            _ramp_down(card, amplitude_mv)
    failures = [failure for action in actions if (failure := _attempt(action)) is not None]
    if failures:
        raise failures[0]


def _ramp_down(card: AwgCard, amplitude_mv: int) -> None:
    """Lower the amplitude in steps, within the amplifier's path."""
    low_mv, gap = limits.AMPLITUDE_MV[0], limits.RELAY_MV[1] + 1
    end_mv = gap if amplitude_mv >= gap else low_mv
    for step in range(1, RAMP_STEPS + 1):
        card.clock.sleep(RAMP_S / RAMP_STEPS)
        way_mv = (amplitude_mv - end_mv) * step / RAMP_STEPS
        _set_amplitudes(card, round(amplitude_mv - way_mv))


def _set_amplitudes(card: AwgCard, amplitude_mv: int) -> None:
    for register in (card.spcm.SPC_AMP0, card.spcm.SPC_AMP1):
        card.set(register, amplitude_mv, "output amplitude in mV")


def _attempt(action: Callable[[], object]) -> LabseqError | None:
    """Do something, once more if an earlier error still locked the driver; returns what failed for good."""
    with suppress(LabseqError):
        action()
        return None
    try:
        action()
    except LabseqError as failure:
        return failure
    return None
