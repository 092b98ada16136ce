"""What the simulated camera says of itself."""

from __future__ import annotations

from typing import Any, Final

from labseq_andor.codes import EM_GAIN_REAL, AcqModes, Code, Features, GetFunctions, SetFunctions, Triggers
from labseq_andor.counterpart.calls import answers
from labseq_andor.counterpart.texts import put_text
from labseq_andor.heads import Head

READ_MODES: Final = 1 | 2 | 4 | 8 | 16 | 32
"""The whole sensor, a part of it, and tracks, which pylablib takes for granted."""

FIRMWARE: Final = (2, 1)
IXON_ULTRA: Final = 21
PIXELS_OF_16_BIT: Final = 4


class Identity:
    """Model, serial number and capabilities.

    Args:
        head: What the camera is.
        serial: Its serial number.
    """

    def __init__(self, head: Head, serial: int) -> None:
        self._head = head
        self.serial = serial

    @answers("GetControllerCardModel")
    def get_controller(self, text: int) -> int:
        """It is connected by USB."""
        return put_text(text, "USB")

    @answers("GetHeadModel")
    def get_head(self, text: int) -> int:
        """The camera's model."""
        return put_text(text, self._head.model)

    @answers("GetCameraSerialNumber")
    def get_serial(self, number: Any) -> int:
        """Its serial number."""
        number[0] = self.serial
        return Code.SUCCESS

    @answers("GetHardwareVersion")
    def get_versions(self, *numbers: Any) -> int:
        """Of the electronics; the last two are the firmware's."""
        for number, value in zip(numbers, (0, 0, 0, 0, *FIRMWARE), strict=True):
            number[0] = value
        return Code.SUCCESS

    @answers("GetPixelSize")
    def get_pixel_size(self, x_um: Any, y_um: Any) -> int:
        """Side of a pixel, in micrometres."""
        x_um[0] = y_um[0] = self._head.pixel_m * 1e6
        return Code.SUCCESS

    @answers("GetCapabilities")
    def get_capabilities(self, capabilities: Any) -> int:
        """What it can do."""
        caps = capabilities[0]
        caps.ulAcqModes = sum(AcqModes)
        caps.ulReadModes = caps.ulFTReadModes = READ_MODES
        caps.ulTriggerModes = Triggers.INTERNAL | Triggers.EXTERNAL | Triggers.CONTINUOUS | Triggers.INVERTED
        caps.ulCameraType = IXON_ULTRA
        caps.ulPixelMode = PIXELS_OF_16_BIT
        caps.ulSetFunctions = sum(SetFunctions)
        caps.ulGetFunctions = sum(GetFunctions)
        caps.ulFeatures = sum(Features)
        caps.ulEMGainCapability = EM_GAIN_REAL
        return Code.SUCCESS
