"""``device: simulated``: the real driver on a radio that exists only in software."""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import ReceivesOutput, Simulation
from labseq_soapy.capture import CapturedOutputs, Ring, built
from labseq_soapy.settings import SoapySettings

DEFAULTS: Final[Mapping[str, str]] = {"speed": "0.1", "buffer": "0.002", "patience": "60"}
"""A tenth of real time costs a tenth of the work. On a computer that does other things too, samples come
late at times: its clock then waits for them, so that equal runs give equal atoms."""


class SimulatedRadio:
    """One simulated radio and its files.

    Args:
        settings: Of the driver; after ``simulated,`` its device may have arguments of the capture module.
        world: What listens to it.

    Attributes:
        folder: Folder of its files.
        device: Arguments that open it.
        environment: Environment in which SoapySDR finds it.

    Raises:
        SoapyError: The capture module cannot be compiled.
    """

    def __init__(self, settings: SoapySettings, world: Simulation | None) -> None:
        self._channels = settings.row_channel, settings.column_channel
        self._world = world if isinstance(world, ReceivesOutput) else None
        given = settings.simulated_arguments
        self.environment = {**os.environ, "SOAPY_SDR_PLUGIN_PATH": str(built())}
        is_ours = "folder" not in given
        self.folder = Path(tempfile.mkdtemp(prefix="labseq-") if is_ours else given["folder"])
        self._remove = weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)
        if not is_ours:
            self._remove.detach()
        arguments = {"driver": "capture", **DEFAULTS, **given, "folder": str(self.folder)}
        self.device = ",".join(f"{key}={value}" for key, value in arguments.items())
        self._outputs: CapturedOutputs | None = None

    @property
    def ring(self) -> Ring:
        """What it was sent; it must be open."""
        return Ring(self.folder)

    def connect_outputs(self, tones_hz: tuple[NDArray[np.float64], NDArray[np.float64]]) -> None:
        """Let the world, if it listens, hear the tones of rows and columns from now on."""
        if self._world is not None:
            self._outputs = CapturedOutputs(self.ring, tones_hz, self._channels)
            self._world.connect_outputs("static_tweezers", self._outputs)

    def look(self) -> None:
        """The driver has changed what is played."""
        if self._outputs is not None:
            self._outputs.look()

    def close(self) -> None:
        """Remove its files, unless their folder was given."""
        self._remove()
