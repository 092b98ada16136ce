"""Outputs of grey levels to a display, through ``slmsuite``, a file, or the simulated SLM."""

from __future__ import annotations

import importlib
import warnings
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Context, DeviceError
from labseq.plugin.messages import install_hint
from labseq_slm.optics import Optics
from labseq_slm.settings import SlmSettings

Levels = NDArray[np.uint8]


class Output(Protocol):
    """An SLM that can be written to."""

    def open(self) -> None:
        """Get ready, without showing anything."""
        ...

    def show(self, levels: Levels) -> None:
        """Show grey levels, uint8 (rows, columns), and return when they were handed over."""
        ...

    def close(self) -> None:
        """Disconnect. Legal in any state."""
        ...

    def versions(self) -> dict[str, tuple[str, str]]:
        """As ``Hardware.versions``."""
        ...


class Display:
    """A display of this computer that is the SLM's input, full screen, by ``slmsuite``.

    Args:
        name: Name of the device.
        settings: Which display, and the pixels of the SLM.
    """

    def __init__(self, name: str, settings: SlmSettings) -> None:
        self._name, self._settings = name, settings
        self._screen: Any = None
        self._version = ""

    def open(self) -> None:
        """Open a window that fills the display.

        Raises:
            DeviceError: ``slmsuite`` is missing, there is no such display, or it has other pixels.
        """
        settings = self._settings
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # slmsuite warns of graphics cards that are not there
                module = importlib.import_module("slmsuite.hardware.slms.screenmirrored")
                self._version = str(getattr(importlib.import_module("slmsuite"), "__version__", ""))
                screen = module.ScreenMirrored(
                    settings.display,
                    wav_um=settings.wavelength * 1e6,
                    pitch_um=(settings.pixel_pitch * 1e6,) * 2,
                )
        except ImportError as error:
            text = f"a display needs the packages slmsuite and pyglet ({error})"
            raise DeviceError(self._name, f"{text}; install them with {install_hint('slm')}") from error
        except Exception as error:  # slmsuite and pyglet have no class of errors of their own
            raise DeviceError(self._name, f"cannot open display {settings.display}: {error}") from error
        self._screen = screen
        if tuple(screen.shape) != settings.pixels:
            self.close()
            came, expected = (f"{rows} x {columns}" for rows, columns in (screen.shape, settings.pixels))
            text = f"display {settings.display} has {came} pixels, but `pixels` says {expected}"
            raise DeviceError(self._name, f"{text}; choose another `display`, or set its resolution")

    def show(self, levels: Levels) -> None:
        """Show grey levels. Integers are displayed as they are."""
        try:
            self._screen.set_phase(levels, phase_correct=False, settle=False, block=True)
        except Exception as error:  # see open()
            text = f"display {self._settings.display} does not take the grey levels: {error}"
            raise DeviceError(self._name, text) from error

    def close(self) -> None:
        """Close the window."""
        screen, self._screen = self._screen, None
        if screen is not None:
            screen.close()

    def versions(self) -> dict[str, tuple[str, str]]:
        """The version of slmsuite. No real SLM was tried."""
        return {"slmsuite": (self._version, "0.5.0")} if self._version else {}


class PngFile:
    """A file that another program shows on the SLM.

    Args:
        name: Name of the device.
        path: The file, which is replaced at once, so that the other program never reads half of it.
    """

    def __init__(self, name: str, path: Path) -> None:
        self._name, self._path = name, path
        self._picture: Any = None

    def open(self) -> None:
        """Check that the file can be written.

        Raises:
            DeviceError: Pillow is missing, or there is no such folder.
        """
        try:
            self._picture = importlib.import_module("PIL.Image")
        except ImportError as error:
            text = f"a PNG file needs Pillow; install it with {install_hint('slm')}"
            raise DeviceError(self._name, text) from error
        if not self._path.parent.is_dir():
            raise DeviceError(
                self._name, f"cannot write {self._path}: there is no folder {self._path.parent}"
            )

    def show(self, levels: Levels) -> None:
        """Write the file."""
        part = self._path.with_name(f"{self._path.name}.part")
        try:
            self._picture.fromarray(levels).save(part, "PNG")
            part.replace(self._path)
        except OSError as error:
            raise DeviceError(self._name, f"cannot write {self._path}: {error.strerror or error}") from error

    def close(self) -> None:
        """Do nothing, since the file stays."""

    def versions(self) -> dict[str, tuple[str, str]]:
        """None."""
        return {}


def choose_output(name: str, settings: SlmSettings, optics: Optics, context: Context) -> Output:
    """The output that the settings name."""
    if settings.output == "display":
        return Display(name, settings)
    if settings.output == "file":
        assert settings.image is not None  # checked by the settings
        return PngFile(name, settings.image)
    from labseq_slm_sim.panel import SimulatedSlm

    return SimulatedSlm(name, settings, optics, context)
