"""Basler cameras, through pylon."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Register the camera ``pylon``, in a dry run pylon's emulated camera that sees the simulated atoms."""
    camera, settings = "labseq_pylon.camera:PylonCamera", "labseq_pylon.settings:PylonSettings"
    registry.camera("pylon", camera, settings, simulated="labseq_pylon.library:simulated_settings")
