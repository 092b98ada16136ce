"""Devices of other computers, which `labseq serve-devices` serves there."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer a driver named ``remote`` for each role, and for the simulation that served simulators act on."""
    module, settings = "labseq_remote.drivers", "labseq_remote.settings"
    simulation = "labseq_remote.simulation:RemoteSimulation"
    for kind, factory in (
        (registry.camera, "RemoteCamera"),
        (registry.static_tweezers, "RemoteStaticTweezers"),
        (registry.mobile_tweezers, "RemoteMobileTweezers"),
        (registry.device, "RemoteDevice"),
        (registry.lines, "RemoteLines"),
    ):
        kind("remote", f"{module}:{factory}", f"{settings}:RemoteSettings")
    registry.simulation("remote", simulation, f"{settings}:RemoteSimulationSettings")
