"""The modes that play rendered samples, ``replay`` from the card's memory and ``fifo`` as a stream."""

from __future__ import annotations

import math
import time
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import DeviceError, LimitError, ToneProgram, TransientError
from labseq.plugin.rendering import Renderer
from labseq_spcm.card import POLL_S, TRANSFER_TIMEOUT_S, AwgCard, Buffer
from labseq_spcm.limits import FRAME_BYTES, SAMPLE_STEP
from labseq_spcm.play_mode import PlayMode
from labseq_spcm.settings import SpcmSettings

CHUNK: Final = 1 << 18
"""Samples rendered at a time, 0.4 ms at 625 MS/s, few enough to stay in the processor's cache."""
RING_CHUNKS: Final = 4
CHUNK_BYTES: Final = CHUNK * FRAME_BYTES


class InterleavedRenderer:
    """Renders a program as the card stores it, with the samples of both outputs interleaved.

    It renders in the caller's thread. A second thread would have to be waited for, and where other
    programs keep the processor busy that takes longer than the rendering it would take over.

    Args:
        program: The program.
        sample_rate_hz: The rate that the card's clock really makes.
        row_channel: The output of the row axis, 0 or 1.

    Attributes:
        n_samples: Samples per channel, with silence up to the card's granularity.
        first_sample: First sample of each segment of the program, and its end.
    """

    def __init__(self, program: ToneProgram, sample_rate_hz: float, row_channel: int) -> None:
        self._renderer = Renderer(program, sample_rate_hz)
        self.first_sample = self._renderer.first_sample
        self._channels = (row_channel, 1 - row_channel)
        self._chunk = np.empty((2, CHUNK), np.int16)
        self.n_samples = max(1, math.ceil(self._renderer.n_samples / SAMPLE_STEP)) * SAMPLE_STEP

    def write(self, start: int, out: NDArray[np.int16]) -> None:
        """Render some samples, with silence after the end of the program.

        Args:
            start: Index of the first sample.
            out: Result, int16 (n, 2), a column per output.
        """
        from labseq_spcm.kernels import interleave

        frames = out.view(np.uint32)[:, 0]
        for first in range(0, len(out), CHUNK):
            chunk = self._chunk[:, : len(out) - first]
            for axis, channel in enumerate(self._channels):
                self._renderer.write(axis, start + first, chunk[channel])
            first_words, second_words = chunk.view(np.uint16)
            interleave(first_words, second_words, frames[first : first + CHUNK])


class Replay(PlayMode):
    """Mode ``replay``, which uploads the whole program, then waits for its end."""

    def __init__(self, card: AwgCard, settings: SpcmSettings, sample_rate_hz: float) -> None:
        super().__init__(card)
        self._row_channel, self._rate_hz = settings.row_index, sample_rate_hz
        self._buffer = Buffer()
        spcm = card.spcm
        card.set(spcm.SPC_CARDMODE, spcm.SPC_REP_STD_SINGLE, "card mode")
        card.set(spcm.SPC_LOOPS, 1, "loops")
        card.write_setup()
        self._memory_samples = card.read(spcm.SPC_PCIMEMSIZE) // FRAME_BYTES

    def prepare(self, program: ToneProgram) -> float:
        """Render and upload a program, and return its playing time in seconds."""
        start_s = time.perf_counter()
        renderer = InterleavedRenderer(program, self._rate_hz, self._row_channel)
        n_samples = renderer.n_samples
        if n_samples > self._memory_samples:
            quantity = f"{self._card.name}: length of the program"
            length, most = (f"{n / self._rate_hz:.4g} s" for n in (n_samples, self._memory_samples))
            hint = "use `mode: fifo`, or a lower sample_rate"
            raise LimitError(quantity, length, f"{most} (the card's memory)", hint)
        frames = self._buffer.reserve(n_samples)
        renderer.write(0, frames)
        self.render_s = time.perf_counter() - start_s
        self._card.stop()
        self._card.set(self._card.spcm.SPC_MEMSIZE, n_samples, "memory size")
        self._card.upload(frames)
        return n_samples / self._rate_hz

    def check_memory(self, frames: NDArray[np.int16]) -> None:
        """Send samples to the memory."""
        self._card.set(self._card.spcm.SPC_MEMSIZE, len(frames), "memory size")
        self._card.upload(frames)

    def finished(self) -> bool:
        """Whether the program has been played to its end."""
        return not self._card.running


