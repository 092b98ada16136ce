"""Setting a camera up: what stays the same from one series to the next."""

from __future__ import annotations

from typing import Any

from labseq_aravis import Camera

from labseq.plugin import DeviceError, LimitError
from labseq.plugin.camera import check_step, nearest
from labseq.plugin.messages import one_of
from labseq.plugin.units import ZERO_CELSIUS_K
from labseq_genicam.acquisition import SERIES, WIDTH, series_trigger
from labseq_genicam.connection import Link
from labseq_genicam.settings import FORMATS, GenicamSettings, PixelFormat


def identify(link: Link, settings: GenicamSettings) -> dict[str, Any]:
    """Model, serial number and firmware of an open camera: JSON-ready."""
    with link.doing("identify the camera") as camera:
        found = {
            "vendor": camera.vendor,
            "model": camera.model,
            "serial_number": camera.serial,
            "firmware": _firmware(camera),
            "connection": "GigE Vision" if camera.is_ethernet else "USB3 Vision",
        }
    for key, wanted in (("model", settings.model), ("serial_number", settings.serial)):
        if wanted is not None and found[key] != wanted:
            what = key.replace("_", " ")
            text = f"the camera {found['serial_number']} ({found['model']}) has the {what} {found[key]}"
            raise DeviceError(link.name, f"{text}; expected {wanted}: name another one as `camera`")
    return found


def set_up(link: Link, settings: GenicamSettings, packet_size: int | None) -> dict[str, Any]:
    """Bring a camera from any state into the driver's; without a packet size, as the camera is set.

    Returns:
        The resulting settings: JSON-ready.
    """
    with link.doing("set the camera up") as camera:
        camera.stop()
        for feature, value in (
            ("ExposureAuto", "Off"),
            ("GainAuto", "Off"),
            ("ExposureMode", "Timed"),
        ):
            if camera.is_available(feature):
                camera.set_string(feature, value)
        for feature in ("ReverseX", "ReverseY"):
            if camera.is_available(feature):
                camera.set_boolean(feature, False)
        _check_line_trigger(link.name, camera, settings)
        pixel_format = _set_pixel_format(link.name, camera, settings.pixel_format)
        sensor_shape = _set_binning(link.name, camera, settings.binning)
        frame_shape = _set_region(link.name, camera, settings, sensor_shape)
        _set_gain(link.name, camera, settings.gain)
        _set_packets(link.name, camera, packet_size, settings.packet_delay)
        return {
            "pixel_format": pixel_format,
            "sensor_shape": sensor_shape,
            "frame_shape": settings.orientation.shape(frame_shape),
            "gain_now": camera.gain if camera.has_gain else None,
            "exposure_bounds_s": camera.exposure_bounds_s,
        }


def _check_line_trigger(name: str, camera: Camera, settings: GenicamSettings) -> None:
    kind, missing = settings.line_trigger, ""
    if kind == "external_start" and not series_trigger(camera):
        missing = f"starts no series by a trigger ({one_of(SERIES)})"
    elif kind == "bulb" and WIDTH not in camera.options("ExposureMode"):
        missing = f"has no exposure mode {WIDTH}"
    if missing:
        raise DeviceError(name, f"the camera {missing}; leave out `line_trigger: {kind}`")


def _firmware(camera: Camera) -> str:
    """Version of the firmware; empty if the camera does not report it."""
    for feature in ("DeviceFirmwareVersion", "DeviceVersion"):
        if camera.is_available(feature):
            return camera.get_string(feature)
    return ""


def temperature_k(camera: Camera) -> float | None:
    """Temperature of camera or sensor, whichever is selected, in kelvins; None if it has no sensor."""
    if not camera.is_available("DeviceTemperature"):
        return None
    return round(camera.get_float("DeviceTemperature") + ZERO_CELSIUS_K, 2)


def _set_pixel_format(name: str, camera: Camera, wanted: PixelFormat | None) -> str:
    offered = camera.pixel_formats
    chosen = wanted or next((one for one in FORMATS if one in offered), None)
    if chosen is None or chosen not in offered:
        text = f"its pixel format cannot be {wanted or one_of(FORMATS)}"
        raise DeviceError(name, f"{text}; the camera offers {', '.join(offered) or 'none'}")
    camera.set_pixel_format(chosen)
    return chosen


def _set_binning(name: str, camera: Camera, binning: int) -> tuple[int, int]:
    """Set the binning; returns (height, width) of the sensor, which some cameras report after binning."""
    can_bin = camera.is_available("BinningHorizontal") and camera.is_available("BinningVertical")
    if not can_bin and binning > 1:
        raise LimitError(f"{name}: binning", binning, "1, as the camera does not bin", "leave out `binning`")
    if not can_bin:
        return camera.sensor_shape
    camera.set_binning(1, 1)
    sensor_shape = camera.sensor_shape
    for axis in ("Horizontal", "Vertical") if binning > 1 else ():
        check_step(f"{name}: binning", binning, camera.integer_bounds(f"Binning{axis}"))
        if camera.is_available(f"Binning{axis}Mode"):
            camera.set_string(f"Binning{axis}Mode", "Sum")
    camera.set_binning(binning, binning)
    return sensor_shape


def _set_region(
    name: str, camera: Camera, settings: GenicamSettings, sensor_shape: tuple[int, int]
) -> tuple[int, int]:
    """Set the region; returns (height, width) of the frames."""
    y, x, height, width = settings.region_on(sensor_shape, name)
    can_move = camera.is_available("OffsetX") and camera.is_available("OffsetY")
    for axis, size in (("Y", "Height"), ("X", "Width")):  # each limits the range of the other
        camera.set_integer(size, camera.integer_bounds(size)[0])
        if can_move:
            camera.set_integer(f"Offset{axis}", 0)
    shape: list[int] = []
    for axis, size, start, extent in (("Y", "Height", y, height), ("X", "Width", x, width)):
        binning, (low, high, step) = settings.binning, camera.integer_bounds(size)
        n_pixels = extent // binning
        if settings.region is None:
            n_pixels = nearest(n_pixels, low, high, step)
        check_step(f"{name}: region's {size.lower()}", n_pixels * binning, (low, high, step), binning)
        camera.set_integer(size, n_pixels)
        bounds = camera.integer_bounds(f"Offset{axis}") if can_move else (0, 0, 1)
        check_step(f"{name}: region's {axis.lower()}", start, bounds, binning)
        if can_move:
            camera.set_integer(f"Offset{axis}", start // binning)
        shape.append(n_pixels)
    return shape[0], shape[1]


def _set_gain(name: str, camera: Camera, gain: float | None) -> None:
    if gain is None:
        return
    if not camera.has_gain:
        raise LimitError(f"{name}: gain", f"{gain:g}", "none, as the camera has none", "leave out `gain`")
    low, high = camera.gain_bounds
    if not low <= gain <= high:
        limit = f"{low:g} to {high:g}, which the camera can do"
        raise LimitError(f"{name}: gain", f"{gain:g}", limit)
    camera.set_gain(gain)


def _set_packets(name: str, camera: Camera, packet_size: int | None, packet_delay_s: float | None) -> None:
    for key, value in (("packet_size", packet_size), ("packet_delay", packet_delay_s)):
        if value is not None and not camera.is_ethernet:
            raise DeviceError(name, f"only GigE cameras have packets: leave out `{key}`")
    if packet_size is not None:
        camera.set_packet_size(packet_size)
    if packet_delay_s is not None:
        camera.set_packet_delay_s(packet_delay_s)
