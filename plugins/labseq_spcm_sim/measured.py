"""A simulated card with faults from a profile, or as a first contact has measured a real one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from labseq.plugin import DeviceError
from labseq_spcm_sim.card import SimulatedCard
from labseq_spcm_sim.faults import COPY_BYTES_PER_S, MANUAL_SPEEDS, Faults
from labseq_spcm_sim.setup import M4I6631, MODELS, CardModel

NewCard = Callable[..., SimulatedCard]


def card_with(faults: Mapping[str, Any], model: str = "") -> NewCard:
    """Factory of simulated cards for the settings of the driver.

    Args:
        faults: Its section ``faults``.
        model: Name of a model, "" for an M4i.6631-x8.

    Raises:
        ConfigError: The file of a first contact is missing, or was edited.
        DeviceError: There is no simulator of this model.
    """
    if (path := faults["first_contact"]) is not None:
        return measured_card(Path(path))
    if model and model not in MODELS:
        text = f"there is no simulated {model}; expected one of {', '.join(MODELS)}"
        raise DeviceError("spcm simulator", f"{text}, or no `model`")
    return partial(
        SimulatedCard,
        model=MODELS.get(model, M4I6631),
        faults=Faults(
            copies_samples=faults["copies_samples"],
            position_lag_s=faults["position_lag"],
            fifo_short_bytes=faults["fifo_short"],
            pinning_s=faults["pinning"],
            underrun_not_ready=faults["underrun_not_ready"],
            write_speeds=MANUAL_SPEEDS if faults["slow_small_blocks"] else (),
        ),
    )


def measured_card(path: Path) -> NewCard:
    """Factory of cards that behave as a first contact has measured.

    Raises:
        ConfigError: The file is missing, or was edited.
    """
    from labseq.plugin.first_contact import read_contact

    content = read_contact(path)
    measured: Mapping[str, Mapping[str, Any]] = {
        step: result for step, result in content["measured"].items() if "failed" not in result
    }
    card = content["card"]
    options = {"model": _model(card["model"], measured.get("identity", {})), "faults": _faults(measured)}
    return partial(SimulatedCard, serial_number=int(card["serial"]), **options)


def _model(name: str, identity: Mapping[str, Any]) -> CardModel:
    """The card's own figures, as far as the card reported them."""
    known = {key: value for key, value in identity.items() if value is not None}
    low_hz, high_hz = M4I6631.sample_rate_hz
    low_mv, high_mv = M4I6631.amplitude_mv
    return replace(
        MODELS.get(name, M4I6631),
        name=name,
        card_type=known.get("card_type", M4I6631.card_type),
        memory_samples=known.get("memory_bytes", 2 * M4I6631.memory_samples) // 2,
        sample_rate_hz=(known.get("lowest_rate_hz", low_hz), known.get("highest_rate_hz", high_hz)),
        amplitude_mv=(
            known.get("lowest_amplitude_mv", low_mv),
            known.get("highest_amplitude_mv", high_mv),
        ),
        temperature_c=known.get("base_card_c", M4I6631.temperature_c),
    )


def _faults(measured: Mapping[str, Mapping[str, Any]]) -> Faults:
    positions, lag = measured.get("positions", {}), measured.get("lag", {})
    starved, overwritten = measured.get("starve", {}), measured.get("overwrite", {})
    room, fetched = positions.get("card_buffer_bytes", 0), positions.get("fetched_before_start_bytes", 0)
    bursts, hand_over_s = overwritten.get("bursts"), positions.get("hand_over_s_per_byte", 0.0)
    speeds = measured.get("write_speed", {}).get("user", ())
    return Faults(
        copies_samples=hand_over_s > 0.5 / COPY_BYTES_PER_S
        if bursts is None
        else bursts < overwritten["in_time"],
        position_lag_s=lag.get("worst_s", 0.0),
        fifo_short_bytes=max(0, room - fetched),
        pinning_s=measured.get("times", {}).get("naming_64_kib_s", 0.0),
        underrun_not_ready=not starved.get("ready", True),
        write_speeds=tuple((size, speed) for size, speed in speeds),
    )
