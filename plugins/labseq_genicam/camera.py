"""GigE Vision and USB3 Vision cameras."""

from __future__ import annotations

from collections.abc import Mapping

from labseq_aravis import library_version

from labseq.plugin import Context
from labseq_genicam.aravis import connection_for
from labseq_genicam.driver import StandardCamera
from labseq_genicam.settings import GenicamSettings


class GenicamCamera(StandardCamera):
    """A GigE Vision or USB3 Vision camera.

    Raises:
        ConfigError: The simulated camera is chosen, but there is no simulation, or its sensor has no such
            region.
    """

    model_name = "GenICam camera"

    def __init__(self, settings: GenicamSettings, context: Context) -> None:
        super().__init__(settings, context, connection_for(settings, context))

    def versions(self) -> Mapping[str, tuple[str, str]]:
        """Versions of libaravis and the camera. No real camera was tried."""
        return {
            "libaravis": (library_version(), "0.8.26"),
            "firmware": (self.reported.get("firmware", ""), ""),
        }
