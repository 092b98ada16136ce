"""GenICam cameras (GigE Vision and USB3 Vision), through Aravis."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Register the camera ``genicam``, in a dry run a simulated GigE camera that sees the simulated atoms."""
    camera, settings = "labseq_genicam.camera:GenicamCamera", "labseq_genicam.settings:GenicamSettings"
    registry.camera("genicam", camera, settings, simulated="labseq_genicam.aravis:simulated_settings")
