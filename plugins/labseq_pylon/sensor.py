"""Which part of the sensor is read, and how coarsely."""

from __future__ import annotations

from labseq.plugin import LimitError, nearest
from labseq_pylon.library import Sdk
from labseq_pylon.nodes import SENSOR_HEIGHT, SENSOR_WIDTH, Nodes
from labseq_pylon.settings import PylonSettings


def sensor_shape(nodes: Nodes) -> tuple[int, int]:
    """(height, width) of the sensor in pixels; some cameras tell only what binning leaves of it.

    Raises:
        DeviceError: The camera does not tell.
    """
    for axis in ("Vertical", "Horizontal"):
        _set_binning(nodes, axis, 1)
    height, width = (nodes.get(names, "size").GetValue() for names in (SENSOR_HEIGHT, SENSOR_WIDTH))
    return int(height), int(width)


def set_sensor(
    sdk: Sdk, nodes: Nodes, settings: PylonSettings, sensor_shape: tuple[int, int]
) -> tuple[int, int]:
    """Set region and binning.

    Args:
        sdk: pylon.
        nodes: The nodes of the open camera.
        settings: The driver's settings; without a region as much of the sensor is read as the camera can.
        sensor_shape: (height, width) of the sensor.

    Returns:
        (height, width) of the frames.

    Raises:
        LimitError: The region goes beyond the sensor, or is not one that the camera can read.
        DeviceError: The camera does not bin.
    """
    y, x, height, width = settings.mode.region or (0, 0, *sensor_shape)
    if y + height > sensor_shape[0] or x + width > sensor_shape[1]:
        end, size = f"row {y + height}, column {x + width}", "{} x {} pixels".format(*sensor_shape)
        hint = "choose a smaller or another one"
        raise LimitError(f"{sdk.name}: end of the region", end, f"the sensor's {size}", hint)
    for offset in ("OffsetY", "OffsetX"):  # first, since where a region begins limits its size
        nodes.set_integer(nodes.get((offset,), "region"), "start of the region", 0)
    binning, whole = settings.binning, settings.region is None
    _set_binning(nodes, "Vertical", binning)
    _set_binning(nodes, "Horizontal", binning)
    n_rows = _set_axis(sdk, nodes, "Y", y, height, binning, whole=whole)
    n_cols = _set_axis(sdk, nodes, "X", x, width, binning, whole=whole)
    return n_rows, n_cols


def _set_binning(nodes: Nodes, axis: str, binning: int) -> None:
    name = (f"Binning{axis}",)
    if binning > 1 or nodes.find(name) is not None:
        nodes.set_integer(nodes.get(name, "binning", "leave out `binning`"), "binning", binning)
    if binning > 1:
        nodes.choose((f"Binning{axis}Mode",), "way of binning", "Sum", if_there=True)


def _set_axis(sdk: Sdk, nodes: Nodes, axis: str, start: int, size: int, binning: int, *, whole: bool) -> int:
    """Set where a region begins and ends along an axis; returns its number of pixels in a frame."""
    name = {"Y": "Height", "X": "Width"}[axis]
    begins, extends = (f"region's {what}" for what in (axis.lower(), name.lower()))
    if start % binning:
        hint = f"the nearest good one is {nearest(start, 0, start + binning, binning)}"
        raise LimitError(f"{sdk.name}: {begins}", start, f"multiples of the binning, {binning}", hint)
    node = nodes.get((name,), "region")
    n_pixels = size // binning
    if whole:
        n_pixels = nearest(n_pixels, node.Min, node.Max, node.Inc)
    nodes.set_integer(node, extends, n_pixels, binning)
    nodes.set_integer(nodes.get((f"Offset{axis}",), "region"), begins, start // binning, binning)
    return n_pixels
