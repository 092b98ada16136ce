"""The vendor's package ``spcm``, imported only when a card is opened."""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
from typing import Any

from labseq.plugin import DeviceError

OTHERWISE = "to try things without a card, set `card: simulated`"


def load_spcm(name: str, *, simulated: bool = False) -> Any:
    """Import ``spcm``, which loads the vendor's driver library.

    Args:
        name: Name of the device, for the message.
        simulated: Whether the card is a simulated one, which needs no library.

    Raises:
        DeviceError: The package or the library is missing.
    """
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # spcm prints, and stdout may be for JSON
            if simulated:
                importlib.import_module("labseq_spcm.simulator").prepare()
            spcm = importlib.import_module("spcm")
    except ModuleNotFoundError as error:
        text = f"the Python package 'spcm' cannot be imported ({error}); install it with `pip install spcm`"
        raise DeviceError(name, f"{text}; {OTHERWISE}") from error
    except Exception as error:  # it raises a bare Exception without the library
        raise _no_library(name, _first_line(error)) from error

    simulator = sys.modules.get("labseq_spcm.simulator")  # it has let spcm load without a library
    if not simulated and simulator is not None and not simulator.vendor_library_found():
        raise _no_library(name, "only simulated cards are there")
    return spcm


def _no_library(name: str, reason: str) -> DeviceError:
    text = f"the Python package 'spcm' finds no driver library ({reason}); install Spectrum's driver"
    return DeviceError(name, f"{text} for this system; {OTHERWISE}")


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0].partition(". ")[0].rstrip(".")
