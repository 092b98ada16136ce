"""The cards that the driver plays on. An open card tells its limits, so the table is for earlier checks.

Source of the table: Spectrum's manual "M4i.66xx/M4i.96xx", technical data.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from labseq_spcm.limits import FRAME_BYTES

SWITCHED_MV: Final = (420, 480)
"""Both paths of the amplifier make these amplitudes. The earlier amplitude decides which one is used."""
HIGH_BANDWIDTH: Final = "-hbw"
"""Ending of the name of a card with this option, whose amplifier has the low path only."""


@dataclass(frozen=True, slots=True)
class Model:
    """What a card can do.

    Attributes:
        name: Product name.
        n_outputs: Number of its outputs.
        rate_hz: Lowest and highest sample rate.
        amplitude_mv: Smallest and largest peak voltage into 50 Ohm, in steps of 1 mV.
        bus_bytes_per_s: Speed of its bus towards it.
    """

    name: str
    n_outputs: int
    rate_hz: tuple[float, float]
    amplitude_mv: tuple[int, int]
    bus_bytes_per_s: float

    @property
    def relay_mv(self) -> tuple[int, int] | None:
        """The amplitudes at which the amplifier's path may change, None if it has only one."""
        return SWITCHED_MV if self.amplitude_mv[1] > SWITCHED_MV[1] else None

    @property
    def fifo_rate_hz(self) -> float:
        """The highest sample rate of a stream on two outputs."""
        return min(self.rate_hz[1], self.bus_bytes_per_s / FRAME_BYTES)


def _models() -> dict[str, Model]:
    """All models by name, PCIe x8 with 2.8 GB/s and PXIe x4 with 1.5 GB/s (of any transfer)."""
    slow, fast = (50e6, 625e6), (50e6, 1.25e9)
    models: dict[str, Model] = {}
    for series, lanes, speed in (("M4i", "x8", 2.8e9), ("M4x", "x4", 1.5e9)):
        for family, rate_hz, most_mv, outputs in (
            (662, slow, 2500, (1, 2, 4)),
            (663, fast, 2000, (1, 2)),
            (962, slow, 2500, (1, 2, 4)),
        ):
            for version, n_outputs in enumerate(outputs):
                name = f"{series}.{family}{version}-{lanes}"
                models[name] = model = Model(name, n_outputs, rate_hz, (80, most_mv), speed)
                if family == 663:
                    name += HIGH_BANDWIDTH
                    models[name] = replace(model, name=name, amplitude_mv=(80, SWITCHED_MV[1]))
    return models


MODELS: Final = _models()
ANY: Final = Model("Spectrum card", 2, (50e6, 1.25e9), (80, 2500), 2.8e9)
"""For checks before a card is open whose model the profile does not name, what any of them can do."""
FAMILY_NAMES: Final = "a Spectrum M4i.66xx, M4x.66xx, M4i.96xx or M4x.96xx with two or four outputs"


def model_name(code: int) -> str:
    """Name of a model in the table by the type that a card reads (series, family and version)."""
    series, lanes = {7: ("M4i", "x8"), 8: ("M4x", "x4")}.get(code >> 16 & 0xFF, ("", ""))
    return f"{series}.{code & 0xFFFF:04x}-{lanes}"
