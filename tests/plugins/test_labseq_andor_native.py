"""The Andor driver with a C library that has the types of Andor's header for Linux, ``atmcdLXd.h``.

What the functions do is ours: they note what they are passed, and write what a test chooses. They are made
from a table of the header's types, not from the driver's.
"""

from __future__ import annotations

import ctypes
import math
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from labseq_andor.camera import AndorCamera
from labseq_andor.sdk import SIGNATURES, load_sdk
from labseq_andor.settings import AndorSettings

from labseq.plugin import Context
from labseq.testing.fakes import FakeClock

pytestmark = pytest.mark.needs("c-compiler")

FIELDS: Final = (
    *("ulSize", "ulAcqModes", "ulReadModes", "ulTriggerModes", "ulCameraType", "ulPixelMode"),
    *("ulSetFunctions", "ulGetFunctions", "ulFeatures", "ulPCICard", "ulEMGainCapability"),
    *("ulFTReadModes", "ulFeatures2"),
)
TYPES: Final = f"""
#include <stdio.h>
#include <string.h>
#ifdef _LP64
#define at_32 int
#define at_u32 unsigned int
#else
#define at_32 long
#define at_u32 unsigned long
#endif
#define uint unsigned int
#define WORD unsigned short
typedef enum {{ AT_SDKVersion = 0x40000000, AT_DeviceDriverVersion }} AT_VersionInfoId;
typedef struct {{ at_u32 {", ".join(FIELDS)}; }} AndorCapabilities;
typedef struct {{ WORD year, month, weekday, day, hour, minute, second, millisecond; }} SYSTEMTIME;
double passed[16];
int n_passed;
"""
HEADER: Final = """
AbortAcquisition
CancelWait
CoolerOFF
CoolerON
GetAcquisitionTimings float* float* float*
GetAmpDesc int char* int
GetAvailableCameras at_32*
GetBitDepth int int*
GetCameraHandle at_32 at_32*
GetCameraSerialNumber int*
GetCapabilities AndorCapabilities*
GetCurrentCamera at_32*
GetDetector int* int*
GetEMGainRange int* int*
GetFastestRecommendedVSSpeed int* float*
GetHSSpeed int int int float*
GetHardwareVersion uint* uint* uint* uint* uint* uint*
GetHeadModel char*
GetImages16 at_32 at_32 WORD* at_u32 at_32* at_32*
GetMaximumExposure float*
GetMetaDataInfo SYSTEMTIME* float* uint
GetNumberADChannels int*
GetNumberAmp int*
GetNumberHSSpeeds int int int*
GetNumberNewImages at_32* at_32*
GetNumberPreAmpGains int*
GetNumberVSSpeeds int*
GetPreAmpGain int float*
GetReadOutTime float*
GetShutterMinTimes int* int*
GetStatus int*
GetTemperatureF float*
GetTemperatureRange int* int*
GetVSSpeed int float*
GetVersionInfo AT_VersionInfoId char* at_u32
Initialize const_char*
IsPreAmpGainAvailable int int int int int*
PrepareAcquisition
SendSoftwareTrigger
SetADChannel int
SetAcquisitionMode int
SetBaselineClamp int
SetCoolerMode int
SetCurrentCamera at_32
SetEMAdvanced int
SetEMCCDGain int
SetEMGainMode int
SetExposureTime float
SetFanMode int
SetFastExtTrigger int
SetFrameTransferMode int
SetHSSpeed int int
SetImage int int int int int int
SetIsolatedCropMode int int int int int
SetIsolatedCropModeEx int int int int int int int
SetKineticCycleTime float
SetMetaData int
SetNumberAccumulations int
SetNumberKinetics int
SetOutputAmplifier int
SetPreAmpGain int
SetReadMode int
SetShutter int int int int
SetTemperature int
SetTriggerInvert int
SetTriggerMode int
SetVSSpeed int
ShutDown
StartAcquisition
WaitForAcquisitionByHandleTimeOut long int
"""
PROTOTYPES: Final = {name: types for name, *types in map(str.split, HEADER.split("\n")[1:-1])}
INPUTS: Final[dict[str, Any]] = {
    "int": -(2**31),
    "at_32": -(2**31) + 1,
    "at_u32": 2**32 - 1,
    "uint": 2**32 - 1,
    "AT_VersionInfoId": 0x40000001,
    "long": -(2 ** (8 * ctypes.sizeof(ctypes.c_long) - 2)),
    "float": 0.375,
}
"""What a type holds and a smaller one does not."""
MEMORY: Final = ("WORD*", "SYSTEMTIME*", "const_char*")
"""Types of pointers that the driver passes itself; the test of the types passes none."""
OUTPUTS: Final[dict[str, Any]] = {"int": -(2**31), "at_32": -(2**31), "uint": 2**32 - 1, "float": -1.25}
TEXT: Final = "a text of 19 letters"
CAMERA: Final[dict[str, list[Any]]] = {
    "GetAcquisitionTimings": [0.01, 0.03, 0.03],
    "GetAmpDesc": ["Electron Multiplying"],
    "GetAvailableCameras": [1],
    "GetBitDepth": [16],
    "GetCameraHandle": [100],
    "GetCameraSerialNumber": [4711],
    # kinetic series and frame transfer, four triggers but not bulb, everything that can be set but crops,
    # shutter, fan and time stamps, and EM gain as a factor
    "GetCapabilities": [52, 0x18, 1, 0x1B, 1, 4, 0x8237, 0x2F, 0x8088, 0, 0x8, 0, 2**31],
    "GetCurrentCamera": [100],
    "GetDetector": [128, 64],
    "GetEMGainRange": [2, 300],
    "GetFastestRecommendedVSSpeed": [0, 0.5],
    "GetHSSpeed": [10.0],
    "GetHardwareVersion": [0, 0, 0, 0, 2, 4000000000],
    "GetHeadModel": ["DU-897"],
    "GetImages16": [1, 1],
    "GetMaximumExposure": [100.0],
    "GetNumberADChannels": [1],
    "GetNumberAmp": [1],
    "GetNumberHSSpeeds": [1],
    "GetNumberNewImages": [1, 1],
    "GetNumberPreAmpGains": [1],
    "GetNumberVSSpeeds": [1],
    "GetPreAmpGain": [2.0],
    "GetReadOutTime": [0.0125],
    "GetShutterMinTimes": [20, 27],
    "GetStatus": [20073],
    "GetTemperatureF": [-70.5],
    "GetTemperatureRange": [-120, 20],
    "GetVSSpeed": [0.5],
    "GetVersionInfo": ["2.104.30064.0"],
    "IsPreAmpGainAvailable": [1],
}


