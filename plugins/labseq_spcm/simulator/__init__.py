"""A Spectrum M4i.6631-x8 without the card: its registers and manners, for the real ``spcm``.

    card = SimulatedCard(clock)
    with installed(card) as name, spcm.Card(name) as device:
        ...
    card.played(0)

Imported only where a profile says ``card: simulated``; the README says what it does not model.
"""

from labseq_spcm.simulator.card import SimulatedCard
from labseq_spcm.simulator.facts import M4I6631, CardModel, trigger_delay_s
from labseq_spcm.simulator.install import install, installed, prepare, uninstall, vendor_library_found
from labseq_spcm.simulator.output import SampleSpan, Span, Tone, ToneSpan
from labseq_spcm.simulator.records import LogEntry
from labseq_spcm.simulator.rules import ErrorInfo

__all__ = [
    "M4I6631",
    "CardModel",
    "ErrorInfo",
    "LogEntry",
    "SampleSpan",
    "SimulatedCard",
    "Span",
    "Tone",
    "ToneSpan",
    "install",
    "installed",
    "prepare",
    "trigger_delay_s",
    "uninstall",
    "vendor_library_found",
]
