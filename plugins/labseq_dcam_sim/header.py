"""Types, codes and property numbers of Hamamatsu's headers ``dcamapi4.h`` (June 2021) and ``dcamprop.h``.

They are written from the headers and not from pylablib, so that a wrong declaration there would show.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from enum import IntEnum
from typing import Any, Final

INT, DOUBLE, HANDLE = ctypes.c_int32, ctypes.c_double, ctypes.c_void_p


def _structure(name: str, **fields: Any) -> Any:
    return type(name, (ctypes.Structure,), {"_fields_": list(fields.items())})


DCAMAPI_INIT: Final = _structure(
    "DCAMAPI_INIT",
    size=INT,
    iDeviceCount=INT,
    reserved=INT,
    initoptionbytes=INT,
    initoption=ctypes.c_void_p,
    guid=ctypes.c_void_p,
)
DCAMDEV_OPEN: Final = _structure("DCAMDEV_OPEN", size=INT, index=INT, hdcam=HANDLE)
DCAMDEV_STRING: Final = _structure(
    "DCAMDEV_STRING", size=INT, iString=INT, text=ctypes.c_void_p, textbytes=INT
)
DCAMPROP_ATTR: Final = _structure(
    "DCAMPROP_ATTR",
    cbSize=INT,
    iProp=INT,
    option=INT,
    iReserved1=INT,
    attribute=INT,
    iGroup=INT,
    iUnit=INT,
    attribute2=INT,
    valuemin=DOUBLE,
    valuemax=DOUBLE,
    valuestep=DOUBLE,
    valuedefault=DOUBLE,
    nMaxChannel=INT,
    iReserved3=INT,
    nMaxView=INT,
    iProp_NumberOfElement=INT,
    iProp_ArrayBase=INT,
    iPropStep_Element=INT,
)
DCAMPROP_VALUETEXT: Final = _structure(
    "DCAMPROP_VALUETEXT", cbSize=INT, iProp=INT, value=DOUBLE, text=ctypes.c_void_p, textbytes=INT
)
DCAMCAP_TRANSFERINFO: Final = _structure(
    "DCAMCAP_TRANSFERINFO", size=INT, iKind=INT, nNewestFrameIndex=INT, nFrameCount=INT
)
DCAMBUF_FRAME: Final = _structure(
    "DCAMBUF_FRAME",
    size=INT,
    iKind=INT,
    option=INT,
    iFrame=INT,
    buf=ctypes.c_void_p,
    rowbytes=INT,
    type=INT,
    width=INT,
    height=INT,
    left=INT,
    top=INT,
    timestamp_sec=ctypes.c_uint32,
    timestamp_microsec=INT,
    framestamp=INT,
    camerastamp=INT,
)
DCAMWAIT_OPEN: Final = _structure("DCAMWAIT_OPEN", size=INT, supportevent=INT, hwait=HANDLE, hdcam=HANDLE)
DCAMWAIT_START: Final = _structure("DCAMWAIT_START", size=INT, eventhappened=INT, eventmask=INT, timeout=INT)

SIGNATURES: Final[Mapping[str, tuple[Any, ...]]] = {
    "dcamapi_init": (DCAMAPI_INIT,),
    "dcamapi_uninit": (),
    "dcamdev_open": (DCAMDEV_OPEN,),
    "dcamdev_close": (HANDLE,),
    "dcamdev_getstring": (HANDLE, DCAMDEV_STRING),
    "dcamprop_getattr": (HANDLE, DCAMPROP_ATTR),
    "dcamprop_getvalue": (HANDLE, INT, ctypes.POINTER(DOUBLE)),
    "dcamprop_setvalue": (HANDLE, INT, DOUBLE),
    "dcamprop_setgetvalue": (HANDLE, INT, ctypes.POINTER(DOUBLE), INT),
    "dcamprop_getnextid": (HANDLE, ctypes.POINTER(INT), INT),
    "dcamprop_getname": (HANDLE, INT, ctypes.c_void_p, INT),
    "dcamprop_getvaluetext": (HANDLE, DCAMPROP_VALUETEXT),
    "dcambuf_alloc": (HANDLE, INT),
    "dcambuf_release": (HANDLE, INT),
    "dcambuf_lockframe": (HANDLE, DCAMBUF_FRAME),
    "dcamcap_start": (HANDLE, INT),
    "dcamcap_stop": (HANDLE,),
    "dcamcap_status": (HANDLE, ctypes.POINTER(INT)),
    "dcamcap_transferinfo": (HANDLE, DCAMCAP_TRANSFERINFO),
    "dcamcap_firetrigger": (HANDLE, INT),
    "dcamwait_open": (DCAMWAIT_OPEN,),
    "dcamwait_close": (HANDLE,),
    "dcamwait_start": (HANDLE, DCAMWAIT_START),
    "dcamwait_abort": (HANDLE,),
}
"""Function -> types of its arguments. A structure means a pointer to it."""


class Code(IntEnum):
    """Return code (DCAMERR), as the signed number that the functions return."""

    SUCCESS = 1
    BUSY = 0x80000101 - 2**32
    ABORT = 0x80000102 - 2**32
    NOTREADY = 0x80000103 - 2**32
    NOTSTABLE = 0x80000104 - 2**32
    TIMEOUT = 0x80000106 - 2**32
    NOTBUSY = 0x80000107 - 2**32
    EXCLUDED = 0x80000110 - 2**32
    NOMEMORY = 0x80000203 - 2**32
    NOCAMERA = 0x80000206 - 2**32
    LOSTFRAME = 0x80000301 - 2**32
    TOOFREQUENTTRIGGER = 0x80000305 - 2**32
    UNKNOWNSTRID = 0x80000802 - 2**32
    INVALIDCAMERA = 0x80000806 - 2**32
    INVALIDHANDLE = 0x80000807 - 2**32
    INVALIDPARAM = 0x80000808 - 2**32
    INVALIDVALUE = 0x80000821 - 2**32
    OUTOFRANGE = 0x80000822 - 2**32
    NOTWRITABLE = 0x80000823 - 2**32
    INVALIDPROPERTYID = 0x80000825 - 2**32
    NOPROPERTY = 0x80000828 - 2**32
    INVALIDSUBARRAY = 0x8000082B - 2**32
    ACCESSDENY = 0x8000082C - 2**32
    NOVALUETEXT = 0x8000082D - 2**32
    INVALIDFRAMEINDEX = 0x80000833 - 2**32
    NOTSUPPORT = 0x80000F03 - 2**32
    NOCONNECTION = 0x80000F07 - 2**32
    INVALIDWAITHANDLE = 0x84002001 - 2**32


class Status(IntEnum):
    """DCAMCAP_STATUS."""

    BUSY = 1
    READY = 2
    STABLE = 3


class Text(IntEnum):
    """DCAM_IDSTR."""

    BUS = 0x04000101
    CAMERAID = 0x04000102
    VENDOR = 0x04000103
    MODEL = 0x04000104
    CAMERAVERSION = 0x04000105
    DRIVERVERSION = 0x04000106


class Property(IntEnum):
    """DCAMIDPROP."""

    TRIGGER_SOURCE = 0x00100110
    TRIGGER_ACTIVE = 0x00100120
    TRIGGER_MODE = 0x00100210
    TRIGGER_POLARITY = 0x00100220
    EXPOSURE_TIME = 0x001F0110
    SENSOR_TEMPERATURE = 0x00200310
    SENSOR_COOLER = 0x00200320
    SENSOR_TEMPERATURE_TARGET = 0x00200330
    READOUT_SPEED = 0x00400110
    BINNING = 0x00401110
    SUBARRAY_HPOS = 0x00402110
    SUBARRAY_HSIZE = 0x00402120
    SUBARRAY_VPOS = 0x00402130
    SUBARRAY_VSIZE = 0x00402140
    SUBARRAY_MODE = 0x00402150
    TIMING_READOUT_TIME = 0x00403010
    TIMING_MIN_TRIGGER_INTERVAL = 0x00403050
    INTERNAL_FRAME_INTERVAL = 0x00403820
    BIT_PER_CHANNEL = 0x00420130
    IMAGE_WIDTH = 0x00420210
    IMAGE_HEIGHT = 0x00420220
    CONVERSION_FACTOR_COEFF = 0x00FFE010
    CONVERSION_FACTOR_OFFSET = 0x00FFE020

    @property
    def text(self) -> str:
        """Name of the property as ``dcamprop_getname`` gives it."""
        return self.name.replace("_", " ")


HAS_RANGE, HAS_STEP, HAS_DEFAULT, HAS_TEXT = 0x80000000, 0x40000000, 0x20000000, 0x10000000
AUTO_ROUNDING, WRITABLE, READABLE = 0x00800000, 0x00020000, 0x00010000
ACCESS_READY, ACCESS_BUSY = 0x00002000, 0x00001000
MODE, LONG, REAL = 1, 2, 3
"""DCAMPROPATTRIBUTE."""
FRAME_READY: Final = 0x0002
"""DCAMWAIT_CAPEVENT_FRAMEREADY."""
SEQUENCE, SNAP = -1, 0
"""DCAMCAP_START."""
MONO16: Final = 2
"""DCAM_PIXELTYPE_MONO16."""
