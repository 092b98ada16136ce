"""The features that a camera describes itself with, by their GenICam names."""

from __future__ import annotations

import ctypes
from typing import Any

from labseq_genicam.aravis.errors import AravisError
from labseq_genicam.aravis.library import Library, text


class Features:
    """Access to the features of an open camera.

    Every method raises :class:`AravisError` if there is no such feature, the value is refused
    or the camera does not answer.

    Args:
        library: The library.
        handle: The camera; this object owns it.
    """

    def __init__(self, library: Library, handle: int) -> None:
        self._library = library
        self._handle: int | None = handle

    def is_available(self, feature: str) -> bool:
        """Whether the camera has a feature and offers it now."""
        return bool(self._call("arv_camera_is_feature_available", feature.encode()))

    def get_string(self, feature: str) -> str:
        """Value of a text or of an enumeration."""
        return text(self._call("arv_camera_get_string", feature.encode()))

    def set_string(self, feature: str, value: str) -> None:
        """Set a text or an enumeration."""
        self._call("arv_camera_set_string", feature.encode(), value.encode())

    def get_integer(self, feature: str) -> int:
        """Value of an integer, or number of an enumeration's value."""
        return int(self._call("arv_camera_get_integer", feature.encode()))

    def set_integer(self, feature: str, value: int) -> None:
        """Set an integer."""
        self._call("arv_camera_set_integer", feature.encode(), value)

    def integer_bounds(self, feature: str) -> tuple[int, int, int]:
        """Least value, greatest value and increment of an integer."""
        least, greatest = self._pair(ctypes.c_int64, "arv_camera_get_integer_bounds", feature.encode())
        return least, greatest, int(self._call("arv_camera_get_integer_increment", feature.encode()))

    def get_float(self, feature: str) -> float:
        """Value of a float."""
        return float(self._call("arv_camera_get_float", feature.encode()))

    def set_float(self, feature: str, value: float) -> None:
        """Set a float."""
        self._call("arv_camera_set_float", feature.encode(), value)

    def float_bounds(self, feature: str) -> tuple[float, float]:
        """Least and greatest value of a float."""
        return self._pair(ctypes.c_double, "arv_camera_get_float_bounds", feature.encode())

    def get_boolean(self, feature: str) -> bool:
        """Value of a switch."""
        return bool(self._call("arv_camera_get_boolean", feature.encode()))

    def set_boolean(self, feature: str, value: bool) -> None:
        """Set a switch."""
        self._call("arv_camera_set_boolean", feature.encode(), int(value))

    def enumeration(self, feature: str) -> tuple[str, ...]:
        """Values of an enumeration that the camera offers now."""
        name = "arv_camera_dup_available_enumerations_as_strings"
        return self._library.texts(name, self._open_handle(), feature.encode())

    def execute(self, feature: str) -> None:
        """Execute a command; returns when the camera has confirmed it."""
        self._call("arv_camera_execute_command", feature.encode())

    def _call(self, name: str, *arguments: Any) -> Any:
        return self._library.call(name, self._open_handle(), *arguments)

    def _pair(self, type_: Any, name: str, *arguments: Any) -> tuple[Any, Any]:
        """Call a function that writes two numbers."""
        first, second = type_(), type_()
        self._call(name, *arguments, ctypes.byref(first), ctypes.byref(second))
        return first.value, second.value

    def _open_handle(self) -> int:
        if self._handle is None:
            raise AravisError("the camera is closed; open it first", "closed")
        return self._handle
