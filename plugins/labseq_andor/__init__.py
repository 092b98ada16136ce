"""Andor EMCCD cameras, for example iXon, through Andor's SDK2 and pylablib."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Register the camera ``andor``; in a dry run the simulated camera is used."""
    from labseq_andor.camera import AndorCamera
    from labseq_andor.settings import SIMULATED, AndorSettings

    registry.camera("andor", AndorCamera, AndorSettings, simulated={"camera": SIMULATED, "serial": 0})
