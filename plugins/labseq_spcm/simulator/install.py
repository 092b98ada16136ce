"""Making ``import spcm`` work where the vendor's library is not installed."""

from __future__ import annotations

import ctypes
import importlib
import sys
import threading
from collections.abc import Generator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, Final

from labseq.plugin import DeviceError
from labseq_spcm.simulator.card import SimulatedCard
from labseq_spcm.simulator.library import LIBRARY, Library

PREFIX: Final = "simulated"
"""Device names that begin like this belong to simulated cards; the vendor's never do."""

_LOCK: Final = threading.Lock()
_LIBRARIES: Final[list[Library]] = []
"""The library of this process, once there is one: ``spcm`` keeps it until the process ends."""


def install(card: SimulatedCard, name: str = "") -> str:
    """Make a simulated card available to ``spcm`` under a device name.

    Args:
        card: The card.
        name: Its device name, which begins with "simulated"; by default one that is free.

    Returns:
        The device name, for ``spcm.Card(name)``.

    Raises:
        DeviceError: The name is taken, or could be that of a real card.
    """
    with _LOCK:
        library = _library()
        if not name:
            name = next(free for n in range(10**6) if (free := f"{PREFIX}{n}") not in library.cards)
        if not name.startswith(PREFIX) or name in library.cards:
            reason = "is taken" if name in library.cards else f"does not begin with {PREFIX!r}"
            raise DeviceError(
                "spcm simulator", f"the device name {name!r} {reason}; leave it out to get a free one"
            )
        library.cards[name] = card
        return name


def prepare() -> None:
    """Import ``spcm`` so that it finds simulated cards, whether or not there is a vendor's library."""
    with _LOCK:
        _library()


def uninstall(name: str) -> None:
    """Take a simulated card away: it cannot be opened any more. No effect if it is not there."""
    with _LOCK:
        for library in _LIBRARIES:
            library.cards.pop(name, None)


@contextmanager
def installed(card: SimulatedCard, name: str = "") -> Generator[str]:
    """Within the block the card is available to ``spcm``; gives its device name."""
    name = install(card, name)
    try:
        yield name
    finally:
        uninstall(name)


def vendor_library_found() -> bool:
    """Whether the vendor's library is installed, so that real cards can be opened."""
    for library in _LIBRARIES:
        return library.has_vendor
    return _vendor() is not None


def _loader() -> Any:
    return ctypes.cdll if sys.platform != "win32" else ctypes.windll


def _vendor() -> Any:
    """The vendor's library, or None."""
    try:
        return _loader().LoadLibrary(LIBRARY)
    except OSError:
        return None


def _library() -> Library:
    """The library of this process; the first call imports ``spcm``."""
    if not _LIBRARIES:
        core: Any = sys.modules.get("spcm_core.pyspcm")
        vendor: Any = getattr(core, "spcmDll", None)
        if vendor is not None:
            library = Library(vendor)
            _take_over(library, core)
        else:
            library = Library(_vendor())
            for name in _loaded():  # without a library, as SPCM_NO_DLL allows
                del sys.modules[name]
            with _answered(library):
                importlib.import_module("spcm")
        _LIBRARIES.append(library)
    return _LIBRARIES[0]


def _loaded() -> list[str]:
    """The modules of ``spcm`` that were imported."""
    return [name for name in sys.modules if name.partition(".")[0] in ("spcm", "spcm_core")]


@contextmanager
def _answered(library: Library) -> Generator[None]:
    """Within the block a load of the vendor's library gets ours."""
    loader = _loader()
    load = loader.LoadLibrary

    def answer(name: str) -> Any:
        return SimpleNamespace(**library.functions) if name == LIBRARY else load(name)

    loader.LoadLibrary = answer
    try:
        yield
    finally:
        loader.LoadLibrary = load


def _take_over(library: Library, core: Any) -> None:
    """``spcm`` was imported with the vendor's library: put our functions in the place of its own."""
    for name, function in library.functions.items():
        wrapped = name + "_"  # spcm keeps the C function so where it puts one of its own in front
        kept = wrapped if hasattr(core, wrapped) else name
        original = getattr(core, kept)
        function.restype = original.restype
        for module in map(sys.modules.__getitem__, _loaded()):
            if getattr(module, kept, None) is original:
                setattr(module, kept, function)
