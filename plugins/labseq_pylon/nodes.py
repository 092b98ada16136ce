"""The camera's own settings, called nodes: found by one of their names, kept within their limits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, TypeAlias

from labseq.plugin import DeviceError, LimitError, nearest, one_of
from labseq_pylon.library import Sdk

Names: TypeAlias = tuple[str, ...]
"""What a node is called, in newer cameras first."""

EXPOSURE: Final[Names] = ("ExposureTime", "ExposureTimeAbs")
GAIN: Final[Names] = ("Gain",)
GAIN_RAW: Final[Names] = ("GainRaw",)
TEMPERATURE: Final[Names] = ("DeviceTemperature", "TemperatureAbs")
FIRMWARE: Final[Names] = ("DeviceFirmwareVersion", "DeviceVersion")
READOUT: Final[Names] = ("SensorReadoutTime", "ReadoutTimeAbs")
FRAME_RATE_ON: Final[Names] = ("AcquisitionFrameRateEnable",)
SENSOR_HEIGHT: Final[Names] = ("SensorHeight", "HeightMax")
SENSOR_WIDTH: Final[Names] = ("SensorWidth", "WidthMax")
TICKS_PER_S: Final[Names] = ("GevTimestampTickFrequency",)
PACKET_SIZE: Final[Names] = ("GevSCPSPacketSize",)
PACKET_DELAY: Final[Names] = ("GevSCPD",)


class Nodes:
    """The nodes of an open camera.

    Args:
        sdk: pylon.
        node_map: pylon's map of nodes.
    """

    def __init__(self, sdk: Sdk, node_map: Any) -> None:
        self._sdk = sdk
        self._map = node_map

    def find(self, names: Names) -> Any | None:
        """The first of these nodes that the camera has now; None if it has none."""
        for name in names:
            node = self._map.GetNode(name)
            if node is not None and self._sdk.genicam.IsAvailable(node):
                return node
        return None

    def get(self, names: Names, what: str, hint: str = "") -> Any:
        """The first of these nodes that the camera has now.

        Raises:
            DeviceError: It has none of them.
        """
        node = self.find(names)
        if node is None:
            text = f"the camera has no {what} (no node {one_of(names)})"
            raise DeviceError(self._sdk.name, f"{text}; {hint}" if hint else text)
        return node

    def read(self, names: Names) -> Any | None:
        """The value of a node; None where the camera has none or does not answer."""
        try:
            node = self.find(names)
            return None if node is None else node.GetValue()
        except self._sdk.genicam.GenericException:
            return None

    def choose(self, names: Names, what: str, value: str, *, if_there: bool = False) -> None:
        """Set a node that takes one of several names.

        Args:
            names: What the node is called.
            what: What it is called in errors.
            value: One of its names.
            if_there: Whether a camera without it, or that does not let it be changed, is as good.

        Raises:
            DeviceError: The camera has no such node, or not this name.
        """
        if if_there and not self._can_write(self.find(names)):
            return
        node = self.get(names, what)
        if value not in node.Symbolics:
            text = f"its {what} cannot be {value}; expected {one_of(node.Symbolics)}"
            raise DeviceError(self._sdk.name, text)
        with self._sdk.doing(f"set its {what} to {value}"):
            node.SetValue(value)

    def switch_off(self, names: Names) -> None:
        """Set a node to False, if the camera has it."""
        node = self.find(names)
        if node is not None and self._can_write(node):
            with self._sdk.doing(f"switch {names[0]} off"):
                node.SetValue(False)

    def set_real(
        self, node: Any, what: str, value: float, say: Callable[[float], str] = "{:g}".format
    ) -> float:
        """Set a node that takes real numbers.

        Args:
            node: The node.
            what: What it is called in errors.
            value: In the node's unit.
            say: Writes a value for people.

        Returns:
            The value that the camera took.

        Raises:
            LimitError: The camera does not go so far.
        """
        with self._sdk.doing(f"set its {what}"):
            low, high = node.Min, node.Max
            if not low <= value <= high:
                limit = f"{say(low)} to {say(high)}, which the camera can do"
                raise LimitError(f"{self._sdk.name}: {what}", say(value), limit)
            node.SetValue(value)
            return float(node.GetValue())

    def set_integer(self, node: Any, what: str, value: int, unit: int = 1) -> None:
        """Set a node that takes integers.

        Args:
            node: The node.
            what: What it is called in errors.
            value: In the node's unit.
            unit: Of the node, for errors: pixels of the sensor per pixel of a frame.

        Raises:
            LimitError: The camera does not go so far, or only in larger steps; names the nearest good one.
        """
        with self._sdk.doing(f"set its {what}"):
            low, high, step = node.Min, node.Max, node.Inc
            good = nearest(value, low, high, step)
            if good != value:
                limit = f"{low * unit} to {high * unit}, in steps of {step * unit}, which the camera can do"
                hint = f"the nearest good one is {good * unit}"
                raise LimitError(f"{self._sdk.name}: {what}", value * unit, limit, hint)
            node.SetValue(value)

    def _can_write(self, node: Any | None) -> bool:
        return node is not None and bool(self._sdk.genicam.IsWritable(node))
