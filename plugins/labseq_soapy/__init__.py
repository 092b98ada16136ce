"""Static tweezers on a software-defined radio, by SoapySDR."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the static tweezers ``soapy``; in a dry run on a simulated radio, if that can be compiled."""
    from labseq_soapy_sim import can_build

    from labseq_soapy.settings import SoapySettings
    from labseq_soapy.static_tweezers import SoapyStaticTweezers

    simulated = {"device": "simulated"} if can_build() else None
    registry.static_tweezers("soapy", SoapyStaticTweezers, SoapySettings, simulated=simulated)
