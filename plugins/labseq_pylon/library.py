"""The vendor's package ``pypylon``, imported only when a camera is opened, and the features of a camera."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

from labseq_genicam.features import Number, Value

from labseq.plugin import DeviceError
from labseq.plugin.messages import install_hint, missing_package

OTHERWISE: Final = "To try things without it, use another camera, for example `use: virtual`"


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

    Its types make Python warn when they are created. As of 26.9 the process dies if warnings are errors.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            pylon, genicam = (importlib.import_module(f"pypylon.{part}") for part in ("pylon", "genicam"))
    except ImportError as error:
        text = f"the Python package 'pypylon' cannot be imported ({error})"
        raise DeviceError(name, f"{text}; install it with {install_hint('pylon')}. {OTHERWISE}") from error
    return Sdk(name, pylon, genicam)


def _reason(error: Exception) -> str:
    """The message of pylon, without the place in its source code."""
    lines = str(error).splitlines() or [type(error).__name__]
    return lines[0].partition(" : ")[0].rstrip(". ")


class PylonNodes:
    """Reads and sets the features of an open camera, which pylon calls nodes."""

    def __init__(self, sdk: Sdk, node_map: Any) -> None:
        self._sdk = sdk
        self._map = node_map

    def is_available(self, feature: str) -> bool:
        """Whether the camera has a feature and offers it now."""
        node = self._map.GetNode(feature)
        return node is not None and bool(self._sdk.genicam.IsAvailable(node))

    def options(self, feature: str) -> tuple[str, ...]:
        """Values of an enumeration that can be chosen, none if the camera does not have it."""
        return tuple(self._map.GetNode(feature).Symbolics) if self.is_available(feature) else ()

    def get(self, feature: str, kind: type[Value]) -> Value:
        """Value of a feature."""
        return kind(self._map.GetNode(feature).GetValue())

    def set(self, feature: str, value: str | float) -> None:
        """Set a feature."""
        self._map.GetNode(feature).SetValue(value)

    def bounds(self, feature: str, kind: type[Number]) -> tuple[Number, Number]:
        """Smallest and largest value of a number."""
        node = self._map.GetNode(feature)
        return kind(node.Min), kind(node.Max)

    def increment(self, feature: str) -> int:
        """Distance between two values of an integer."""
        return int(self._map.GetNode(feature).Inc)
