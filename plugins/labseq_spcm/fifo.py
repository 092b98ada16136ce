"""Mode ``fifo``: streamed to the card while the rest is still being rendered."""

from __future__ import annotations

import math
import time
from typing import Final

from labseq.plugin import DeviceError, DeviceTimeoutError, ToneProgram, TransientError
from labseq_spcm.card import POLL_S, TRANSFER_TIMEOUT_S, AwgCard, Buffer
from labseq_spcm.interleaved import CHUNK, InterleavedRenderer
from labseq_spcm.settings import SpcmSettings

RING_CHUNKS: Final = 4
FRAME_BYTES: Final = 4
"""A sample of both outputs."""
MIN_FILL: Final = 1 << 20
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
        max_wait_s: How long the card can now be left alone while it plays; 0: not at all.
        render_s: What rendering has taken since the last ``prepare`` began, on this computer's clock.
    """

    render_s = 0.0

    def __init__(self, card: AwgCard, settings: SpcmSettings, sample_rate_hz: float) -> None:
        self._card = card
        self._row_channel = settings.row_channel
        self._rate_hz = sample_rate_hz
        self._ring = Buffer().reserve(RING_CHUNKS * CHUNK)
        self._half_ring_s = RING_CHUNKS / 2 * CHUNK / sample_rate_hz
        self._renderer: InterleavedRenderer | None = None
        self._n_handed = self._n_samples = 0
        self.max_wait_s = 0.0
        spcm = card.spcm
        card.set(spcm.SPC_CARDMODE, spcm.SPC_REP_FIFO_SINGLE, "card mode")
        card.set(spcm.SPC_LOOPS, 1, "loops")
        ahead = int(settings.fill * sample_rate_hz) * FRAME_BYTES - self._ring.nbytes
        self._fill = 1 << round(math.log2(max(MIN_FILL, ahead)))
        card.set(spcm.SPC_DATA_OUTBUFSIZE, self._fill, "size of the card's FIFO in bytes")

    def prepare(self, program: ToneProgram) -> float:
        """Render the beginning, and fill ring and card with it.

        Returns:
            Playing time in seconds.

        Raises:
            DeviceTimeoutError: The card does not fetch the data.
        """
        card, spcm = self._card, self._card.spcm
        start_s = time.perf_counter()
        self._renderer = InterleavedRenderer(program, self._rate_hz, self._row_channel)
        self.render_s = time.perf_counter() - start_s
        n_samples = self._renderer.n_samples
        card.set(spcm.SPC_SEGMENTSIZE, n_samples, "number of samples")
        card.define_transfer(self._ring, CHUNK * FRAME_BYTES)
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
            is_full = self._feed() < RING_CHUNKS
        except DeviceError:  # the card may have stopped since it was asked for room
            self._check_supply()
            raise
        self.max_wait_s = self._half_ring_s if is_full else 0.0
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
        self._renderer = None
        self._n_handed = self._n_samples

    def _feed(self) -> int:
        """Render into the ring while there is room, once around at most; returns how many chunks."""
        card, spcm, renderer = self._card, self._card.spcm, self._renderer
        for n_fed in range(RING_CHUNKS):
            if renderer is None or self._n_handed >= self._n_samples:
                return n_fed
            if card.read(spcm.SPC_DATA_AVAIL_USER_LEN) < CHUNK * FRAME_BYTES:
                return n_fed
            first = self._n_handed % len(self._ring)
            start_s = time.perf_counter()
            renderer.write(self._n_handed, self._ring[first : first + CHUNK])
            self.render_s += time.perf_counter() - start_s
            card.write(spcm.SPC_DATA_AVAIL_CARD_LEN, CHUNK * FRAME_BYTES, "handing samples over")
            self._n_handed += CHUNK
        return RING_CHUNKS
