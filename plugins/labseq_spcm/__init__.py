"""Mobile tweezers on a Spectrum M4i.66xx arbitrary waveform generator."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the mobile tweezers ``spcm``, which play on a simulated card in a dry run."""
    tweezers, settings = "labseq_spcm.mobile_tweezers:SpcmMobileTweezers", "labseq_spcm.settings:SpcmSettings"
    simulated = "labseq_spcm.library:simulated_settings"
    registry.mobile_tweezers("spcm", tweezers, settings, simulated=simulated)
