"""GenICam cameras: GigE Vision and USB3 Vision, through Aravis."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Register the camera ``genicam``; in a dry run a simulated GigE camera sees the simulated atoms."""
    from labseq_genicam.camera import GenicamCamera
    from labseq_genicam.settings import SIMULATED, GenicamSettings

    simulated = {"camera": SIMULATED, "model": None, "serial": None}
    registry.camera("genicam", GenicamCamera, GenicamSettings, simulated=simulated)
