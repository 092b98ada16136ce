"""Andor EMCCD cameras, for example iXon, through Andor's SDK2 and pylablib."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the camera ``andor``; in a dry run it is a camera that exists only in software."""
    from labseq_andor.camera import AndorCamera
    from labseq_andor.settings import SIMULATED, AndorSettings

    registry.camera("andor", AndorCamera, AndorSettings, simulated={"camera": SIMULATED, "serial": 0})
