"""The driver library of the card, the vendor's or the simulator's."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from labseq.plugin import Context, DeviceError, Emergency
from labseq.plugin.messages import install_hint, missing_package
from labseq_spcm.settings import SpcmSettings

if TYPE_CHECKING:
    from labseq_spcm_sim import SimulatedLibrary

SIMULATED: Final = "simulated"
"""Device names that begin like this belong to simulated cards. The vendor's never do."""
LIBRARY: Final = "spcm_win64.dll" if os.name == "nt" else "libspcm_linux.so"


def simulated_settings() -> dict[str, str | int] | str:
    """Settings of a simulated card for the vendor's Python package, or why there is none here."""
    simulated: dict[str, str | int] = {"card": "simulated", "trigger": "software", "serial": 0}
    return missing_package("spcm_core") or simulated


class VendorLibrary:
    """Spectrum's own driver library, which must be installed. A ``SimulatedLibrary`` has the same methods.

    Args:
        device_name: The card's name in Spectrum's Control Center.
    """

    def __init__(self, device_name: str) -> None:
        self._device_name = device_name

    def load(self) -> Any:
        """Import the package ``spcm_core``, which loads the library."""
        return importlib.import_module("spcm_core")

    def warm(self) -> None:
        """Do slow work before the first shot, here none."""

    def connect(self) -> str:
        """Make the card available, and return its device name."""
        return self._device_name

    def disconnect(self) -> None:
        """Release the card. No effect if it is not connected."""

    def functions(self) -> tuple[int, int]:
        """Addresses of the C functions that read and write a register of 64 bits."""
        module = importlib.import_module("spcm_core")
        functions = module.spcm_dwGetParam_i64, module.spcm_dwSetParam_i64_
        get, put = (ctypes.cast(function, ctypes.c_void_p).value or 0 for function in functions)
        return get, put

    def call_in_virtual_time(self, step: Callable[[], float | None] | None) -> bool:  # noqa: ARG002
        """False, because time is never virtual with a real card, and a thread does the work between calls.

        Args:
            step: One step of the work. It returns after how many seconds it is to be called again, or None
                for the last. None stops the steps.
        """
        return False

    def step_time_s(self) -> float:
        """The time of the present step, here 0, since there are none."""
        return 0.0

    def emergency(self, script: Path, n_outputs: int) -> Emergency | None:
        """The driver's script that switches the card off from another process, with the vendor's library."""
        return Emergency(script, {"library": LIBRARY, "card": self._device_name, "n_outputs": n_outputs})


Library: TypeAlias = "VendorLibrary | SimulatedLibrary"


def choose_library(name: str, settings: SpcmSettings, context: Context) -> Library:
    """The library that the setting ``card`` asks for.

    Raises:
        DeviceError: The package ``spcm_core`` is missing, from which the simulated card has its registers.
        ConfigError: The file that ``faults.first_contact`` names is missing or was edited.
    """
    if not settings.card.startswith(SIMULATED):
        return VendorLibrary(settings.card)
    try:
        from labseq_spcm_sim import SimulatedLibrary, card_with
    except ModuleNotFoundError as error:
        raise _not_installed(name, error) from error
    new_card = card_with(settings.faults.model_dump(), settings.model)
    return SimulatedLibrary(
        settings.card, context.clock, context.simulation, *settings.outputs, new_card=new_card
    )


def load_spcm(name: str, library: Library) -> Any:
    """Import the package ``spcm_core``.

    Args:
        name: Name of the device, for the message.
        library: Where it finds its driver library.

    Raises:
        DeviceError: The package or the library is missing.
    """
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints, and stdout may be for JSON
            return library.load()
    except ModuleNotFoundError as error:
        raise _not_installed(name, error) from error
    except Exception as error:  # it raises a bare Exception without the library
        reason = (str(error).splitlines() or [type(error).__name__])[0].partition(". ")[0].rstrip(".")
        text = f"the Python package 'spcm_core' finds no driver library ({reason}); install Spectrum's driver"
        hint = "To try things without a card, set `card: simulated`"
        raise DeviceError(name, f"{text} for this system. {hint}") from error


def _not_installed(name: str, error: ModuleNotFoundError) -> DeviceError:
    text = f"the Python package 'spcm_core' cannot be imported ({error})"
    return DeviceError(name, f"{text}; install it with {install_hint('', 'spcm_core')}")
