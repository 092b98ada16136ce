"""SpinCore's library, or the simulator's with the same functions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from labseq.plugin import Context, DeviceError, Emergency
from labseq_pulseblaster.emergency import SpinapiError, load
from labseq_pulseblaster.settings import PulseBlasterSettings

if TYPE_CHECKING:
    from labseq_pulseblaster_sim import SimulatedLibrary


def simulated_settings() -> dict[str, str]:
    """Settings of a simulated board."""
    return {"driver": "simulated"}


class InstalledLibrary:
    """The SpinAPI that is installed. A ``SimulatedLibrary`` has the same methods."""

    def load(self, name: str) -> Any:
        """The C library.

        Args:
            name: Name of the device, for the message.

        Raises:
            DeviceError: It is not installed.
        """
        try:
            return load()
        except SpinapiError as error:
            hint = "install SpinAPI from spincore.com. To try things without a board, set `driver: simulated`"
            raise DeviceError(name, f"{error}; {hint}") from error

    def emergency(self, board_number: int, clock_mhz: float, flags: int) -> Emergency | None:
        """The script that turns the lines off from another process."""
        arguments = {"board_number": board_number, "clock_mhz": clock_mhz, "flags": flags}
        return Emergency(Path(__file__).with_name("emergency.py"), arguments)


Library: TypeAlias = "InstalledLibrary | SimulatedLibrary"


def choose_library(settings: PulseBlasterSettings, context: Context) -> Library:
    """The library that the setting ``driver`` names."""
    if not settings.is_simulated:
        return InstalledLibrary()
    from labseq_pulseblaster_sim import SimulatedLibrary

    return SimulatedLibrary(settings, context)
