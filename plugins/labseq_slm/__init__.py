"""Static tweezers by a spatial light modulator (SLM)."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the static tweezers ``slm``, in a dry run on a simulated SLM."""
    tweezers, settings = "labseq_slm.static_tweezers:SlmStaticTweezers", "labseq_slm.settings:SlmSettings"
    registry.static_tweezers("slm", tweezers, settings, simulated={"output": "simulated"})
