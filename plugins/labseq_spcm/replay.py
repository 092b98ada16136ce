"""Mode ``replay``: the whole program in the card's memory, then a trigger."""

from __future__ import annotations

import math
import time

from labseq.plugin import LimitError, ToneProgram
from labseq_spcm.card import AwgCard, Buffer
from labseq_spcm.interleaved import InterleavedRenderer
from labseq_spcm.settings import SpcmSettings


class Replay:
    """Uploads a program whole, and sees its end.

    Args:
        card: The open card.
        settings: The driver's settings.
        sample_rate_hz: What the card's clock really makes.

    Attributes:
        max_wait_s: How long the card can be left alone while it plays.
        render_s: What rendering took in the last ``prepare``, on this computer's clock.
    """

    max_wait_s = math.inf
    render_s = 0.0

    def __init__(self, card: AwgCard, settings: SpcmSettings, sample_rate_hz: float) -> None:
        self._card = card
        self._row_channel = settings.row_channel
        self._rate_hz = sample_rate_hz
        self._buffer = Buffer()
        spcm = card.spcm
        card.set(spcm.SPC_CARDMODE, spcm.SPC_REP_STD_SINGLE, "card mode")
        card.set(spcm.SPC_LOOPS, 1, "loops")
        self._most = card.read(spcm.SPC_PCIMEMSIZE) // 4

    def prepare(self, program: ToneProgram) -> float:
        """Render and upload.

        Returns:
            Playing time in seconds.

        Raises:
            LimitError: It does not fit into the card's memory.
        """
        start_s = time.perf_counter()
        rendered = InterleavedRenderer(program, self._rate_hz, self._row_channel)
        n_samples = rendered.n_samples
        if n_samples > self._most:
            what = f"{self._card.name}: length of the program"
            asked, most = (f"{n / self._rate_hz:.4g} s" for n in (n_samples, self._most))
            hint = "use mode: fifo, or a lower sample_rate"
            raise LimitError(what, asked, f"{most}: the card's memory", hint)
        frames = self._buffer.reserve(n_samples)
        rendered.write(0, frames)
        self.render_s = time.perf_counter() - start_s
        self._card.set(self._card.spcm.SPC_MEMSIZE, n_samples, "memory size")
        self._card.upload(frames)
        return n_samples / self._rate_hz

    def start(self, command: int) -> None:
        """Give the command that starts the card."""
        self._card.command(command, "start")

    def finished(self) -> bool:
        """Whether it has been played to its end."""
        return not self._card.running

    def give_up(self) -> None:
        """Nothing is left over when the card was stopped."""
