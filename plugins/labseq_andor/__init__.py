"""Andor EMCCD cameras, for example iXon, through Andor's SDK2 and pylablib."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Register the camera ``andor``; in a dry run the simulated camera is used."""
    simulated = {"camera": "simulated", "serial": 0}
    camera, settings = "labseq_andor.camera:AndorCamera", "labseq_andor.settings:AndorSettings"
    registry.camera("andor", camera, settings, simulated=simulated)
