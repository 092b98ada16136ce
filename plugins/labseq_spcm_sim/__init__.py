"""A Spectrum M4i.6631-x8 simulated at its registers, for the vendor's packages ``spcm_core`` and ``spcm``.

    card = SimulatedCard(clock)
    with installed(card) as name, spcm.Card(name) as device:
        ...
    card.played(0)

The driver ``labseq_spcm`` opens it as a :class:`SimulatedLibrary` where a profile says
``card: simulated``. The README says what the simulator does and does not model.
"""

from labseq_spcm_sim.card import LogEntry, SimulatedCard
from labseq_spcm_sim.faults import Faults
from labseq_spcm_sim.library import CardOutputs, SimulatedLibrary, install, installed, vendor_library_found
from labseq_spcm_sim.measured import card_with
from labseq_spcm_sim.output import SampleSpan
from labseq_spcm_sim.setup import M4I6621, M4I6622, M4I6631, CardModel, ErrorInfo, trigger_delay_s

__all__ = [
    "M4I6621",
    "M4I6622",
    "M4I6631",
    "CardModel",
    "CardOutputs",
    "ErrorInfo",
    "Faults",
    "LogEntry",
    "SampleSpan",
    "SimulatedCard",
    "SimulatedLibrary",
    "card_with",
    "install",
    "installed",
    "trigger_delay_s",
    "vendor_library_found",
]
