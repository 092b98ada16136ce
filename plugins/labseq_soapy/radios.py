"""Radios, the rates of their connections, and whether they can shift the samples digitally.

The figures and their sources are in docs/how-to/static-tweezers-soapy.md, "The connection".
"""

from __future__ import annotations

from typing import Final, Literal, NamedTuple, TypeAlias

Bus: TypeAlias = Literal["usb2", "usb3", "1gbe", "10gbe"]

BUSES: Final[dict[str, tuple[str, float]]] = {
    "usb2": ("USB 2", 53.248e6),
    "usb3": ("USB 3", 500e6),
    "1gbe": ("Gigabit Ethernet", 100e6),
    "10gbe": ("10 Gigabit Ethernet", 1200e6),
}
"""Value of the setting -> name, bytes of samples per second."""


class KnownRadio(NamedTuple):
    """A radio that its arguments name."""

    name: str
    bus: Bus
    """Its fastest connection."""
    most_hz: float | None = None
    """Highest sample rate with two channels, None if the connection sets it."""


_B2X0: Final = KnownRadio("a USRP B2x0", "usb3", 30.72e6)
_N2X0: Final = KnownRadio("a USRP N2x0", "1gbe")
_X3X0: Final = KnownRadio("a USRP X3x0", "10gbe")
_KNOWN: Final = {
    **dict.fromkeys(("b200", "b210"), _B2X0),
    **dict.fromkeys(("usrp2", "n200", "n210"), _N2X0),
    **dict.fromkeys(("x300", "x310"), _X3X0),
    "lime": KnownRadio("a LimeSDR", "usb3"),
}
"""Value of the argument driver, type, product or name -> radio."""

_TUNE_DIGITALLY: Final = frozenset({"uhd", "lime"})


def read_arguments(text: str) -> dict[str, str]:
    """The arguments of a device or stream, such as ``driver=uhd,type=b200``, in lower case."""
    pairs = (pair.partition("=") for pair in text.lower().split(","))
    return {key.strip(): value.strip() for key, _, value in pairs}


def tunes_digitally(device: str) -> bool:
    """Whether a radio is known to shift the samples away from its local oscillator."""
    arguments = read_arguments(device)
    if "simulated" in arguments:
        return float(arguments.get("components", 2)) > 1
    return arguments.get("driver") in _TUNE_DIGITALLY


def too_fast(device: str, bus: Bus | None, stream: str, rate_hz: float) -> tuple[str, float] | None:
    """Why a sample rate is too high for two channels of a radio, and the highest, None if it is not.

    Args:
        device: Arguments that open it.
        bus: Its connection, None for its fastest.
        stream: Arguments of its stream. With ``WIRE=sc8`` a sample has 2 bytes instead of 4.
        rate_hz: Samples per second and channel.
    """
    arguments = read_arguments(device)
    names = (arguments.get(key, "") for key in ("product", "type", "name", "driver"))
    radio = next((_KNOWN[name] for name in names if name in _KNOWN), None)
    most_hz = float("inf")
    why = ""
    if radio is not None and radio.most_hz is not None:
        most_hz = radio.most_hz
        why = f"{radio.name} takes at most {most_hz / 1e6:g} MHz on two channels"
    if bus := bus or (radio.bus if radio else None):
        name, most_bytes = BUSES[bus]
        n_bytes = 2 * (2 if read_arguments(stream).get("wire") == "sc8" else 4)
        if most_bytes / n_bytes < most_hz:
            most_hz = most_bytes / n_bytes
            needed = n_bytes * rate_hz / 1e6
            why = f"two channels need {needed:g} MB/s, but {name} carries {most_bytes / 1e6:g} MB/s"
    return (why, most_hz) if rate_hz > most_hz else None
