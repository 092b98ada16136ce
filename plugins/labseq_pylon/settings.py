"""Settings of the driver."""

from __future__ import annotations

from labseq_genicam.settings import SIMULATED, StandardSettings
from pydantic import Field


class PylonSettings(StandardSettings):
    """A Basler camera."""

    camera: str | None = Field(
        default=None,
        min_length=1,
        description="serial number of the camera, or none for the only one connected. `simulated` is pylon's "
        "emulated camera, which sees the simulated atoms",
    )

    def identities(self) -> tuple[str, ...]:
        """Names of the camera, which only one process can use."""
        return () if self.camera == SIMULATED else (f"Basler camera {self.camera or '(the only one)'}",)
