"""Virtual hardware that acts on one simulation of the atoms."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the simulation, and a virtual driver for each hardware role."""
    from labseq_virtual import camera, devices, settings, simulation, tweezers

    registry.simulation("virtual", simulation.VirtualSimulation, settings.SimulationSettings)
    registry.camera("virtual", camera.VirtualCamera, settings.CameraSettings, virtual_time=True)
    registry.static_tweezers(
        "virtual", tweezers.VirtualStaticTweezers, settings.StaticTweezersSettings, virtual_time=True
    )
    registry.mobile_tweezers(
        "virtual", tweezers.VirtualMobileTweezers, settings.MobileTweezersSettings, virtual_time=True
    )
    registry.device("virtual", devices.VirtualDevice, settings.DeviceSettings, virtual_time=True)
    registry.lines("virtual", devices.VirtualLines, settings.LinesSettings, virtual_time=True)
    registry.device(
        "virtual_spot_meter", devices.VirtualSpotMeter, settings.SpotMeterSettings, virtual_time=True
    )
