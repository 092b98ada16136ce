"""A camera that plays back frames from files."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Register the camera ``frames``, which runs on the session's clock."""
    camera, settings = "labseq_frames.camera:FramesCamera", "labseq_frames.camera:FramesSettings"
    registry.camera("frames", camera, settings, virtual_time=True)
