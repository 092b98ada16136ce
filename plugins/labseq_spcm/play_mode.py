"""Base class of the card's modes, which bring a program to the outputs."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import DeviceError, ToneProgram
from labseq_spcm.card import AwgCard


class PlayMode(ABC):
    """A mode of the card. A subclass says what differs from a card that plays whole programs at a trigger.

    Args:
        card: The open card.

    Attributes:
        max_wait_s: Longest time between two calls of ``finished`` while a program plays, in seconds. 0 means
            at once, inf not before the end.
        render_s: Time for rendering in the last ``prepare``, on this computer's clock.
        beginning_s: Playing time after which a program can be cut, inf for whole programs only.
    """

    max_wait_s = math.inf
    render_s = 0.0
    beginning_s = math.inf

    def __init__(self, card: AwgCard) -> None:
        self._card = card

    @abstractmethod
    def prepare(self, program: ToneProgram) -> float:
        """Transfer a program or its beginning to the card, and return the playing time in seconds.

        Raises:
            LimitError: The mode cannot play it.
            DeviceTimeoutError: The card does not take the data.
        """

    @abstractmethod
    def finished(self) -> bool:
        """Whether the program was played to its end. Repeated calls keep the card supplied.

        Raises:
            TransientError: The card ran out of data.
        """

    def start(self, command: int) -> None:
        """Start the card with this command."""
        self._card.command(command, "start")

    def append(self, program: ToneProgram) -> float:  # noqa: ARG002 - the card knows how much it will play
        """Have the rest of a program follow its beginning, and return its playing time in seconds.

        Raises:
            DeviceError: The mode plays whole programs only.
            LimitError: It cannot play this one.
        """
        raise DeviceError(self._card.name, "this mode plays whole programs only")

    @property
    def triggered(self) -> bool:
        """Whether a program has begun since ``start``."""
        return self._card.triggered

    def check_memory(self, frames: NDArray[np.int16]) -> None:
        """Send samples to the on-board memory while nothing plays, if the mode uploads programs."""

    def idle(self) -> None:
        """Start the output between programs, if the mode has any."""

    def halt(self) -> None:
        """End the supply of the card between calls. The caller stops the card itself."""
