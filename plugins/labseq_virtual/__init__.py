"""Virtual hardware that acts on one simulation of the atoms."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the simulation, and a virtual driver for each hardware role."""
    module, settings = "labseq_virtual", "labseq_virtual.settings"
    registry.simulation("virtual", f"{module}.simulation:VirtualSimulation", f"{settings}:SimulationSettings")
    for kind, factory, model in (
        (registry.camera, "camera:VirtualCamera", "CameraSettings"),
        (registry.static_tweezers, "tweezers:VirtualStaticTweezers", "StaticTweezersSettings"),
        (registry.mobile_tweezers, "tweezers:VirtualMobileTweezers", "MobileTweezersSettings"),
        (registry.device, "devices:VirtualDevice", "DeviceSettings"),
        (registry.lines, "devices:VirtualLines", "LinesSettings"),
    ):
        kind("virtual", f"{module}.{factory}", f"{settings}:{model}", virtual_time=True)
    synthesizer = f"{module}.devices:VirtualSynthesizer"
    registry.device("virtual_synthesizer", synthesizer, f"{settings}:SynthesizerSettings", virtual_time=True)
    spot_meter = f"{module}.spot_meter:VirtualSpotMeter"
    registry.device("virtual_spot_meter", spot_meter, f"{settings}:SpotMeterSettings", virtual_time=True)
