"""Setting a camera up: what stays the same from one series to the next."""

from __future__ import annotations

from typing import Any, Final

from labseq.plugin import DeviceError, LimitError
from labseq.plugin.camera import nearest
from labseq.plugin.messages import one_of
from labseq.plugin.units import ZERO_CELSIUS_K
from labseq_pylon.library import Nodes, Sdk
from labseq_pylon.settings import BITS, PixelFormat, PylonSettings

NANOSECONDS_PER_S = 1_000_000_000
"""Ticks per second of cameras that do not report their frequency."""


SERIES: Final = (
    ("FrameBurstStart", "AcquisitionBurstFrameCount"),
    ("AcquisitionStart", "AcquisitionFrameCount"),
)
"""Triggers that start a series, each with the node of its number of frames: USB and ace 2, GigE."""
WIDTH: Final = "TriggerWidth"
"""Exposure mode in which the width of the trigger is the exposure."""


def series_trigger(nodes: Nodes) -> tuple[str, str] | None:
    """The trigger of a camera that starts a series, and the node of its number of frames; None for none."""
    selector = nodes.find("TriggerSelector")
    offered = () if selector is None else selector.Symbolics
    return next((pair for pair in SERIES if pair[0] in offered), None)


def set_up(nodes: Nodes, settings: PylonSettings, sensor_shape: tuple[int, int]) -> dict[str, Any]:
    """Set everything that stays the same from series to series, whatever state the camera is in.

    Returns:
        The resulting settings: JSON-ready.
    """
    for auto in ("ExposureAuto", "GainAuto"):
        nodes.choose(auto, auto, "Off", if_there=True)
    nodes.choose("ExposureMode", "exposure mode", "Timed", if_there=True)
    for name in ("ReverseX", "ReverseY"):
        nodes.switch_off(name)
    _check_line_trigger(nodes, settings)
    pixel_format = _set_pixel_format(nodes, settings.pixel_format)
    frame_shape = _set_sensor(nodes, settings, sensor_shape)
    _set_gain(nodes, settings)
    _set_packets(nodes, settings)
    return {
        "pixel_format": pixel_format,
        "sensor_shape": sensor_shape,
        "frame_shape": settings.orientation.shape(frame_shape),
        "gain_now": nodes.read("Gain"),
        "gain_raw_now": nodes.read("GainRaw"),
        "packet_size_now": nodes.read("GevSCPSPacketSize"),
        "sensor_readout_s": _microseconds(nodes.read("SensorReadoutTime", "ReadoutTimeAbs")),
    }


def _check_line_trigger(nodes: Nodes, settings: PylonSettings) -> None:
    kind, missing = settings.line_trigger, ""
    if kind == "external_start" and series_trigger(nodes) is None:
        missing = f"starts no series by a trigger ({one_of([name for name, _ in SERIES])})"
    modes = nodes.find("ExposureMode")
    if kind == "bulb" and (modes is None or WIDTH not in modes.Symbolics):
        missing = f"has no exposure mode {WIDTH}"
    if missing:
        raise DeviceError(nodes.name, f"the camera {missing}; leave out `line_trigger: {kind}`")


def ticks_per_s(nodes: Nodes) -> int:
    """Frequency of the clock of a camera's time stamps."""
    return int(nodes.read("GevTimestampTickFrequency") or NANOSECONDS_PER_S)


def _set_pixel_format(nodes: Nodes, wanted: PixelFormat | None) -> PixelFormat:
    node = nodes.get("pixel format", "PixelFormat")
    if wanted is None:
        wanted = next((one for one in BITS if one in node.Symbolics), None)
        if wanted is None:
            text = "the camera has none of the pixel formats Mono8, Mono10, Mono12 and Mono16"
            raise DeviceError(nodes.name, f"{text}; expected a monochrome camera")
    nodes.choose("PixelFormat", "pixel format", wanted)
    return wanted


def _set_gain(nodes: Nodes, settings: PylonSettings) -> None:
    if settings.gain is not None:
        node = nodes.get("gain in dB", "Gain", hint="use `gain_raw`")
        nodes.set_real(node, "gain", settings.gain, lambda gain: f"{gain:g} dB")
    if settings.gain_raw is not None:
        node = nodes.get("gain in steps", "GainRaw", hint="use `gain`")
        nodes.set_integer(node, "gain_raw", settings.gain_raw)