def is_output(name: str, types: list[str], index: int) -> bool:
    """Whether the driver gets the value of an argument back, rather than passing it."""
    is_length = index > 0 and types[index - 1] == "char*"
    is_passed = types[index] in MEMORY or name == "GetMetaDataInfo"
    return is_length or (types[index].endswith("*") and not is_passed)


def written(name: str, types: list[str]) -> list[Any]:
    """What a function writes in the test of the types."""
    pointers = [kind[:-1] for index, kind in enumerate(types) if is_output(name, types, index)]
    values = {**OUTPUTS, "char": TEXT, "AndorCapabilities": [52, *range(2**31, 2**31 + 12)]}
    if name == "GetCapabilities":
        return list(values["AndorCapabilities"])
    return [values[kind] for kind in pointers if kind in values]


def function(name: str, types: list[str], values: list[Any]) -> str:
    """Source of a function: it notes the numbers that it is passed, and writes ``values``."""
    left, lines = list(values), list[str]()
    for index, kind in enumerate(types):
        if not kind.endswith("*"):
            lines += [f"passed[n_passed++] = p{index};"]
        elif kind == "AndorCapabilities*":
            lines += [f"if (p{index}->ulSize != sizeof *p{index}) return 20066;"]
            lines += [f"p{index}->{field} = {value}u;" for field, value in zip(FIELDS, left, strict=True)]
        elif kind == "char*":
            size = f"p{index + 1}" if index + 1 < len(types) else "256"
            lines += [f'snprintf(p{index}, {size}, "%s", "{left.pop(0)}");']
        elif kind == "WORD*":
            lines += [f"for (at_u32 k = 0; p{index} && k < p{index + 1}; k++) p{index}[k] = 7 * k;"]
        elif kind == "SYSTEMTIME*":
            lines += [f"if (p{index}) memset(p{index}, 0, sizeof *p{index});"]
        elif kind == "const_char*":
            lines += [f'if (p{index} && strcmp(p{index}, "/usr/local/etc/andor") != 0) return 20066;']
        elif name == "GetMetaDataInfo":
            lines += [f"if (p{index}) *p{index} = 1500;"]
        else:
            value = left.pop(0)
            lines += [f"*p{index} = {value}{'u' if kind == 'uint*' else ''};"]
    arguments = ", ".join(f"{kind.replace('_char', ' char')} p{index}" for index, kind in enumerate(types))
    code = 20036 if name == "GetTemperatureF" else 20002
    return f"uint {name}({arguments or 'void'}) {{ n_passed = 0; {' '.join(lines)} return {code}; }}\n"


