"""The camera `mycam`."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the camera."""
    from .camera import MycamCamera, MycamSettings

    registry.camera("mycam", MycamCamera, MycamSettings)
