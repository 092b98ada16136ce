"""Basler cameras, by pylon."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the camera ``pylon``; in a dry run pylon's emulated camera shows the simulated atoms."""
    from labseq_pylon.camera import PylonCamera
    from labseq_pylon.settings import SIMULATED, PylonSettings

    simulated = {"camera": SIMULATED, "model": None}
    registry.camera("pylon", PylonCamera, PylonSettings, simulated=simulated)
