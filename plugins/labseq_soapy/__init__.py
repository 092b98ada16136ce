"""Static tweezers on a software-defined radio, by SoapySDR."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the static tweezers ``soapy``; in a dry run on a simulated radio, if that can be compiled."""
    module = "labseq_soapy.static_tweezers"
    settings, simulated = "labseq_soapy.settings:SoapySettings", f"{module}:simulated_settings"
    registry.static_tweezers("soapy", f"{module}:SoapyStaticTweezers", settings, simulated=simulated)
