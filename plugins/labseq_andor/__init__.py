"""Andor EMCCD cameras, for example iXon, through Andor's SDK2."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Register the camera ``andor``, simulated in a dry run."""
    camera, settings = "labseq_andor.camera:AndorCamera", "labseq_andor.settings:AndorSettings"
    registry.camera("andor", camera, settings, simulated="labseq_andor.connection:simulated_settings")
