"""What goes wrong with the library and with cameras."""

from __future__ import annotations

from typing import Final

INSTALL: Final = (
    "install it: Debian and Ubuntu `apt-get install libaravis-0.8-0`, Fedora `dnf install aravis`, "
    "macOS `brew install aravis`, Windows the package mingw-w64-ucrt-x86_64-aravis of MSYS2 with its "
    "folder `ucrt64\\bin` on PATH"
)
"""How to get libaravis on each system."""


class AravisError(Exception):
    """The library or a camera refused something.

    Attributes:
        code: What kind of error, in the library's terms: "timeout", "not found", "not controller",
            "out of range", ...; "" if it is none of the library's.
    """

    def __init__(self, message: str, code: str = "") -> None:
        self.code = code
        super().__init__(message)


class LibraryMissingError(AravisError):
    """The library is not installed; the text says how to install it."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"the library libaravis 0.8 cannot be loaded ({reason}); {INSTALL}", "missing")


class PixelFormatError(AravisError):
    """A frame has a pixel format that is not read here."""

    def __init__(self, pixel_format: int) -> None:
        text = f"frames have the pixel format 0x{pixel_format:08X}; expected Mono8, Mono10, Mono12, Mono14"
        super().__init__(f"{text} or Mono16, unpacked; set PixelFormat", "pixel format")


DEVICE_ERRORS: Final = (
    "wrong feature",
    "feature not found",
    "not connected",
    "protocol error",
    "transfer error",
    "timeout",
    "not found",
    "invalid parameter",
    "no description",
    "no stream channel",
    "not controller",
    "unknown",
    "not implemented",
    "invalid parameter",
    "invalid address",
    "write protected",
    "bad alignment",
    "access denied",
    "busy",
)
"""Names of the codes in the library's error domain of devices (``ArvDeviceError``), from 0."""

DESCRIPTION_ERRORS: Final = (
    "property not defined",
    "value not defined",
    "invalid value",
    "empty enumeration",
    "out of range",
    "no device",
    "not implemented",
    "feature not found",
    "not offered",
    "invalid length",
    "read only",
    "no text to set",
    "no text to get",
    "invalid bits",
    "invalid syntax",
)
"""Names of the codes in its error domain of a camera's description (``ArvGcError``), from 0."""