def _set_packets(nodes: Nodes, settings: PylonSettings) -> None:
    only = "only GigE cameras have packets: leave out `{}`"
    if settings.packet_size is not None:
        node = nodes.get("packet size", "GevSCPSPacketSize", hint=only.format("packet_size"))
        nodes.set_integer(node, "packet size", settings.packet_size)
    if settings.packet_delay is not None:
        node = nodes.get("packet delay", "GevSCPD", hint=only.format("packet_delay"))
        n_ticks = round(settings.packet_delay * ticks_per_s(nodes))
        nodes.set_integer(node, "packet delay in ticks", n_ticks)


def _microseconds(value: float | None) -> float | None:
    return None if value is None else 1e-6 * value


def identify(sdk: Sdk, camera: Any, nodes: Nodes) -> dict[str, Any]:
    """Model, serial number and firmware of an open camera: JSON-ready."""
    info = camera.GetDeviceInfo()
    return {
        "model": info.GetModelName(),
        "serial_number": info.GetSerialNumber(),
        "firmware": nodes.read("DeviceFirmwareVersion", "DeviceVersion"),
        "connection": info.GetDeviceClass(),
        "pylon_version": ".".join(map(str, sdk.pylon.GetPylonVersion()[:3])),
    }


def temperature_k(nodes: Nodes) -> float | None:
    """Temperature of camera or sensor, whichever is selected, in kelvins; None if it has no sensor."""
    celsius = nodes.read("DeviceTemperature", "TemperatureAbs")
    return None if celsius is None else round(celsius + ZERO_CELSIUS_K, 2)


def sensor_shape(nodes: Nodes) -> tuple[int, int]:
    """(height, width) of the sensor in pixels, read without binning: some cameras report binned pixels."""
    for axis in ("Vertical", "Horizontal"):
        _set_binning(nodes, axis, 1)
    height = nodes.get("size", "SensorHeight", "HeightMax").GetValue()
    width = nodes.get("size", "SensorWidth", "WidthMax").GetValue()
    return int(height), int(width)


def _set_sensor(nodes: Nodes, settings: PylonSettings, sensor_shape: tuple[int, int]) -> tuple[int, int]:
    """Set region and binning; without a region the largest possible part of the sensor is read.

    Returns:
        (height, width) of the frames.
    """
    y, x, height, width = settings.region_on(sensor_shape, nodes.name)
    for offset in ("OffsetY", "OffsetX"):  # first, since the offset limits the size
        nodes.set_integer(nodes.get("region", offset), "start of the region", 0)
    binning, whole = settings.binning, settings.region is None
    _set_binning(nodes, "Vertical", binning)
    _set_binning(nodes, "Horizontal", binning)
    n_rows = _set_axis(nodes, "Y", y, height, binning, whole=whole)
    n_cols = _set_axis(nodes, "X", x, width, binning, whole=whole)
    return n_rows, n_cols


def _set_binning(nodes: Nodes, axis: str, binning: int) -> None:
    name = f"Binning{axis}"
    if binning > 1 or nodes.find(name) is not None:
        nodes.set_integer(nodes.get("binning", name, hint="leave out `binning`"), "binning", binning)
    if binning > 1:
        nodes.choose(f"Binning{axis}Mode", "way of binning", "Sum", if_there=True)


def _set_axis(nodes: Nodes, axis: str, start: int, size: int, binning: int, *, whole: bool) -> int:
    """Set offset and size of the region along an axis; returns its number of pixels in a frame."""
    name = {"Y": "Height", "X": "Width"}[axis]
    begins, extends = (f"region's {what}" for what in (axis.lower(), name.lower()))
    if start % binning:
        hint = f"the nearest good one is {nearest(start, 0, start + binning, binning)}"
        raise LimitError(f"{nodes.name}: {begins}", start, f"multiples of the binning, {binning}", hint)
    node = nodes.get("region", name)
    n_pixels = size // binning
    if whole:
        n_pixels = nearest(n_pixels, node.Min, node.Max, node.Inc)
    nodes.set_integer(node, extends, n_pixels, binning)
    nodes.set_integer(nodes.get("region", f"Offset{axis}"), begins, start // binning, binning)
    return n_pixels
