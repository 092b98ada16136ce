"""Basler cameras."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import metadata

from labseq_genicam.driver import StandardCamera

from labseq.plugin import Context
from labseq_pylon.connection import connection_for
from labseq_pylon.settings import PylonSettings


class PylonCamera(StandardCamera):
    """A Basler camera.

    Raises:
        ConfigError: The simulated camera is chosen, but there is no simulation, or its sensor has no such
            region.
    """

    model_name = "Basler camera"

    def __init__(self, settings: PylonSettings, context: Context) -> None:
        super().__init__(settings, context, connection_for(settings, context))

    def versions(self) -> Mapping[str, tuple[str, str]]:
        """Versions of the package, pylon and the camera. No real camera was tried."""
        return {
            "package pypylon": (metadata.version("pypylon"), "26.9"),
            "pylon": (self.reported.get("pylon_version", ""), "12.4.2"),
            "firmware": (self.reported.get("firmware", ""), ""),
        }
