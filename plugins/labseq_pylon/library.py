"""The vendor's package ``pypylon``, imported only when a camera is opened."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from labseq.plugin import DeviceError

OTHERWISE = "to try things without it, use another camera, for example `use: virtual`"


@dataclass(frozen=True, slots=True)
class Sdk:
    """pylon, on behalf of one camera.

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
        """Tell in labseq's terms what went wrong.

        Raises:
            DeviceError: pylon raised something.
        """
        try:
            yield
        except self.genicam.GenericException as error:
            text = f"cannot {what}: {_reason(error)}"
            raise DeviceError(self.name, f"{text}; {hint}" if hint else text) from error


def load_pypylon(name: str) -> Sdk:
    """Import ``pypylon``.

    Its types make Python warn when they are made; as of 26.9 the process dies if warnings are errors.

    Args:
        name: Name of the camera, for the message.

    Raises:
        DeviceError: The package is missing.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            pylon, genicam = (importlib.import_module(f"pypylon.{part}") for part in ("pylon", "genicam"))
    except ImportError as error:
        text = f"the Python package 'pypylon' cannot be imported ({error})"
        raise DeviceError(
            name, f'{text}; install it with `pip install "labseq[pylon]"`; {OTHERWISE}'
        ) from error
    return Sdk(name, pylon, genicam)


def _reason(error: Exception) -> str:
    """What pylon says, without the place in its sources."""
    lines = str(error).splitlines() or [type(error).__name__]
    return lines[0].partition(" : ")[0].rstrip(". ")
