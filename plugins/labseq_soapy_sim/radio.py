"""The radio of ``device: simulated``, which exists only in software."""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Simulation, setting_error
from labseq.plugin.messages import clean, closest, one_of
from labseq.plugin.simulation import ReceivesOutput
from labseq_soapy_sim.device import DRIVER, NUMBERS
from labseq_soapy_sim.outputs import CapturedOutputs
from labseq_soapy_sim.ring import Ring

WORDS: Final[Mapping[str, tuple[str, ...]]] = {
    "fault": ("absent", "inactive"),
    "folder": (),
    "unlocked": ("ref", "lo"),
}
"""Arguments that are texts, and their allowed values, empty for any."""
STREAMER: Final = "labseq_soapy_sim.streamer"
"""The streaming process, with the simulated library."""


def read_arguments(device: str) -> dict[str, str]:
    """The arguments of a device such as ``simulated,speed=1,buffer=0.05``.

    Raises:
        SettingError: There is no such argument, or it is out of range, at the key ``device``.
    """
    pairs = (pair.partition("=") for pair in device.split(",")[1:])
    arguments = {key.strip(): value.strip() for key, _, value in pairs}
    for key, value in arguments.items():
        _check_argument(key, value)
    return arguments


def _check_argument(key: str, value: str) -> None:
    known = (*NUMBERS, *WORDS)
    if key not in known:
        nearest = closest(key, known)
        hint = f"did you mean '{nearest}'?" if nearest else ""
        text = f"the simulated radio has no argument '{clean(key)}'"
        raise setting_error(text, one_of(known), hint, at=("device",))
    came = f"{key} of the simulated radio is '{clean(value)}'"
    if (words := WORDS.get(key)) is not None:
        if not value or (words and value not in words):
            raise setting_error(came, one_of(words) if words else "a folder", at=("device",))
        return
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    _, least = NUMBERS[key]
    if not least <= number < math.inf:
        raise setting_error(came, f"a number, at least {least:g}", at=("device",))


class SimulatedRadio:
    """One simulated radio and its files, which the driver opens instead of a real one.

    Args:
        device: ``simulated``, with arguments of the radio after a comma.
        channels: Channel of the rows and of the columns.
        simulation: Receives the tones' amplitudes, if it implements ``ReceivesOutput``.

    Attributes:
        folder: Folder of the radio's files, while it is open.
    """

    def __init__(self, device: str, channels: tuple[int, int], simulation: Simulation | None) -> None:
        self._arguments = read_arguments(device)
        self._channels = channels
        self._simulation = simulation
        self._outputs: CapturedOutputs | None = None
        self._given = "folder" in self._arguments
        self.folder: Path | None = None

    @property
    def ring(self) -> Ring:
        """The samples that it received. It must be open."""
        assert self.folder is not None
        return Ring(self.folder)

    @property
    def outlives_run(self) -> bool:
        """Whether it can stay on when labseq has ended, because its files are in a folder that stays."""
        return self._given

    def connect(self) -> tuple[str, str, Path]:
        """Make the radio available.

        Returns:
            The arguments that open it, the module that streams to it, and a folder for logs.
        """
        self.folder = Path(self._arguments["folder"] if self._given else tempfile.mkdtemp(prefix="labseq-"))
        arguments = {"driver": DRIVER, **self._arguments, "folder": str(self.folder)}
        return ",".join(f"{key}={value}" for key, value in arguments.items()), STREAMER, self.folder

    def started(self, tones_hz: tuple[NDArray[np.float64], NDArray[np.float64]]) -> None:
        """Let the simulation receive these tones of rows and columns from now on, as the radio streams."""
        if isinstance(self._simulation, ReceivesOutput):
            self._outputs = CapturedOutputs(self.ring, tones_hz, self._channels)
            self._simulation.connect_outputs("static_tweezers", self._outputs)

    def changed(self) -> None:
        """Measure the amplitudes after the driver has changed them."""
        if self._outputs is not None:
            self._outputs.measure()

    def released(self) -> None:
        """End the silence in the samples after the driver has released the atoms."""
        if self._outputs is not None:
            self._outputs.end_silence()

    def disconnect(self) -> None:
        """Remove its files, unless the profile names their folder. No effect if it is not connected."""
        self._outputs = None
        if self.folder is not None and not self._given:
            shutil.rmtree(self.folder, ignore_errors=True)
        self.folder = None
