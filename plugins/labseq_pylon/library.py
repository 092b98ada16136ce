"""The vendor's package ``pypylon``, imported only when a camera is opened, and the settings of a camera."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

from labseq.plugin import DeviceError, LimitError
from labseq.plugin.camera import check_step
from labseq.plugin.messages import install_hint, missing_package, one_of

OTHERWISE: Final = "to try things without it, use another camera, for example `use: virtual`"


@dataclass(frozen=True, slots=True)
class Sdk:
    """The modules of pylon, and the name of a camera for errors.

    Attributes:
        name: Name of the camera in the profile, for errors.
        pylon: The module ``pypylon.pylon``.
        genicam: The module ``pypylon.genicam``.
    """

    name: str
    pylon: Any
    genicam: Any

    @contextmanager
    def doing(self, what: str, hint: str = "") -> Generator[None]:
        """Turn errors of pylon into errors of labseq."""
        try:
            yield
        except self.genicam.GenericException as error:
            text = f"cannot {what}: {_reason(error)}"
            raise DeviceError(self.name, f"{text}; {hint}" if hint else text) from error


def simulated_settings() -> dict[str, str | None] | str:
    """Settings of pylon's emulated camera, or why there is none here."""
    return missing_package("pypylon", "pylon") or {"camera": "simulated", "model": None}


def load_pypylon(name: str) -> Sdk:
    """Import ``pypylon``.

    Its types make Python warn when they are created; as of 26.9 the process dies if warnings are errors.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            pylon, genicam = (importlib.import_module(f"pypylon.{part}") for part in ("pylon", "genicam"))
    except ImportError as error:
        text = f"the Python package 'pypylon' cannot be imported ({error})"
        raise DeviceError(name, f"{text}; install it with {install_hint('pylon')}; {OTHERWISE}") from error
    return Sdk(name, pylon, genicam)


def _reason(error: Exception) -> str:
    """The message of pylon, without the place in its source code."""
    lines = str(error).splitlines() or [type(error).__name__]
    return lines[0].partition(" : ")[0].rstrip(". ")


class Nodes:
    """The settings of an open camera, which GenICam calls nodes.

    Their names differ between generations of cameras: where several are given, the newest comes first.

    Attributes:
        name: Name of the camera in the profile, for errors.
    """

    def __init__(self, sdk: Sdk, node_map: Any) -> None:
        self.name = sdk.name
        self._sdk = sdk
        self._map = node_map

    def find(self, *names: str) -> Any | None:
        """The first of these nodes that the camera has now; None if it has none."""
        for name in names:
            node = self._map.GetNode(name)
            if node is not None and self._sdk.genicam.IsAvailable(node):
                return node
        return None

    def get(self, what: str, *names: str, hint: str = "") -> Any:
        """The first of these nodes that the camera has now."""
        node = self.find(*names)
        if node is None:
            text = f"the camera has no {what} (no node {one_of(names)})"
            raise DeviceError(self.name, f"{text}; {hint}" if hint else text)
        return node

    def read(self, *names: str) -> Any | None:
        """The value of a node; None if the camera has none or does not answer."""
        try:
            node = self.find(*names)
            return None if node is None else node.GetValue()
        except self._sdk.genicam.GenericException:
            return None

    def choose(self, name: str, what: str, value: str, *, if_there: bool = False) -> None:
        """Set a node, which errors call ``what``, to one of several values.

        With ``if_there`` nothing happens if the camera does not have it, or does not allow changes.
        """
        if if_there and not self._can_write(self.find(name)):
            return
        node = self.get(what, name)
        if value not in node.Symbolics:
            text = f"its {what} cannot be {value}; expected {one_of(node.Symbolics)}"
            raise DeviceError(self.name, text)
        with self._sdk.doing(f"set its {what} to {value}"):
            node.SetValue(value)

    def switch_off(self, name: str) -> None:
        """Set a node to False, if the camera has it."""
        node = self.find(name)
        if node is not None and self._can_write(node):
            with self._sdk.doing(f"switch {name} off"):
                node.SetValue(False)

    def set_real(
        self, node: Any, what: str, value: float, say: Callable[[float], str] = "{:g}".format
    ) -> float:
        """Set a node that holds a real number; returns the value that the camera accepted.

        ``what`` is its name in errors, and ``say`` formats its values there.
        """
        with self._sdk.doing(f"set its {what}"):
            low, high = node.Min, node.Max
            if not low <= value <= high:
                limit = f"{say(low)} to {say(high)}, which the camera can do"
                raise LimitError(f"{self.name}: {what}", say(value), limit)
            node.SetValue(value)
            return float(node.GetValue())

    def set_integer(self, node: Any, what: str, value: int, unit: int = 1) -> None:
        """Set a node that holds an integer.

        ``what`` is its name in errors, and ``unit`` what counts as 1 there: pixels of the sensor per pixel
        of a frame.
        """
        with self._sdk.doing(f"set its {what}"):
            bounds = (node.Min, node.Max, node.Inc)
            check_step(f"{self.name}: {what}", value * unit, bounds, unit)
            node.SetValue(value)

    def _can_write(self, node: Any | None) -> bool:
        return node is not None and bool(self._sdk.genicam.IsWritable(node))
