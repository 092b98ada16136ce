"""Mobile tweezers on a Spectrum M4i.66xx arbitrary waveform generator."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the mobile tweezers ``spcm``; in a dry run they play on a simulated card."""
    from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
    from labseq_spcm.settings import SpcmSettings

    simulated = {"card": "simulated", "trigger": "software", "serial": 0}
    registry.mobile_tweezers("spcm", SpcmMobileTweezers, SpcmSettings, simulated=simulated)
