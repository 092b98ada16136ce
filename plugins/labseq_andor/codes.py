"""Numbers of Andor's SDK2, with their names in its header ``atmcd32d.h``, and meanings of return codes."""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import Final


class Code(IntEnum):
    """Return code of an SDK function."""

    ERROR_CODES = 20001
    SUCCESS = 20002
    VXDNOTINSTALLED = 20003
    ERROR_ACK = 20013
    ACQ_BUFFER = 20018
    ACQ_DOWNFIFO_FULL = 20019
    NO_NEW_DATA = 20024
    SPOOLERROR = 20026
    TEMP_OFF = 20034
    TEMP_NOT_STABILIZED = 20035
    TEMP_STABILIZED = 20036
    TEMP_NOT_REACHED = 20037
    TEMP_DRIFT = 20040
    P1INVALID = 20066
    P2INVALID = 20067
    P3INVALID = 20068
    P4INVALID = 20069
    ACQUIRING = 20072
    IDLE = 20073
    NOT_INITIALIZED = 20075
    P5INVALID = 20076
    P6INVALID = 20077
    INVALID_MODE = 20078
    USBERROR = 20089
    ERROR_NOCAMERA = 20990
    NOT_SUPPORTED = 20991
    NOT_AVAILABLE = 20992


class AcqModes(IntFlag):
    """Acquisition modes that a camera has (``ulAcqModes``)."""

    FRAMETRANSFER = 16


class TriggerModes(IntFlag):
    """Triggers that a camera has (``ulTriggerModes``). CONTINUOUS is the software trigger."""

    INTERNAL = 1
    EXTERNAL = 2
    CONTINUOUS = 8
    EXTERNALSTART = 16
    EXTERNALEXPOSURE = 32


class SetFunctions(IntFlag):
    """Settings that a camera has (``ulSetFunctions``)."""

    VREADOUT = 0x01
    HREADOUT = 0x02
    TEMPERATURE = 0x04
    BASELINECLAMP = 0x20
    PREAMPGAIN = 0x200
    CROPMODE = 0x400
    EMADVANCED = 0x8000
    EXTENDED_CROP_MODE = 0x10000000


class Features(IntFlag):
    """Other features of a camera (``ulFeatures``)."""

    SHUTTER = 8
    FANCONTROL = 128
    FTEXTERNALEXPOSURE = 0x1000
    KINETICEXTERNALEXPOSURE = 0x2000
    METADATA = 0x8000


EM_GAIN_REAL: Final = 8
"""Flag of ``ulEMGainCapability`` for a gain that can be set as a factor."""
REAL_GAIN_MODE: Final = 3
"""Mode of ``SetEMGainMode`` in which the gain is a factor."""
FULL_IMAGE: Final = 4
"""Mode of ``SetReadMode`` that reads images."""
SHUTTER_AUTO, SHUTTER_OPEN, SHUTTER_CLOSED = 0, 1, 2
"""Modes of ``SetShutter``."""
INTERNAL, EXTERNAL, EXTERNAL_START, EXTERNAL_EXPOSURE, SOFTWARE = 0, 1, 6, 7, 10
"""Modes of ``SetTriggerMode``."""
KINETIC, RUN_TILL_ABORT = 3, 5
"""Modes of ``SetAcquisitionMode``."""
SDK_VERSION: Final = 0x40000000
"""Argument of ``GetVersionInfo`` for the SDK's version."""

GONE: Final = frozenset({Code.ERROR_ACK, Code.USBERROR, Code.ERROR_NOCAMERA, Code.NOT_INITIALIZED})
"""Codes of a camera that no longer answers."""
OVERRUN: Final = frozenset({Code.ACQ_BUFFER, Code.ACQ_DOWNFIFO_FULL, Code.SPOOLERROR})
"""Codes of an acquisition that ended because the computer did not take the data in time."""

TEMPERATURE_STATUS: Final = frozenset(code for code in Code if code.name.startswith("TEMP_"))
"""Codes by which ``GetTemperatureF`` tells the status of the cooling."""

_UNPLUGGED: Final = "the camera no longer answers; check its power and cable, then start again"
_IN_USE: Final = (
    "the camera is there but cannot be used; close Solis and every other program that uses it, and if none "
    "does, switch the camera off and on"
)
_MEANINGS: Final[dict[int, str]] = {
    Code.ERROR_ACK: _UNPLUGGED,
    Code.USBERROR: _UNPLUGGED,
    Code.NOT_INITIALIZED: _UNPLUGGED,
    Code.ERROR_NOCAMERA: _IN_USE,
    Code.VXDNOTINSTALLED: _IN_USE,
    Code.NOT_AVAILABLE: _IN_USE,
    Code.ACQUIRING: "the camera cannot do this while it acquires",
    Code.NOT_SUPPORTED: "this camera cannot do that",
    Code.INVALID_MODE: "this camera cannot do that with the other settings",
}


def explain(function: str, code: int) -> str:
    """Explain a return code to a user, with the function and the code at the end."""
    name = f", DRV_{Code(code).name}" if code in frozenset(Code) else ""
    meaning = _MEANINGS.get(code, "Andor's SDK refuses")
    return f"{meaning} ({function} gave {code}{name})"
