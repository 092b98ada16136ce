"""Mode ``replay``: the whole program in the card's memory, then a trigger."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from labseq import LimitError, ToneProgram
from labseq.motion.rendering import render_chunks
from labseq_spcm.card import AwgCard, Buffer
from labseq_spcm.limits import SAMPLE_STEP
from labseq_spcm.settings import SpcmSettings

CHUNK: Final = 1 << 17
"""Samples that are rendered at a time: few enough to stay in the cache until they are interleaved."""


def n_samples_of(program: ToneProgram, sample_rate_hz: float) -> int:
    """Samples per channel, silence up to the card's granularity included."""
    n_samples = int(np.rint(program.joint_s[-1] * sample_rate_hz))
    return max(1, math.ceil(n_samples / SAMPLE_STEP)) * SAMPLE_STEP


class Replay:
    """Uploads a program whole, and sees its end.

    Args:
        card: The open card.
        settings: The driver's settings.
        sample_rate_hz: What the card's clock really makes.

    Attributes:
        patience_s: How long the card can be left alone while it plays.
    """

    patience_s = math.inf

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
        from labseq_spcm._kernels import interleave

        n_samples = n_samples_of(program, self._rate_hz)
        if n_samples > self._most:
            what = f"{self._card.name}: length of the program"
            asked, most = (f"{n / self._rate_hz:.4g} s" for n in (n_samples, self._most))
            hint = "use mode: fifo, or a lower sample_rate"
            raise LimitError(what, asked, f"{most}: the card's memory", hint)
        frames = self._buffer.reserve(n_samples)
        frames[-SAMPLE_STEP:] = 0
        for n, chunk in enumerate(render_chunks(program, self._rate_hz, CHUNK)):
            interleave(chunk, self._row_channel, frames[n * CHUNK : (n + 1) * CHUNK])
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
