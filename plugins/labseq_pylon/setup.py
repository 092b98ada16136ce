"""Setting a camera up: what stays the same from one series to the next."""

from __future__ import annotations

from typing import Any

from labseq.plugin import ZERO_CELSIUS_K, DeviceError
from labseq_pylon import nodes as n
from labseq_pylon.library import Sdk
from labseq_pylon.nodes import Nodes
from labseq_pylon.sensor import set_sensor
from labseq_pylon.settings import BITS, PixelFormat, PylonSettings

NANOSECONDS_PER_S = 1_000_000_000
"""Ticks of cameras that do not tell another frequency."""


def set_up(sdk: Sdk, nodes: Nodes, settings: PylonSettings, sensor_shape: tuple[int, int]) -> dict[str, Any]:
    """Bring a camera from any state into the driver's.

    Args:
        sdk: pylon.
        nodes: The nodes of the open camera.
        settings: The driver's settings.
        sensor_shape: (height, width) of the sensor.

    Returns:
        What it is set to: JSON-ready.

    Raises:
        LimitError: It does not go so far as the settings do.
        DeviceError: It does not have what they set.
    """
    for auto in ("ExposureAuto", "GainAuto"):
        nodes.choose((auto,), auto, "Off", if_there=True)
    nodes.choose(("ExposureMode",), "exposure mode", "Timed", if_there=True)
    nodes.switch_off(n.FRAME_RATE_ON)
    pixel_format = _set_pixel_format(sdk, nodes, settings.pixel_format)
    frame_shape = set_sensor(sdk, nodes, settings, sensor_shape)
    _set_gain(nodes, settings)
    _set_packets(nodes, settings)
    return {
        "pixel_format": pixel_format,
        "sensor_shape": sensor_shape,
        "frame_shape": frame_shape,
        "gain_now": nodes.read(n.GAIN),
        "gain_raw_now": nodes.read(n.GAIN_RAW),
        "packet_size_now": nodes.read(n.PACKET_SIZE),
        "sensor_readout_s": _microseconds(nodes.read(n.READOUT)),
    }


def ticks_per_s(nodes: Nodes) -> int:
    """Frequency of the clock that makes a camera's time stamps."""
    return int(nodes.read(n.TICKS_PER_S) or NANOSECONDS_PER_S)


def _set_pixel_format(sdk: Sdk, nodes: Nodes, wanted: PixelFormat | None) -> PixelFormat:
    node = nodes.get(("PixelFormat",), "pixel format")
    if wanted is None:
        wanted = next((one for one in BITS if one in node.Symbolics), None)
        if wanted is None:
            text = "the camera has none of the pixel formats Mono8, Mono10, Mono12 and Mono16"
            raise DeviceError(sdk.name, f"{text}; expected a monochrome camera")
    nodes.choose(("PixelFormat",), "pixel format", wanted)
    return wanted


def _set_gain(nodes: Nodes, settings: PylonSettings) -> None:
    if settings.gain is not None:
        node = nodes.get(n.GAIN, "gain in dB", "use `gain_raw`")
        nodes.set_real(node, "gain", settings.gain, lambda gain: f"{gain:g} dB")
    if settings.gain_raw is not None:
        node = nodes.get(n.GAIN_RAW, "gain in steps", "use `gain`")
        nodes.set_integer(node, "gain_raw", settings.gain_raw)


def _set_packets(nodes: Nodes, settings: PylonSettings) -> None:
    only = "only GigE cameras have packets: leave out `{}`"
    if settings.packet_size is not None:
        node = nodes.get(n.PACKET_SIZE, "packet size", only.format("packet_size"))
        nodes.set_integer(node, "packet size", settings.packet_size)
    if settings.packet_delay is not None:
        node = nodes.get(n.PACKET_DELAY, "packet delay", only.format("packet_delay"))
        n_ticks = round(settings.packet_delay * ticks_per_s(nodes))
        nodes.set_integer(node, "packet delay in ticks", n_ticks)


def _microseconds(value: float | None) -> float | None:
    return None if value is None else 1e-6 * value


def identify(sdk: Sdk, camera: Any, nodes: Nodes) -> dict[str, Any]:
    """What an open camera is: JSON-ready."""
    info = camera.GetDeviceInfo()
    return {
        "model": info.GetModelName(),
        "serial_number": info.GetSerialNumber(),
        "firmware": nodes.read(n.FIRMWARE),
        "connection": info.GetDeviceClass(),
        "pylon_version": ".".join(map(str, sdk.pylon.GetPylonVersion()[:3])),
    }


def temperature_k(nodes: Nodes) -> float | None:
    """Temperature of camera or sensor, whichever is selected, in kelvins; None if it does not tell."""
    celsius = nodes.read(n.TEMPERATURE)
    return None if celsius is None else round(celsius + ZERO_CELSIUS_K, 2)
