"""The way to an open camera, and what to say when it ends."""

from __future__ import annotations

import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import Final

from labseq.plugin import DeviceError
from labseq_genicam.aravis import AravisError, Camera, LibraryMissingError

GONE: Final = frozenset({"timeout", "not connected"})
"""Codes of errors that say that a camera does not answer."""

OCCUPIED: Final = frozenset({"not controller", "access denied", "busy"})
"""Codes of errors that say that somebody else has it."""

HINTS: Final = {
    "missing": "to try things without it, use another camera, for example `use: virtual`",
    "not found": "look after its cable, power and network address; to try things without a camera, set "
    "`camera: simulated`",
}
"""What else to say, by the code of an error."""


class Link:
    """An open camera, as long as it answers.

    Each question to one that is gone takes 2.5 s, so after the first it is asked nothing more.

    Args:
        name: Name of the camera in the profile, for errors.
        camera: IP address, id or serial number; None for the only camera there is.

    Attributes:
        name: Name of the camera in the profile.
        camera: The camera.
        is_gone: Whether it has stopped answering.

    Raises:
        DeviceError: There is no library, no such camera, or somebody else has it.
    """

    def __init__(self, name: str, camera: str | None) -> None:
        self.name = name
        self.is_gone = False
        with told(name, "open the camera"):
            self.camera = Camera(camera)

    @contextmanager
    def doing(self, what: str) -> Generator[Camera]:
        """Ask something of the camera.

        Raises:
            DeviceError: It refused, or is gone.
        """
        self.check()
        try:
            with told(self.name, what):
                yield self.camera
        except DeviceError as error:
            cause = error.__cause__
            if isinstance(cause, AravisError) and cause.code in GONE:
                self.is_gone = True
                raise self._lost() from cause
            raise

    def check(self) -> None:
        """Raise if the camera is known to be gone; asks nothing.

        Raises:
            DeviceError: It is gone.
        """
        self.is_gone = self.is_gone or self.camera.is_lost
        if self.is_gone:
            raise self._lost()

    def ask(self) -> None:
        """Ask the camera for a sign of life.

        Raises:
            DeviceError: It is gone.
        """
        with self.doing("reach the camera") as camera:
            _ = camera.exposure_s

    def close(self) -> None:
        """Let go of the camera; legal again. For one that is gone the library takes 10 s: nobody waits."""
        if self.is_gone or self.camera.is_lost:
            threading.Thread(target=self.camera.close, name=f"{self.name}, gone", daemon=True).start()
        else:
            self.camera.close()

    def _lost(self) -> DeviceError:
        return DeviceError(
            self.name, "the camera is gone: it does not answer; look after its cable and power"
        )


@contextmanager
def told(name: str, what: str) -> Generator[None]:
    """Tell in labseq's terms what went wrong.

    Raises:
        DeviceError: The library raised something, which is its cause.
    """
    try:
        yield
    except LibraryMissingError as error:
        raise DeviceError(name, f"{error}; {HINTS['missing']}") from error
    except AravisError as error:
        text = f"cannot {what}: {error}"
        if error.code in OCCUPIED:
            text = f"cannot {what}: another program controls it; close that one, or wait until it is gone"
        elif hint := HINTS.get(error.code, ""):
            text = f"{text}; {hint}"
        raise DeviceError(name, text) from error
