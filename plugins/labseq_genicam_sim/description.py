"""The GenICam description of the simulated camera's registers, by which clients find its features.

The addresses come from Aravis' simulated camera and the GigE Vision bootstrap registers.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

from labseq_aravis.stream import MONO

from labseq_genicam_sim.messages import GAIN_STEP

EXPOSURE_US: Final = 10, 10_000_000
"""Shortest and longest exposure, in microseconds."""

VENDOR, MODEL = "labseq", "Simulated"

REGISTERS: Final = {
    "Width": 0x100,
    "Height": 0x104,
    "BinningHorizontal": 0x108,
    "BinningVertical": 0x10C,
    "Gain": 0x110,
    "SensorHeight": 0x118,
    "SensorWidth": 0x11C,
    "ExposureTime": 0x120,
    "Acquisition": 0x124,
    "PixelFormat": 0x128,
    "AcquisitionMode": 0x12C,
    "OffsetX": 0x130,
    "OffsetY": 0x134,
    "AcquisitionFramePeriod": 0x138,
    "ReverseX": 0x140,
    "ReverseY": 0x144,
    "TriggerSelector": 0x148,
    "ExposureMode": 0x14C,
    "AcquisitionFrameCount": 0x150,
    "TriggerMode": 0x300,
    "TriggerSource": 0x304,
    "TriggerActivation": 0x308,
    "TriggerSoftware": 0x30C,
    "Unconnected": 0x3FC,
}
"""Addresses of numbers, 4 bytes each, big-endian."""

TEXTS: Final = {
    "DeviceVendorName": (0x48, 32),
    "DeviceModelName": (0x68, 32),
    "DeviceFirmwareVersion": (0x88, 32),
    "DeviceManufacturerInfo": (0xA8, 48),
    "DeviceSerialNumber": (0xD8, 16),
    "DeviceUserID": (0xE8, 16),
}
"""Addresses and lengths of texts, in bytes."""

TRIGGERS: Final = {"Software": 1, "Line1": 2}
"""Trigger sources. Line1 is connected to nothing."""

OF_EACH_TRIGGER: Final = frozenset({"TriggerMode", "TriggerSource", "TriggerActivation"})
"""Features that each trigger has of its own. ``TriggerSelector`` chooses the visible one."""

CATEGORIES: Final = {
    "DeviceControl": tuple(TEXTS),
    "ImageFormatControl": (
        *("SensorWidth", "SensorHeight", "WidthMax", "HeightMax", "Width", "Height", "OffsetX", "OffsetY"),
        *("BinningHorizontal", "BinningVertical", "ReverseX", "ReverseY", "PixelFormat"),
    ),
    "AcquisitionControl": (
        *("AcquisitionMode", "AcquisitionStart", "AcquisitionStop", "AcquisitionFrameRate"),
        *("AcquisitionFrameCount", "ExposureMode", "ExposureTime"),
        *("TriggerSelector", "TriggerMode", "TriggerSource", "TriggerActivation", "TriggerSoftware"),
    ),
    "AnalogControl": ("Gain",),
    "TransportLayerControl": ("PayloadSize",),
}
"""Features, by category."""


def description(*, ignores_triggers: bool = False) -> str:
    """The description, as XML. With ``ignores_triggers`` the software trigger has no effect."""
    places = dict(REGISTERS)
    if ignores_triggers:
        places["TriggerSoftware"] = places["Unconnected"]
    nodes = [
        _category("Root", CATEGORIES),
        *(_category(name, features) for name, features in CATEGORIES.items()),
        *(_text(name, *place) for name, place in TEXTS.items()),
        *(_register(name, address) for name, address in places.items()),
        *_image_format(),
        *_acquisition(),
        '<Port Name="Device"/>',
    ]
    head = (
        f'<RegisterDescription ModelName="{MODEL}" VendorName="{VENDOR}" '
        'StandardNameSpace="GEV" '
        'SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" '
        'MajorVersion="1" MinorVersion="0" SubMinorVersion="0" ToolTip="Simulated camera" '
        'ProductGuid="0" VersionGuid="0" xmlns="http://www.genicam.org/GenApi/Version_1_1">'
    )
    return "\n".join(['<?xml version="1.0" encoding="utf-8"?>', head, *nodes, "</RegisterDescription>", ""])


def _image_format() -> Iterable[str]:
    for side, axis, sensor, direction in (
        ("Width", "X", "SensorWidth", "Horizontal"),
        ("Height", "Y", "SensorHeight", "Vertical"),
    ):
        binning = f"Binning{direction}"
        yield _integer(sensor, _value(sensor))
        yield _integer(binning, _value(binning), "<Min>1</Min><Max>8</Max>")
        yield _formula(f"{side}Max", "SENSOR / BINNING", {"SENSOR": sensor, "BINNING": binning})
        yield _formula(f"Offset{axis}Max", "MAX - SIZE", {"MAX": f"{side}Max", "SIZE": side})
        yield _integer(side, _value(side), f"<Min>1</Min><pMax>{side}Max</pMax>")
        yield _integer(f"Offset{axis}", _value(f"Offset{axis}"), f"<Min>0</Min><pMax>Offset{axis}Max</pMax>")
    for name in ("ReverseX", "ReverseY"):
        yield f'<Boolean Name="{name}">{_value(name)}<OnValue>1</OnValue><OffValue>0</OffValue></Boolean>'
    formats = {name: MONO[name] for name in ("Mono8", "Mono10", "Mono12", "Mono16")}
    yield _enumeration("PixelFormat", formats)
    size = "WIDTH * HEIGHT * ((FORMAT >> 16) & 0xFF) / 8"
    yield _formula(
        "PayloadSize", size, {"WIDTH": "Width", "HEIGHT": "Height", "FORMAT": "PixelFormatRegister"}
    )


def _acquisition() -> Iterable[str]:
    yield _enumeration("AcquisitionMode", {"Continuous": 1, "MultiFrame": 3})
    yield _integer("AcquisitionFrameCount", _value("AcquisitionFrameCount"), "<Min>1</Min><Max>65535</Max>")
    yield _enumeration("ExposureMode", {"Timed": 0, "TriggerWidth": 1})
    yield _command("AcquisitionStart", "Acquisition", 1)
    yield _command("AcquisitionStop", "Acquisition", 0)
    yield from _float("AcquisitionFrameRate", "AcquisitionFramePeriod", "1000000.0 / {0}", (1000, 10_000_000))
    yield _enumeration("TriggerSelector", {"FrameStart": 0, "AcquisitionStart": 1})
    yield _enumeration("TriggerMode", {"Off": 0, "On": 1})
    yield _enumeration("TriggerSource", TRIGGERS)
    yield _enumeration("TriggerActivation", {"RisingEdge": 0, "FallingEdge": 1})
    yield _command("TriggerSoftware", "TriggerSoftware", 1)
    yield from _float("ExposureTime", "ExposureTime", "{0} * {1}", EXPOSURE_US)
    yield from _float("Gain", "Gain", "{0} * {1}", (0, 1_000_000), 1 / GAIN_STEP)


def _category(name: str, features: Iterable[str]) -> str:
    inside = "".join(f"<pFeature>{feature}</pFeature>" for feature in features)
    return f'<Category Name="{name}">{inside}</Category>'


def _text(name: str, address: int, length: int) -> str:
    return (
        f'<StringReg Name="{name}"><Address>{address:#x}</Address><Length>{length}</Length>'
        "<AccessMode>RO</AccessMode><pPort>Device</pPort></StringReg>"
    )


def _register(name: str, address: int) -> str:
    index = '<pIndex Offset="32">TriggerSelectorRegister</pIndex>' if name in OF_EACH_TRIGGER else ""
    return (
        f'<IntReg Name="{name}Register"><Address>{address:#x}</Address>{index}<Length>4</Length>'
        "<AccessMode>RW</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>"
        "<Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>"
    )


def _value(name: str) -> str:
    return f"<pValue>{name}Register</pValue>"


def _integer(name: str, value: str, bounds: str = "") -> str:
    return f'<Integer Name="{name}">{value}{bounds}</Integer>'


def _formula(name: str, formula: str, variables: Mapping[str, str]) -> str:
    inside = "".join(f'<pVariable Name="{key}">{node}</pVariable>' for key, node in variables.items())
    escaped = formula.replace("&", "&amp;").replace(">", "&gt;")
    return f'<IntSwissKnife Name="{name}">{inside}<Formula>{escaped}</Formula></IntSwissKnife>'


def _enumeration(name: str, values: Mapping[str, int]) -> str:
    entries = "".join(
        f'<EnumEntry Name="{key}"><Value>{value}</Value></EnumEntry>' for key, value in values.items()
    )
    return f'<Enumeration Name="{name}">{entries}{_value(name)}</Enumeration>'


def _command(name: str, register: str, value: int) -> str:
    return f'<Command Name="{name}">{_value(register)}<CommandValue>{value}</CommandValue></Command>'


def _float(
    name: str, register: str, formula: str, bounds: tuple[int, int], scale: float = 1.0
) -> Iterable[str]:
    """A float that its register holds as an integer. The formula converts between them."""
    to, back = formula.format("FROM", scale), formula.format("TO", 1 / scale)
    least, greatest = bounds
    yield f'<Float Name="{name}"><pValue>{name}Converter</pValue></Float>'
    yield (
        f'<Converter Name="{name}Converter"><FormulaTo>{to}</FormulaTo><FormulaFrom>{back}</FormulaFrom>'
        f"<pValue>{name}Number</pValue></Converter>"
    )
    yield _integer(f"{name}Number", _value(register), f"<Min>{least}</Min><Max>{greatest}</Max>")
