"""Static tweezers on a software-defined radio, by SoapySDR."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the static tweezers ``soapy``, in a dry run on a simulated radio."""
    tweezers, settings = (
        "labseq_soapy.static_tweezers:SoapyStaticTweezers",
        "labseq_soapy.settings:SoapySettings",
    )
    registry.static_tweezers("soapy", tweezers, settings, simulated={"device": "simulated"})
