"""Sets up the card once, with the outputs off, in the order of the manual.

Reset, active channels, clock, outputs, trigger. Every value is read back, because the card rounds some and
snaps others.
"""

from __future__ import annotations

from importlib import metadata
from typing import Any

from labseq.plugin import DeviceError
from labseq_spcm import limits
from labseq_spcm.card import AwgCard
from labseq_spcm.settings import SpcmSettings


def check_type(card: AwgCard, settings: SpcmSettings) -> None:
    """Check that it is the card that the settings name, and that it can do what they ask for.

    Raises:
        DeviceError: It is another one, or too slow.
    """
    spcm = card.spcm
    n_channels = card.read(spcm.SPC_MIINST_MODULES) * card.read(spcm.SPC_MIINST_CHPERMODULE)
    family = (card.read(spcm.SPC_PCITYP) & spcm.TYP_FAMILYMASK) >> 8
    if family != limits.FAMILY or n_channels != 2:
        text = f"the card '{settings.card}' is a {card.product} with {n_channels} channels"
        raise DeviceError(card.name, f"{text}; expected {limits.FAMILY_NAME}: name another one as `card`")
    if settings.serial and card.serial_number != settings.serial:
        text = f"the card '{settings.card}' has the serial number {card.serial_number}"
        raise DeviceError(card.name, f"{text}; expected {settings.serial}: name another one as `card`")
    fastest_hz, rate_hz = card.read(spcm.SPC_MIINST_MAXADCLOCK), settings.sample_rate
    if rate_hz > fastest_hz:
        text = f"the {card.product} makes at most {fastest_hz / 1e6:g} MS/s"
        raise DeviceError(card.name, f"{text}; lower sample_rate from {rate_hz / 1e6:g} MHz")


def set_up(card: AwgCard, settings: SpcmSettings, amplitude_mv: int) -> dict[str, Any]:
    """Set up everything that does not depend on the mode; returns facts about the card and its real rate."""
    card.command(card.spcm.M2CMD_CARD_RESET, "reset")
    card.set(card.spcm.SPC_CHENABLE, 0b11, "active channels")
    rate_hz = _set_clock(card, settings)
    _set_outputs(card, amplitude_mv)
    _set_trigger(card, settings)
    return {
        "model": card.product,
        "serial_number": card.serial_number,
        "driver_version": _version(card, card.spcm.SPC_GETDRVVERSION),
        "sample_rate_hz": rate_hz,
        "trigger_delay_s": limits.trigger_delay_s(rate_hz),
        "amplitude_mv": amplitude_mv,
        "trigger_level_mv": card.read(card.spcm.SPC_TRIG_EXT0_LEVEL0),
    }


def versions(card: AwgCard) -> dict[str, tuple[str, str]]:
    """Versions of the vendor's software and of the firmware: installed, tested; no real card was tested."""
    spcm = card.spcm
    return {
        "package spcm_core": (metadata.version("spcm_core"), "1.0.11"),
        "driver": (_version(card, spcm.SPC_GETDRVVERSION), ""),
        "kernel driver": (_version(card, spcm.SPC_GETKERNELVERSION), ""),
        "main control firmware": (str(card.read(spcm.SPCM_FW_CTRL) & 0xFFFF), ""),
    }


def _version(card: AwgCard, register: int) -> str:
    """Major, minor, build, as the manual has them in one register."""
    value = card.read(register)
    return f"{value >> 24}.{value >> 16 & 0xFF}.{value & 0xFFFF}"


def _set_clock(card: AwgCard, settings: SpcmSettings) -> float:
    """Set the sample clock; returns the rate that it really makes, in Hz.

    It is written to the card here, with the outputs off, because the PLL may take 0.2 s to lock.
    """
    spcm, reference_hz = card.spcm, settings.reference_clock
    rate_hz, tolerance_hz = round(settings.sample_rate), limits.RATE_STEP_HZ
    if reference_hz is None:
        card.set(spcm.SPC_CLOCKMODE, spcm.SPC_CM_INTPLL, "clock mode")
    else:
        card.set(spcm.SPC_CLOCKMODE, spcm.SPC_CM_EXTREFCLOCK, "clock mode")
        card.set(spcm.SPC_REFERENCECLOCK, round(reference_hz), "reference clock in Hz")
        tolerance_hz = round(limits.REFERENCE_TOLERANCE * rate_hz)
    actual_hz = card.set(spcm.SPC_SAMPLERATE, rate_hz, "sample rate in Hz", tolerance_hz)
    card.write_setup()
    return float(actual_hz)


def _set_outputs(card: AwgCard, amplitude_mv: int) -> None:
    """Relays open, then amplitude, 0 V when stopped, no filter."""
    spcm, zero = card.spcm, card.spcm.SPCM_STOPLVL_ZERO
    switch_output(card, 0, on=False)
    switch_output(card, 1, on=False)
    set_amplitude(card, amplitude_mv)
    card.set(spcm.SPC_CH0_STOPLEVEL, zero, "output 0 when stopped")
    card.set(spcm.SPC_CH1_STOPLEVEL, zero, "output 1 when stopped")
    card.set(spcm.SPC_FILTER0, 0, "filter of output 0")
    card.set(spcm.SPC_FILTER1, 0, "filter of output 1")


def _set_trigger(card: AwgCard, settings: SpcmSettings) -> None:
    """No source at all for the software trigger: it is forced, which works alike in all modes."""
    spcm = card.spcm
    card.set(spcm.SPC_TRIG_ANDMASK, spcm.SPC_TMASK_NONE, "trigger AND mask")
    if settings.trigger == "software":
        card.set(spcm.SPC_TRIG_ORMASK, spcm.SPC_TMASK_NONE, "trigger source")
        return
    edge = spcm.SPC_TM_POS if settings.trigger_edge == "rising" else spcm.SPC_TM_NEG
    card.set(spcm.SPC_TRIG_ORMASK, spcm.SPC_TMASK_EXT0, "trigger source")
    card.set(spcm.SPC_TRIG_EXT0_MODE, edge, "trigger edge")
    card.set(spcm.SPC_TRIG_TERM, int(settings.trigger_50_ohm), "trigger termination")
    level_mv = round(1e3 * settings.trigger_level)
    card.set(spcm.SPC_TRIG_EXT0_LEVEL0, level_mv, "trigger level in mV", limits.TRIGGER_STEP_MV)


def set_amplitude(card: AwgCard, amplitude_mv: int) -> None:
    """Set the amplitude of both outputs, also while they play."""
    card.set(card.spcm.SPC_AMP0, amplitude_mv, "amplitude of output 0 in mV")
    card.set(card.spcm.SPC_AMP1, amplitude_mv, "amplitude of output 1 in mV")


def close_relays(card: AwgCard) -> bool:
    """Close the relays of both outputs; whether any was open, and has to settle now."""
    spcm = card.spcm
    if card.read(spcm.SPC_ENABLEOUT0) and card.read(spcm.SPC_ENABLEOUT1):
        return False
    switch_output(card, 0, on=True)
    switch_output(card, 1, on=True)
    card.write_setup()
    return True


def switch_output(card: AwgCard, channel: int, *, on: bool) -> None:
    """Close or open the relay of an output, with the next WRITESETUP or start."""
    register = card.spcm.SPC_ENABLEOUT1 if channel else card.spcm.SPC_ENABLEOUT0
    card.set(register, int(on), f"output {channel}")
