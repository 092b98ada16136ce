"""The steps of the first contact with a Spectrum card, in their order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

from labseq.plugin import Context, Emergency, format_quantity
from labseq.plugin.first_contact import ContactStep, FirstContact
from labseq_spcm import (
    first_contact_card as card,
    first_contact_scope as scope,
    first_contact_transfer as transfer,
)
from labseq_spcm.first_contact_bench import Bench
from labseq_spcm.first_contact_verdict import STREAM, judge, streamed
from labseq_spcm.library import SIMULATED, Library
from labseq_spcm.settings import SpcmSettings

OFF: Final = "outputs off"


class SpcmFirstContact(FirstContact):
    """The first contact with a card, without the driver.

    Args:
        settings: The settings of the driver.
        context: Name, clock, and the limits of the AODs.
        library: Where the card comes from.
    """

    def __init__(self, settings: SpcmSettings, context: Context, library: Library) -> None:
        self._bench = Bench(settings, context, library)
        self._settings = settings
        self.is_simulated = settings.card.startswith(SIMULATED)
        full_scale = format_quantity(context.motion.rf.full_scale_v, "voltage")
        self.steps = tuple(_steps(self._bench, full_scale))
        self.units = card.UNITS | transfer.UNITS

    def open(self) -> Mapping[str, Any]:
        """Open the card, stop it and open its relays."""
        identity = self._bench.open()
        self._bench.safe_state()
        return identity

    def safe_state(self) -> None:
        """Stop, open the relays, reset."""
        self._bench.safe_state()

    def close(self) -> None:
        """Close the card."""
        self._bench.close()

    def emergency(self) -> Emergency | None:
        """The driver's script."""
        return self._bench.emergency(Path(__file__).with_name("emergency.py"))

    def judge(self, measured: Mapping[str, Mapping[str, Any]]) -> Mapping[str, Any]:
        """See :func:`labseq_spcm.first_contact_verdict.judge`."""
        return judge(measured, self._settings)


def _with_settings(run: Callable[[Bench], Mapping[str, Any]], bench: Bench) -> Mapping[str, Any]:
    """The result of a step with the settings of a stream, which a later first contact may not share."""
    return {**run(bench), "settings": streamed(bench.settings)}


def _steps(bench: Bench, full_scale: str) -> Iterator[ContactStep]:
    def step(
        name: str, does: str, limit_s: float, run: Callable[[Bench], Mapping[str, Any]], **more: Any
    ) -> ContactStep:
        take = partial(_with_settings, run) if name in dict(STREAM) else run
        return ContactStep(name, does, limit_s, partial(take, bench), **more)

    relays = "outputs at 0 V, their relays close for a moment"
    at_80_mv = "outputs on at 80 mV into 50 Ohm"
    load = "both outputs to 50 Ohm inputs of the oscilloscope, no amplifiers"
    yield step("identity", f"reads what the card is and can do ({OFF})", 10, card.identity)
    yield step("times", f"times resets, starts and transfers ({relays})", 30, card.times)
    yield step("positions", f"hands silence over and reads positions ({OFF})", 20, transfer.positions)
    yield step("write_speed", f"writes to the card at some notify sizes ({OFF})", 120, transfer.write_speed)
    yield step("lag", f"times reports, also on a busy computer ({OFF})", 60, transfer.lag)
    yield step("sustained", f"plays silence at the sample rate for 1 s ({OFF})", 30, transfer.sustained)
    yield step("starve", f"lets the card run dry, and starts it again ({OFF})", 20, transfer.starve)
    yield step("threads", f"calls the library from two threads at once ({OFF})", 20, card.threads)
    second = f"kills a second process that plays, and stops the card from a third ({OFF})"
    yield step("second_process", second, 60, card.second_process)
    yield step("dds", f"reads what the option DDS offers ({OFF})", 10, card.dds)
    yield step(
        "reference", f"makes rates from an external 10 MHz reference ({OFF})", 30, card.reference,
        needs="reference", prepare="10 MHz to the clock input",
    )  # fmt: skip
    yield step(
        "relay_steps", f"closes and opens the output relays five times ({relays})", 10, scope.relay_steps,
        needs="scope", prepare=f"{load}, 20 mV per division, 1 ms per division, single shot",
        readings=scope.RELAYS,
    )  # fmt: skip
    yield step(
        "overwrite", f"writes 20 bursts over silence, 10 ms apart ({at_80_mv})", 20, scope.overwrite,
        needs="scope", prepare=f"{load}, 50 ms per division with peak detection, single shot at 40 mV",
        readings=scope.OVERWRITE,
    )  # fmt: skip
    yield step(
        "trigger", f"plays a pulse at each edge at Ext0 for 10 s ({at_80_mv})", 30, scope.trigger,
        needs="scope", prepare=f"{load}, a pulse generator at 100 Hz to Ext0 and to the oscilloscope's "
        "trigger, infinite persistence", readings=scope.TRIGGER,
    )  # fmt: skip
    yield step(
        "killed", f"kills a process that plays a tone, stops it 0.5 s later ({at_80_mv})", 60, scope.killed,
        needs="scope", prepare=f"{load}, 200 ms per division, single shot at 40 mV", readings=scope.KILL,
    )  # fmt: skip
    yield step(
        "ramp", f"plays moves at {full_scale} into 50 Ohm, and has the driver make the card safe", 60,
        scope.ramp, needs="scope", prepare=f"{load}, 500 us per division, single shot, before the end of "
        "the tones", readings=scope.RAMP,
    )  # fmt: skip
