"""What went wrong in the SDK, in words of the lab."""

from __future__ import annotations

from typing import Final

from labseq_andor.codes import Code

GONE: Final = frozenset({Code.ERROR_ACK, Code.USBERROR, Code.ERROR_NOCAMERA, Code.NOT_INITIALIZED})
"""Codes of a camera that does not answer any more."""

NOT_TAKEN: Final = frozenset({Code.ACQ_BUFFER, Code.ACQ_DOWNFIFO_FULL, Code.SPOOLERROR})
"""Codes of an acquisition that ended because frames were not taken over in time."""

_UNPLUGGED: Final = "the camera does not answer any more; look at its power and its cable, then start again"
_HELD: Final = (
    "the camera is there but cannot be used; close Solis and every other program that uses it, and if none "
    "does, switch the camera off and on"
)
_TELLING: Final = {
    Code.ERROR_ACK: _UNPLUGGED,
    Code.USBERROR: _UNPLUGGED,
    Code.NOT_INITIALIZED: _UNPLUGGED,
    Code.ERROR_NOCAMERA: _HELD,
    Code.VXDNOTINSTALLED: _HELD,
    Code.NOT_AVAILABLE: _HELD,
    Code.ACQUIRING: "it was asked for something that it does not do while it acquires",
    Code.NOT_SUPPORTED: "this camera cannot do that",
    Code.INVALID_MODE: "this camera cannot do that with the other settings",
}


def explain(error: Exception) -> str:
    """What an error of pylablib means for a user, with the SDK's function and code at its end."""
    code = getattr(error, "code", None)
    if not isinstance(code, int):
        return str(error) or type(error).__name__
    return explain_code(str(getattr(error, "func", "a function")), code, str(getattr(error, "name", "")))


def explain_code(function: str, code: int, code_name: str = "") -> str:
    """What a code of a function of the SDK means for a user."""
    telling = next((text for known, text in _TELLING.items() if known == code), "Andor's SDK refuses")
    what = f"{code}, {code_name}" if code_name else str(code)
    return f"{telling} ({function} gave {what})"
