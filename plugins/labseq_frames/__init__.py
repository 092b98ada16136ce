"""A camera that plays back frames from files."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Register the camera ``frames``; it runs on the session's clock."""
    from labseq_frames.camera import FramesCamera, FramesSettings

    registry.camera("frames", FramesCamera, FramesSettings, virtual_time=True)
