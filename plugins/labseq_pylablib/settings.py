"""Settings of the driver."""

from __future__ import annotations

from typing import Final, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from labseq.plugin import Duration
from labseq.plugin.camera import CameraSettings, Cooling

SIMULATED: Final = "simulated"
"""Value of `camera` for the simulated camera."""

InterfaceName: TypeAlias = Literal["dcam", "sdk3", "picam", "photometrics", "pco"]


class PylablibSettings(CameraSettings):
    """A camera that pylablib drives through its vendor's library."""

    interface: InterfaceName = Field(
        description="library of the camera's vendor: `dcam` (Hamamatsu), `sdk3` (Andor sCMOS), `picam` "
        "(Princeton Instruments), `photometrics` (PVCAM), `pco`"
    )
    camera: Literal["connected", "simulated"] = Field(
        default="connected",
        description="the camera connected to this computer, or a simulated one with the interface `dcam`",
    )
    serial: str = Field(
        default="", description="serial number of the camera, or empty for the only one connected"
    )
    model: str = Field(
        default="", description="beginning of the camera's model name. Other models are refused"
    )
    sdk: str = Field(
        default="", description="file of the vendor's library, or empty for where its installer puts it"
    )
    readout_mode: str | None = Field(
        default=None,
        description="speed of the read-out by the name that the camera gives it, such as `slow` (ultra-quiet "
        "scan of an ORCA-Quest), or none to keep the present speed",
    )
    trigger_edge: Literal["rising", "falling"] = Field(
        default="rising", description="edge of the external trigger that starts an exposure"
    )
    readout: Duration = Field(
        default=10e-3,
        description="time from the end of an exposure until its frame can be read, for budgets before the "
        "camera is opened. The open camera reports its own",
    )
    arming_time: Duration = Field(
        default=10e-3,
        description="time from arming for a series until it can be triggered, for budgets. Simulated "
        "cameras take this long",
    )
    cooling: Cooling | None = Field(
        default=None, description="temperature of the sensor, or none to leave the cooler as it is"
    )

    def identities(self) -> tuple[str, ...]:
        """Names of the camera, which only one process can use."""
        if self.camera == SIMULATED:
            return ()
        return (f"{self.interface} camera {self.serial or '(the only one)'}",)

    @model_validator(mode="after")
    def _only_dcam_is_simulated(self) -> Self:
        if self.camera == SIMULATED and self.interface != "dcam":
            text = f"the interface {self.interface} has no simulated camera"
            raise ValueError(f"{text}; leave `camera` out, or use `interface: dcam`")
        return self

    @model_validator(mode="after")
    def _pco_cools_by_itself(self) -> Self:
        if self.cooling is not None and self.interface == "pco":
            raise ValueError("pylablib cannot set the cooling of PCO cameras; leave `cooling` out")
        return self
