"""Andor EMCCD cameras, for example iXon, through Andor's SDK2 and pylablib."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Register the camera ``andor``; in a dry run the simulated camera, if pylablib is installed."""
    camera, settings = "labseq_andor.camera:AndorCamera", "labseq_andor.settings:AndorSettings"
    registry.camera("andor", camera, settings, simulated="labseq_andor.library:simulated_settings")