def compiled(folder: Path, values: dict[str, list[Any]]) -> Path:
    source, library = folder / "andor.c", folder / "libandor.so"
    functions = [function(name, types, values.get(name, [])) for name, types in PROTOTYPES.items()]
    source.write_text(TYPES + "".join(functions), encoding="utf-8")
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, source], check=True)
    return library


def test_every_function_is_called_with_the_types_of_andors_header(tmp_path: Path) -> None:
    assert PROTOTYPES.keys() == SIGNATURES.keys()
    library = compiled(tmp_path, {name: written(name, types) for name, types in PROTOTYPES.items()})
    loaded, sdk = ctypes.CDLL(str(library)), load_sdk("camera", str(library))
    noted, n_noted = (ctypes.c_double * 16).in_dll(loaded, "passed"), ctypes.c_int.in_dll(loaded, "n_passed")
    for name, types in PROTOTYPES.items():
        inputs = [kind for index, kind in enumerate(types) if not is_output(name, types, index)]
        result = getattr(sdk, name)(*(INPUTS.get(kind) for kind in inputs))
        numbers = [INPUTS[kind] for kind in inputs if not kind.endswith("*")]
        assert noted[: len(numbers)] == numbers, name
        assert n_noted.value == sum(not kind.endswith("*") for kind in types), name
        expected = written(name, types)
        if name == "GetCapabilities":
            assert [getattr(result, field) for field in FIELDS] == expected
        elif expected:
            results = result if isinstance(result, tuple) else (result,)
            assert list(results[-len(expected) :]) == expected, name


@pytest.mark.skipif(sys.platform == "win32", reason="Initialize is passed the folder of Linux")
def test_a_camera_behind_a_c_library_is_opened_and_gives_a_frame(tmp_path: Path) -> None:
    library = compiled(tmp_path, CAMERA)
    chosen = {"cooling": {"temperature": "-70 degC"}, "em_gain": 200, "model": "DU-897"}
    settings = AndorSettings.model_validate({"sdk": str(library), **chosen})
    camera = AndorCamera(settings, Context("camera", clock=FakeClock()))
    camera.open()
    about = camera.describe()
    assert (about["serial_number"], about["firmware"]) == ("4711", "2.4000000000")
    assert (about["sdk_version"], about["amplifier"]) == ("2.104.30064.0", "Electron Multiplying")
    assert (about["setpoint_k"], about["temperature_k"]) == (pytest.approx(203.15), pytest.approx(202.65))
    assert (about["em_gain_range"], about["shutter_now"]) == ([2, 300], "open")
    assert camera.facts.triggers == ("software", "internal", "external", "external_start")
    assert camera.facts.readout_s == pytest.approx(0.0125)
    camera.arm(1, 0.01, "software")
    camera.trigger()
    frame = camera.read(1.0)
    np.testing.assert_array_equal(frame.image, 7 * np.arange(64 * 128, dtype=np.uint16).reshape(64, 128))
    assert frame.device_time_s == pytest.approx(1.5)
    assert not math.isnan(frame.exposure_s)
    camera.close()
