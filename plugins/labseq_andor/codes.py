"""Numbers of Andor's SDK2, by their names in its header ``atmcd32d.h``."""

from __future__ import annotations

from enum import IntEnum, IntFlag


class Code(IntEnum):
    """What a function of the SDK returns."""

    ERROR_CODES = 20001
    SUCCESS = 20002
    VXDNOTINSTALLED = 20003
    ERROR_ACK = 20013
    ACQ_BUFFER = 20018
    ACQ_DOWNFIFO_FULL = 20019
    KINETIC_TIME_NOT_MET = 20022
    ACCUM_TIME_NOT_MET = 20023
    NO_NEW_DATA = 20024
    SPOOLERROR = 20026
    TEMP_OFF = 20034
    TEMP_NOT_STABILIZED = 20035
    TEMP_STABILIZED = 20036
    TEMP_NOT_REACHED = 20037
    TEMP_DRIFT = 20040
    GENERAL_ERRORS = 20049
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
    P7INVALID = 20083
    USBERROR = 20089
    BINNING_ERROR = 20099
    ERROR_NOCAMERA = 20990
    NOT_SUPPORTED = 20991
    NOT_AVAILABLE = 20992


class AcqModes(IntFlag):
    """Acquisition modes that a camera has (``ulAcqModes``)."""

    SINGLE = 1
    VIDEO = 2
    ACCUMULATE = 4
    KINETIC = 8
    FRAMETRANSFER = 16


class Triggers(IntFlag):
    """Triggers that a camera has (``ulTriggerModes``); CONTINUOUS is the software trigger."""

    INTERNAL = 1
    EXTERNAL = 2
    CONTINUOUS = 8
    EXTERNALSTART = 16
    EXTERNALEXPOSURE = 32
    INVERTED = 64


class SetFunctions(IntFlag):
    """What can be set (``ulSetFunctions``)."""

    VREADOUT = 0x01
    HREADOUT = 0x02
    TEMPERATURE = 0x04
    EMCCDGAIN = 0x10
    BASELINECLAMP = 0x20
    PREAMPGAIN = 0x200
    CROPMODE = 0x400
    EMADVANCED = 0x8000
    EXTENDED_CROP_MODE = 0x10000000


class GetFunctions(IntFlag):
    """What can be asked for (``ulGetFunctions``)."""

    TEMPERATURE = 0x01
    TEMPERATURERANGE = 0x04
    DETECTORSIZE = 0x08
    EMCCDGAIN = 0x20
    BASELINECLAMP = 0x8000


class Features(IntFlag):
    """What else a camera can do (``ulFeatures``)."""

    POLLING = 1
    SHUTTER = 8
    FANCONTROL = 128
    METADATA = 0x8000


EM_GAIN_REAL = 8
"""Flag of ``ulEMGainCapability``: the gain can be set as the factor that it is."""

REAL_GAIN_MODE = 3
"""Mode of ``SetEMGainMode`` for that."""

SOFTWARE_TRIGGER = 10
"""Mode of ``SetTriggerMode``."""

EXTERNAL_TRIGGER = 1
"""Mode of ``SetTriggerMode``: an edge at the trigger input starts each exposure."""
