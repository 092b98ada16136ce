"""Cameras through pylablib (Hamamatsu DCAM, Andor SDK3, PICam, Photometrics PVCAM, PCO)."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Register the camera ``pylablib``, in a dry run a simulated DCAM camera."""
    camera = "labseq_pylablib.camera:PylablibCamera"
    settings = "labseq_pylablib.settings:PylablibSettings"
    registry.camera("pylablib", camera, settings, simulated="labseq_pylablib.library:simulated_settings")
