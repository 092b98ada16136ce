"""Drivers of devices on other computers, where `labseq serve-devices` serves them."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer a driver named ``remote`` for each role."""
    module, settings = "labseq_remote.drivers", "labseq_remote.settings"
    for kind, factory in (
        (registry.camera, "RemoteCamera"),
        (registry.static_tweezers, "RemoteStaticTweezers"),
        (registry.mobile_tweezers, "RemoteMobileTweezers"),
        (registry.device, "RemoteDevice"),
        (registry.lines, "RemoteLines"),
    ):
        kind("remote", f"{module}:{factory}", f"{settings}:RemoteSettings")
