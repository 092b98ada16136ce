"""Mode ``fifo``: streamed to the card while the rest is still being rendered."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq import DeviceError, DeviceTimeoutError, ToneProgram, TransientError
from labseq.motion.rendering import render_chunks
from labseq_spcm.card import POLL_S, TRANSFER_TIMEOUT_S, AwgCard, Buffer
from labseq_spcm.replay import n_samples_of
from labseq_spcm.settings import SpcmSettings

CHUNK: Final = 1 << 17
"""Samples that are rendered and handed over at a time: 0.2 ms at 625 MS/s."""
RING_CHUNKS: Final = 8
FRAME_BYTES: Final = 4
"""A sample of both outputs."""
LEAST_FILL: Final = 1 << 20
"""Least part of the on-board memory that is used as a FIFO, in bytes."""


class Fifo:
    """Streams a program, armed anew for each.

    Rendered chunks go into a ring in the PC, from there over the bus into the card's memory, and
    from there to the outputs. Ring and memory are bounded, so a program is rendered about
    ``fill`` ahead. Before the start both are filled, or the program is there whole. The card is
    told how many samples to play: it ends by itself, and if it runs dry before, it says so.

    Args:
        card: The open card.
        settings: The driver's settings.
        sample_rate_hz: What the card's clock really makes.

    Attributes:
        patience_s: How long the card can be left alone while it plays.
    """

    def __init__(self, card: AwgCard, settings: SpcmSettings, sample_rate_hz: float) -> None:
        self._card = card
        self._row_channel = settings.row_channel
        self._rate_hz = sample_rate_hz
        self._ring = Buffer().reserve(RING_CHUNKS * CHUNK)
        self._chunks: Iterator[NDArray[np.int16]] = iter(())
        self._n_handed = self._n_samples = 0
        spcm = card.spcm
        card.set(spcm.SPC_CARDMODE, spcm.SPC_REP_FIFO_SINGLE, "card mode")
        card.set(spcm.SPC_LOOPS, 1, "loops")
        ahead = int(settings.fill * sample_rate_hz) * FRAME_BYTES - self._ring.nbytes
        self._fill = 1 << round(math.log2(max(LEAST_FILL, ahead)))
        card.set(spcm.SPC_DATA_OUTBUFSIZE, self._fill, "size of the card's FIFO in bytes")
        self.patience_s = self._fill / FRAME_BYTES / sample_rate_hz / 4

    def prepare(self, program: ToneProgram) -> float:
        """Render the beginning, and fill ring and card with it.

        Returns:
            Playing time in seconds.

        Raises:
            DeviceTimeoutError: The card does not fetch the data.
        """
        n_samples = n_samples_of(program, self._rate_hz)
        card, spcm = self._card, self._card.spcm
        card.set(spcm.SPC_SEGMENTSIZE, n_samples, "number of samples")
        card.define_transfer(self._ring, CHUNK * FRAME_BYTES)
        self._chunks = render_chunks(program, self._rate_hz, CHUNK)
        self._n_samples, self._n_handed = n_samples, 0
        self._feed()
        card.command(spcm.M2CMD_DATA_STARTDMA, "transfer")
        deadline_s = card.clock.now() + TRANSFER_TIMEOUT_S
        full = min(n_samples, (self._fill + self._ring.nbytes) // FRAME_BYTES)
        while self._n_handed < full:
            if card.clock.now() > deadline_s:
                text = f"the card fetched {self._n_handed} of {full} samples"
                raise DeviceTimeoutError(card.name, text, TRANSFER_TIMEOUT_S)
            if not self._feed():
                card.clock.sleep(POLL_S)
        return n_samples / self._rate_hz

    def start(self, command: int) -> None:
        """Give the command that starts the card."""
        self._card.command(command, "start")

    def finished(self) -> bool:
        """Feed the card as far as there is room, and see whether it has played to the end.

        Raises:
            TransientError: The card ran out of data.
        """
        try:
            self._feed()
        except DeviceError:  # the card may have stopped since it was asked for room
            self._check_supply()
            raise
        return self._check_supply()

    def _check_supply(self) -> bool:
        """Whether the card has ended, rightly.

        Raises:
            TransientError: It ran out of data.
        """
        spcm, status = self._card.spcm, self._card.status
        ended = bool(status & spcm.M2STAT_CARD_READY)
        if status & spcm.M2STAT_DATA_OVERRUN or (ended and self._n_handed < self._n_samples):
            share = f"{min(1.0, self._n_handed / self._n_samples):.0%} of the program was rendered in time"
            text = f"underrun: the card ran out of samples ({share}); raise `fill`, lower sample_rate, or use"
            raise TransientError(f"{text} the mode replay", self._card.name)
        return ended

    def give_up(self) -> None:
        """Drop what was not rendered."""
        self._chunks = iter(())
        self._n_handed = self._n_samples

    def _feed(self) -> bool:
        """Render into the ring while there is room, once around at most; returns whether there was any."""
        from labseq_spcm._kernels import interleave

        card, spcm = self._card, self._card.spcm
        for n_fed in range(RING_CHUNKS):
            done = self._n_handed >= self._n_samples
            if done or card.read(spcm.SPC_DATA_AVAIL_USER_LEN) < CHUNK * FRAME_BYTES:
                return n_fed > 0
            first = self._n_handed % len(self._ring)
            interleave(next(self._chunks), self._row_channel, self._ring[first : first + CHUNK])
            card.write(spcm.SPC_DATA_AVAIL_CARD_LEN, CHUNK * FRAME_BYTES, "handing samples over")
            self._n_handed += CHUNK
        return True
