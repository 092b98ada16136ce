"""Basler cameras, through pylon."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Register the camera ``pylon``; in a dry run pylon's emulated camera sees the simulated atoms."""
    from labseq_pylon.camera import PylonCamera
    from labseq_pylon.settings import SIMULATED, PylonSettings

    simulated = {"camera": SIMULATED, "model": None}
    registry.camera("pylon", PylonCamera, PylonSettings, simulated=simulated)
