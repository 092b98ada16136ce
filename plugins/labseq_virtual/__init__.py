"""Virtual hardware on one simulated world."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the world, and a virtual twin for each hardware role."""
    from labseq_virtual import (
        camera,
        devices as device,
        devices as lines,
        devices as spot_meter,
        settings,
        tweezers as mobile_tweezers,
        tweezers as static_tweezers,
        world,
    )

    mobile, static = mobile_tweezers.VirtualMobileTweezers, static_tweezers.VirtualStaticTweezers
    registry.simulation("virtual", world.World, settings.WorldSettings)
    registry.camera("virtual", camera.VirtualCamera, settings.CameraSettings, virtual_time=True)
    registry.static_tweezers("virtual", static, settings.StaticTweezersSettings, virtual_time=True)
    registry.mobile_tweezers("virtual", mobile, settings.MobileTweezersSettings, virtual_time=True)
    registry.device("virtual", device.VirtualDevice, settings.DeviceSettings, virtual_time=True)
    registry.lines("virtual", lines.VirtualLines, settings.LinesSettings, virtual_time=True)
    spots, spot_settings = spot_meter.VirtualSpotMeter, settings.SpotMeterSettings
    registry.device("virtual_spot_meter", spots, spot_settings, virtual_time=True)