class Fifo(PlayMode):
    """Mode ``fifo``, which streams a program while the rest is still being rendered.

    Rendered chunks go into a ring in the computer, from there over the bus into the card's memory,
    and from there to the outputs. Ring and memory are bounded, so a program is rendered about
    ``fill`` ahead. Before the start both are filled, or hold the whole program. First the ring is rendered
    and handed over, and the transfer started. When the card reports its first block the rest follows, except
    for the last chunk of its memory, since it may keep a part of it for itself. The card knows how many
    samples to play. It stops after them, and reports if it runs dry before.
    """

    max_wait_s = 0.0

    def __init__(self, card: AwgCard, settings: SpcmSettings, sample_rate_hz: float) -> None:
        super().__init__(card)
        self._row_channel, self._rate_hz = settings.row_index, sample_rate_hz
        self._ring = Buffer().reserve(RING_CHUNKS * CHUNK)
        self._half_ring_s = RING_CHUNKS / 2 * CHUNK / sample_rate_hz
        self._renderer: InterleavedRenderer | None = None
        self._n_rendered = self._n_samples = 0
        ahead = int(settings.fill_s * sample_rate_hz) * FRAME_BYTES - self._ring.nbytes
        # of the on-board memory, in bytes, a power of two
        self._fill = 1 << round(math.log2(max(2 * CHUNK_BYTES, ahead)))
        spcm = card.spcm
        card.set(spcm.SPC_CARDMODE, spcm.SPC_REP_FIFO_SINGLE, "card mode")
        card.set(spcm.SPC_LOOPS, 1, "loops")
        card.set(spcm.SPC_DATA_OUTBUFSIZE, self._fill, "size of the card's FIFO in bytes")
        card.write_setup()  # the buffer of a transfer is named afterwards

    def prepare(self, program: ToneProgram) -> float:
        """Fill ring and card with the beginning of a program, and return its playing time in seconds."""
        card, spcm = self._card, self._card.spcm
        start_s = time.perf_counter()
        self._renderer = InterleavedRenderer(program, self._rate_hz, self._row_channel)
        self.render_s = time.perf_counter() - start_s
        self._n_samples, self._n_rendered = self._renderer.n_samples, 0
        card.stop()
        card.set(spcm.SPC_SEGMENTSIZE, self._n_samples, "number of samples")
        card.define_transfer(self._ring, CHUNK_BYTES)
        while self._n_rendered < min(self._n_samples, len(self._ring)):  # the whole ring is free
            self._feed_chunk(self._renderer)
        card.command(spcm.M2CMD_DATA_STARTDMA, "transfer")
        card.wait_for_transfer(self._n_rendered * FRAME_BYTES)
        deadline_s = card.clock.now() + TRANSFER_TIMEOUT_S
        full = min(self._n_samples, (self._fill - CHUNK_BYTES + self._ring.nbytes) // FRAME_BYTES)
        while self._n_rendered < full:
            if card.clock.now() > deadline_s:
                fetched = self._n_rendered * FRAME_BYTES - self._ring.nbytes
                raise card.not_fetched(fetched, full * FRAME_BYTES - self._ring.nbytes)
            if not self._feed():
                card.clock.sleep(POLL_S)
        return self._n_samples / self._rate_hz

    def finished(self) -> bool:
        """Feed the card while it has room. True if it has played to the end."""
        try:
            is_full = self._feed() < RING_CHUNKS
        except DeviceError:  # the card may have stopped just after it reported room
            self._has_ended()
            raise
        self.max_wait_s = self._half_ring_s if is_full else 0.0
        return self._has_ended()

    def _has_ended(self) -> bool:
        """Whether the card has played to the end."""
        spcm, status = self._card.spcm, self._card.status
        ended = bool(status & spcm.M2STAT_CARD_READY)
        if status & spcm.M2STAT_DATA_OVERRUN or (ended and self._n_rendered < self._n_samples):
            share = f"{min(1.0, self._n_rendered / self._n_samples):.0%} of the program was rendered in time"
            text = f"underrun: the card ran out of samples ({share}); raise `fill`, lower sample_rate, or use"
            raise TransientError(f"{text} `mode: sequence`", self._card.name)
        return ended

    def _feed(self) -> int:
        """Render into the ring while there is room, once around at most, and return the number of chunks."""
        card, spcm, renderer = self._card, self._card.spcm, self._renderer
        for n_chunks in range(RING_CHUNKS):
            if renderer is None or self._n_rendered >= self._n_samples:
                return n_chunks
            if card.read(spcm.SPC_DATA_AVAIL_USER_LEN) < CHUNK_BYTES:
                return n_chunks
            self._feed_chunk(renderer)
        return RING_CHUNKS

    def _feed_chunk(self, renderer: InterleavedRenderer) -> None:
        """Render the next chunk into the ring and hand it over."""
        first = self._n_rendered % len(self._ring)
        start_s = time.perf_counter()
        renderer.write(self._n_rendered, self._ring[first : first + CHUNK])
        self.render_s += time.perf_counter() - start_s
        self._card.write(self._card.spcm.SPC_DATA_AVAIL_CARD_LEN, CHUNK_BYTES, "handing samples over")
        self._n_rendered += CHUNK
