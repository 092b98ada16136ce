"""Sets up the card once, with the outputs off, in the order of the manual.

Reset, active channels, clock, outputs, trigger. Every value is read back, because the card rounds some and
snaps others.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import metadata
from typing import Any, Final

from labseq.plugin import DeviceError
from labseq_spcm import limits
from labseq_spcm.card import AwgCard
from labseq_spcm.models import FAMILY_NAMES, HIGH_BANDWIDTH, MODELS, Model, model_name
from labseq_spcm.settings import SpcmSettings

NEXT_OUTPUT: Final = 100
"""Distance from a register of an output to the same register of the next output."""


def check_type(card: AwgCard, settings: SpcmSettings) -> Model:
    """Check that the card is the one in the settings, and that it can do what they ask for.

    Raises:
        DeviceError: It is another card, or too slow.
    """
    model = read_model(card, settings.card, settings.model)
    if settings.serial and card.serial_number != settings.serial:
        text = f"the card '{settings.card}' has the serial number {card.serial_number}"
        raise DeviceError(card.name, f"{text}, not {settings.serial}; name another card as `card`")
    if max(settings.outputs) >= model.n_outputs:
        text = f"the {model.name} has {model.n_outputs} outputs"
        raise DeviceError(card.name, f"{text}; set row_channel and column_channel to two of them")
    is_streamed, (least_hz, fastest_hz) = settings.mode in ("fifo", "stream"), model.rate_hz
    most_hz, rate_hz = model.fifo_rate_hz if is_streamed else fastest_hz, settings.sample_rate
    if not least_hz <= rate_hz <= most_hz:
        how = f" in `mode: {settings.mode}`" if is_streamed else ""
        text = f"the {model.name} makes {least_hz / 1e6:g} to {most_hz / 1e6:g} MS/s{how}"
        raise DeviceError(card.name, f"{text}, but sample_rate is {rate_hz / 1e6:g} MHz")
    spcm = card.spcm
    mode = spcm.SPC_REP_FIFO_SINGLE if is_streamed else spcm.SPC_REP_STD_SINGLE
    if not card.read(spcm.SPC_AVAILCARDMODES) & mode:
        text = f"the {model.name} cannot play samples as it is (it lacks card mode {mode:#x})"
        hint = "it needs the option AWG and its firmware, which Spectrum's Control Center switches on"
        raise DeviceError(card.name, f"{text}; {hint}")
    return model


def read_model(card: AwgCard, device: str, named: str) -> Model:
    """The open card's own limits.

    Args:
        card: The card.
        device: Its device name.
        named: Its model in the settings, "" for any.

    Raises:
        DeviceError: It is another model, of another family, or has too few outputs.
    """
    spcm, product = card.spcm, card.product
    n_outputs = card.read(spcm.SPC_MIINST_MODULES) * card.read(spcm.SPC_MIINST_CHPERMODULE)
    code = card.read(spcm.SPC_PCITYP)
    row = MODELS.get(model_name(code))
    if row is None:
        is_fast = code & spcm.TYP_FAMILYMASK == spcm.TYP_M5I63XX_X16 & spcm.TYP_FAMILYMASK
        why = ", whose steps of memory, amplifiers and delays labseq does not know" if is_fast else ""
        text = f"the card '{device}' is a {product} with {n_outputs} outputs{why}"
        raise DeviceError(card.name, f"{text}; name {FAMILY_NAMES} as `card`")
    if n_outputs < 2:
        why = "both axes must be on one card, as labseq does not drive the star-hub that starts two together"
        text = f"the card '{device}' is a {product} with one output, but {why}"
        raise DeviceError(card.name, f"{text}; use {FAMILY_NAMES}")
    model = replace(
        row,
        name=product,
        n_outputs=n_outputs,
        rate_hz=(float(card.read(spcm.SPC_MIINST_MINADCLOCK)), float(card.read(spcm.SPC_MIINST_MAXADCLOCK))),
        amplitude_mv=(card.read(spcm.SPC_READAOGAINMIN), card.read(spcm.SPC_READAOGAINMAX)),
    )
    actual = row.name + HIGH_BANDWIDTH * (model.relay_mv is None)
    if named and named != actual:
        raise DeviceError(card.name, f"the card '{device}' is a {actual}, but `model` is {named}")
    return model


def set_up(card: AwgCard, settings: SpcmSettings, amplitude_mv: int) -> dict[str, Any]:
    """Set up everything that does not depend on the mode. Returns facts about the card and its real rate."""
    card.command(card.spcm.M2CMD_CARD_RESET, "reset")
    card.set(card.spcm.SPC_CHENABLE, sum(1 << channel for channel in card.outputs), "active channels")
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


def identity(card: AwgCard) -> dict[str, str]:
    """Serial number, model, driver and firmware, for which a first contact is valid."""
    software = versions(card)
    return {
        "serial": str(card.serial_number),
        "model": card.product,
        "driver": software["driver"][0],
        "firmware": software["main control firmware"][0],
    }


def versions(card: AwgCard) -> dict[str, tuple[str, str]]:
    """Versions of the vendor's software and the firmware, installed and tested. No real card was tested."""
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
    """Set the sample clock, and return the rate that it really makes, in Hz.

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
    for output in range(card.n_outputs):
        switch_output(card, output, on=False)
    set_amplitude(card, amplitude_mv)
    for output in card.outputs:
        card.set(spcm.SPC_CH0_STOPLEVEL + output, zero, f"output {output} when stopped")
        card.set(spcm.SPC_FILTER0 + NEXT_OUTPUT * output, 0, f"filter of output {output}")


def _set_trigger(card: AwgCard, settings: SpcmSettings) -> None:
    """Set the trigger, with no source for the software trigger, which is forced in all modes."""
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
    for output in card.outputs:
        register = card.spcm.SPC_AMP0 + NEXT_OUTPUT * output
        card.set(register, amplitude_mv, f"amplitude of output {output} in mV")


def close_relays(card: AwgCard) -> bool:
    """Close the relays of both outputs. True if any was open, and has to settle now."""
    registers = [card.spcm.SPC_ENABLEOUT0 + NEXT_OUTPUT * output for output in card.outputs]
    if all(card.read(register) for register in registers):
        return False
    for output in card.outputs:
        switch_output(card, output, on=True)
    card.write_setup()
    return True


def switch_output(card: AwgCard, output: int, *, on: bool) -> None:
    """Close or open the relay of an output, with the next WRITESETUP or start."""
    card.set(card.spcm.SPC_ENABLEOUT0 + NEXT_OUTPUT * output, int(on), f"output {output}")
