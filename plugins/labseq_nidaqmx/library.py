"""NI's driver library or the simulator's, below NI's Python package."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from labseq.plugin import Context, DeviceError, Emergency
from labseq.plugin.messages import install_hint, missing_package
from labseq_nidaqmx.outputs import OutputGroup
from labseq_nidaqmx.settings import NidaqmxSettings

if TYPE_CHECKING:
    from labseq_nidaqmx_sim import SimulatedLibrary

EMERGENCY = Path(__file__).with_name("emergency.py")


def simulated_settings() -> dict[str, str] | str:
    """Settings of simulated cards for NI's Python package, or why there is none here."""
    return missing_package("nidaqmx", "nidaqmx") or {"driver": "simulated"}


class InstalledLibrary:
    """The NI-DAQmx that is installed. A ``SimulatedLibrary`` has the same methods."""

    def load(self, name: str) -> Any:
        """The package ``nidaqmx`` with a library that works.

        Args:
            name: Name of the device, for the message.

        Raises:
            DeviceError: The package or NI-DAQmx is missing.
        """
        package = import_package(name)
        try:
            package.system.System.local()  # which loads the library
        except (package.errors.DaqNotFoundError, package.errors.DaqNotSupportedError) as error:
            text = "NI-DAQmx is not installed, or not for this system; install it from ni.com/downloads"
            hint = "To try things without a card, set `driver: simulated`"
            raise DeviceError(name, f"{text}. {hint}") from error
        return package

    def unload(self) -> None:
        """Do nothing, since a library stays loaded."""

    def emergency(self, groups: Sequence[OutputGroup]) -> Emergency | None:
        """The script that writes the values of the safe state from another process."""
        outputs = [
            [group.kind, channel, low, high]
            for group in groups
            for channel, low, high in zip(
                group.channels, group.low.sum(axis=1).tolist(), group.high.sum(axis=1).tolist(), strict=True
            )
        ]
        return Emergency(EMERGENCY, {"outputs": outputs}) if outputs else None


Library: TypeAlias = "InstalledLibrary | SimulatedLibrary"


def choose_library(settings: NidaqmxSettings, context: Context) -> Library:
    """The library that the setting ``driver`` names."""
    if not settings.is_simulated:
        return InstalledLibrary()
    from labseq_nidaqmx_sim import SimulatedLibrary

    return SimulatedLibrary(settings, context)


def import_package(name: str) -> Any:
    """The package ``nidaqmx``, with the modules that the driver uses.

    Raises:
        DeviceError: It is not installed.
    """
    try:
        for module in ("system", "stream_writers", "constants"):
            importlib.import_module(f"nidaqmx.{module}")
        return importlib.import_module("nidaqmx")
    except ModuleNotFoundError as error:
        text = f"the Python package 'nidaqmx' cannot be imported ({error})"
        raise DeviceError(name, f"{text}; install it with {install_hint('nidaqmx')}") from error
