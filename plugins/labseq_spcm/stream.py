"""Mode ``stream``: the card plays all the time, and programs are spliced into the silence between them."""

from __future__ import annotations

import math
import threading
import time
from typing import Final

import numpy as np

from labseq.plugin import (
    Context,
    DeviceError,
    LabseqError,
    Plan,
    ToneProgram,
    TransientError,
    format_quantity,
    raise_priority,
    tone_program,
)
from labseq_spcm.card import AwgCard, Buffer
from labseq_spcm.keep_warm import KeepWarm, tone_samples
from labseq_spcm.limits import FRAME_BYTES, OUTPUT_FIFO_BYTES
from labseq_spcm.replay_fifo import CHUNK, InterleavedRenderer
from labseq_spcm.settings import SpcmSettings

FIRST: Final = 1 << 17
"""Samples of a program that are rendered before it starts: 0.21 ms at 625 MS/s, behind 0.25 ms of silence."""
BEGINNING_S: Final = 1e-3
"""A program is cut after that time: making the rest takes less, even if the computer is busy."""
LOCK_RETRY_S: Final = 10e-6
"""After that time the thread tries again if a call of the driver is at work."""
PLAYING_POLL_S: Final = 1e-3
"""Longest time between two looks at the ring while a program plays."""
BUS_SAMPLES: Final = 1 << 22
"""Samples that are sent to measure the speed of the bus: 6 ms at 2.8 GB/s."""


def check_rendering(name: str, context: Context, sample_rate_hz: float, row_channel: int) -> None:
    """Render programs with as many tones as the profile allows; the fastest of three tries counts.

    Raises:
        DeviceError: This computer renders more slowly than the card plays.
    """
    grid, motion = context.grid, context.motion
    along = 1 if grid.n_cols > 1 else 0  # a site is a pair (row, column)
    most = min(motion.max_tweezers, (motion.max_row_tones, motion.max_column_tones)[along])
    n_tones = max(1, min(most, grid.shape[along] - 1))
    here = np.zeros((n_tones, 2), np.int16)
    here[:, along] = np.arange(n_tones)
    there = here.copy()
    there[:, along] += grid.shape[along] > 1
    moves = Plan.from_batches([(here, there), (there, here)] * 5)
    renderer = InterleavedRenderer(tone_program(moves, grid, motion), sample_rate_hz, row_channel)
    out = np.empty((renderer.n_samples, 2), np.int16)
    took_s = math.inf
    for _ in range(3):
        start_s = time.perf_counter()
        renderer.write(0, out)
        took_s = min(took_s, time.perf_counter() - start_s)
        if took_s < len(out) / sample_rate_hz:
            return
    wanted, made = (format_quantity(hz, "frequency") for hz in (sample_rate_hz, len(out) / took_s))
    text = f"mode: stream at {wanted}, but this computer renders {n_tones} moving tones at {made}"
    hint = "use a lower sample_rate, one with a whole number of samples per tone spacing, or mode: replay"
    raise DeviceError(name, f"{text}; {hint}")


class Stream:
    """Keeps the card supplied from ``idle`` to ``halt``. See ``PlayMode``.

    Samples go into a ring in the computer, from there over the bus into the card's buffer and its
    output FIFO, and from there to the outputs. While no program plays, silence is handed over one
    look-ahead before it is played. A program follows the last silence that was handed over; it is
    rendered faster than it is played, so the ring is soon full. A thread looks after the ring; on a
    virtual clock the simulated card calls the same steps in its time.

    Attributes:
        n_underruns: How often the card ran dry in silence, and was started again.
        delay_s: From ``start`` to the first sample at the output, at most.
        after_start_s: How long the last ``start`` went on after it had handed the first samples over.

    Raises:
        DeviceError: The bus is too slow for the sample rate.
    """

    max_wait_s = PLAYING_POLL_S
    beginning_s = BEGINNING_S
    render_s = after_start_s = 0.0

    def __init__(
        self, card: AwgCard, settings: SpcmSettings, sample_rate_hz: float, keep_warm: KeepWarm | None = None
    ) -> None:
        self._card = card
        self._rate_hz = sample_rate_hz
        self._row_channel = settings.row_channel
        self._block = block = settings.notify_size // FRAME_BYTES
        self._on_card = (settings.card_buffer + OUTPUT_FIFO_BYTES) // FRAME_BYTES
        self._to_start = settings.card_buffer // FRAME_BYTES // block * block
        ahead = settings.look_ahead_s(sample_rate_hz) * sample_rate_hz - self._on_card
        self._ahead = max(2, int(ahead / block)) * block
        self.delay_s = (self._ahead + self._on_card) / sample_rate_hz
        least = 2 * self._whole_blocks(self._ahead + self._on_card)
        n_samples = max(self._whole_blocks(math.ceil(settings.fill_s * sample_rate_hz)), least)
        self._ring = Buffer().reserve(n_samples)
        self._silence = np.zeros((block, 2), np.int16)
        if keep_warm is not None:
            self._silence[:] = tone_samples(keep_warm, sample_rate_hz, settings.row_channel, block)
        self._first = np.zeros((FIRST, 2), np.int16)
        self._chunk = np.zeros((2, CHUNK), np.int16)
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._is_on = self._is_filling = self._has_thread = False
        self._failure: LabseqError | None = None
        self._prepared: InterleavedRenderer | None = None
        self._program: InterleavedRenderer | None = None
        self._remainder: InterleavedRenderer | None = None
        self._n_rendered = 0
        self._n_written = self._n_fetched = self._start = self._end = self._silent_from = 0
        self.n_underruns = 0
        self._check_bus()
        self._set_mode(settings)

    def _check_bus(self) -> None:
        """Time a transfer to the card's memory; the best of three counts."""
        card, spcm, frames = self._card, self._card.spcm, Buffer().reserve(BUS_SAMPLES)
        card.set(spcm.SPC_MEMSIZE, BUS_SAMPLES, "memory size")
        took_s, needed = math.inf, FRAME_BYTES * self._rate_hz
        for _ in range(3):
            start_s = card.clock.now()
            card.upload(frames, poll_s=20e-6)
            took_s = min(took_s, card.clock.now() - start_s)
            if took_s <= frames.nbytes / needed:
                return
        speed, most_hz = frames.nbytes / took_s, frames.nbytes / took_s / FRAME_BYTES
        wanted, most = (format_quantity(hz, "frequency") for hz in (self._rate_hz, most_hz))
        text = f"the bus carries {speed / 1e9:.3g} GB/s, but mode: stream at {wanted} needs"
        hint = f"use a slot with more lanes, a sample_rate below {most}, or mode: replay"
        raise DeviceError(card.name, f"{text} {needed / 1e9:.3g} GB/s; {hint}")

    def _set_mode(self, settings: SpcmSettings) -> None:
        card, spcm = self._card, self._card.spcm
        card.set(spcm.SPC_CARDMODE, spcm.SPC_REP_FIFO_SINGLE, "card mode")
        card.set(spcm.SPC_LOOPS, 0, "loops")  # it plays until it is stopped
        card.set(spcm.SPC_DATA_OUTBUFSIZE, settings.card_buffer, "size of the card's buffer in bytes")
        card.write_setup()

    # Calls of the driver: they read the status before they take the lock, so that virtual time catches up.

    def idle(self) -> None:
        """Start the stream; no effect if it is on."""
        with self._lock:
            if self._is_on:
                return
            self._begin()
            self._is_on, self._stop = True, threading.Event()
        self._has_thread = not self._card.library.call_in_virtual_time(self._step)
        if self._has_thread:
            threading.Thread(target=self._run, args=(self._stop,), name="spcm stream", daemon=True).start()

    def halt(self) -> None:
        """End the supply and drop the programs; the card is stopped by the caller."""
        self._stop.set()
        self._card.library.call_in_virtual_time(None)
        with self._lock:
            self._is_on, self._failure = False, None
            self._prepared = self._program = self._remainder = None

    def prepare(self, program: ToneProgram, *, continues: bool = False) -> float:  # noqa: ARG002
        """Render the first samples of a program; returns its playing time in seconds."""
        start_s = time.perf_counter()
        renderer = InterleavedRenderer(program, self._rate_hz, self._row_channel, self._chunk)
        self._n_rendered = min(FIRST, self._whole_blocks(renderer.n_samples))
        renderer.write(0, self._first[: self._n_rendered])
        self._prepared = renderer
        self.render_s = time.perf_counter() - start_s
        self._check_failure()
        return renderer.n_samples / self._rate_hz

    def start(self, command: int) -> None:  # noqa: ARG002 - the card runs already
        """Have the prepared program follow what was handed over."""
        self._check_failure()
        with self._lock:
            program, self._prepared = self._prepared, None
            if program is not None:  # else another thread has made the card safe
                self._start_or_restart()
                self._queue_program(program)
                self._supply_until(self._start + self._n_rendered)
                spliced_s = time.perf_counter()
                # a beginning as a whole: this thread makes the rest next, and keeps others from Python
                self._supply_until(min(self._end, self._n_written + int(BEGINNING_S * self._rate_hz)))
                self.after_start_s = time.perf_counter() - spliced_s

    def append(self, program: ToneProgram) -> float:
        """Have the rest of a program follow its beginning, or the silence after it."""
        renderer = InterleavedRenderer(program, self._rate_hz, self._row_channel, self._chunk)
        self._check_failure()
        with self._lock:
            self._remainder = renderer
            self._supply_until(self._n_written + self._on_card)
        return renderer.n_samples / self._rate_hz

    def triggered(self) -> bool:
        """Whether the program has begun: the stream has no trigger."""
        return True

    def finished(self) -> bool:
        """Whether the program has been played to its end."""
        self._check_failure()
        with self._lock:
            if self._remainder is None and self._n_written - self._in_ring() >= self._end + self._on_card:
                self._program = None
            return self._program is None

    def _check_failure(self) -> None:
        """Let a virtual clock's steps be done, and raise the error that ended the stream."""
        if not self._has_thread:  # beside a thread, a call could meet an error that is the thread's
            _ = self._card.status
        with self._lock:
            failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    # The supply, one step at a time

    def _run(self, stop: threading.Event) -> None:
        """The thread."""
        raise_priority()  # so that the card does not run dry because other programs are busy
        while (pause_s := self._step()) is not None and not stop.wait(pause_s):
            pass

    def _step(self) -> float | None:
        """Supply the card; returns after how many seconds that is due again, None if never."""
        if not self._lock.acquire(blocking=False):
            return LOCK_RETRY_S
        try:
            if not self._is_on:
                return None
            return self._supply()
        except LabseqError as failure:
            self._is_on, self._failure = False, failure
            return None
        finally:
            self._lock.release()

    def _supply_until(self, handed: int) -> None:
        """Hand over as many samples, or as there is room for."""
        while self._n_written < handed and self._supply() == 0.0:
            pass

    def _supply(self) -> float:
        """Hand over what there is room for; returns after how many seconds that is due again."""
        in_ring = self._start_or_restart()
        try:
            return self._fill(in_ring)
        except DeviceError:
            if self._card.running:
                raise
            self._recover(self._n_written - self._in_ring())  # it ran dry just now
            return 0.0

    def _fill(self, in_ring: int) -> float:
        """The same, with ``in_ring`` samples in the ring.

        A part of a program is as long as what is ahead of the outputs: each part costs 0.1 ms for the tables
        of its tones, and a longer one takes less time than it plays.
        """
        if self._remainder is not None and self._n_written >= self._end:
            rest, self._remainder, self._n_rendered = self._remainder, None, 0
            self._queue_program(rest)
        if self._program is not None and self._n_written < self._end:
            room = min(len(self._ring) - in_ring, self._end - self._n_written)
            if room:
                ahead = (in_ring + self._on_card) // self._block * self._block
                part = max(self._block, min(CHUNK, ahead))
                self._hand_over_program(self._program, min(room, part))
                return 0.0
            return min(PLAYING_POLL_S, len(self._ring) / 8 / self._rate_hz)
        self._hand_over_silence(self._ahead - in_ring)
        return self._ahead / 2 / self._rate_hz

    def _start_or_restart(self) -> int:
        """Start the card once it has samples, begin again if it ran dry; returns the samples in the ring."""
        card, spcm = self._card, self._card.spcm
        in_ring = self._in_ring()
        fetched, before = self._n_written - in_ring, self._n_fetched
        self._n_fetched = fetched
        if self._is_filling:
            if fetched >= self._to_start:
                start = spcm.M2CMD_CARD_START | spcm.M2CMD_CARD_ENABLETRIGGER | spcm.M2CMD_CARD_FORCETRIGGER
                card.command(start, "start of the stream")
                self._is_filling = False
        elif (not in_ring or fetched == before) and not card.running:
            self._recover(fetched)
            return self._in_ring()
        return in_ring

    def _begin(self) -> None:
        """Fill the card with silence; it is started when it has some."""
        card, spcm = self._card, self._card.spcm
        card.stop()
        self._n_written, self._n_fetched, self._silent_from = 0, 0, len(self._ring)
        card.define_transfer(self._ring, self._block * FRAME_BYTES)
        self._hand_over_silence(self._ahead + self._on_card)
        card.command(spcm.M2CMD_DATA_STARTDMA, "transfer")
        self._is_filling = True

    def _queue_program(self, program: InterleavedRenderer | None) -> None:
        """Have a program follow what was handed over."""
        self._program, self._start = program, self._n_written
        self._end = self._n_written + (self._whole_blocks(program.n_samples) if program else 0)

    def _recover(self, fetched: int) -> None:
        """The card has run dry, or was stopped: begin again, with the program if it cannot have begun.

        Raises:
            TransientError: In the middle of a program.
        """
        # only whole blocks are reported as fetched: a part of the first one may have been played
        may_have_begun = self._start <= fetched and self._start < self._n_written
        if self._program is not None and may_have_begun and fetched < self._end:
            share = f"{(fetched - self._start) / (self._end - self._start):.0%} of the program was played"
            text = f"underrun: the card ran out of samples ({share}); raise `fill`, lower sample_rate, or use"
            raise TransientError(f"{text} the mode replay", self._card.name)
        self.n_underruns += 1
        self._begin()
        if self._program is not None:
            self._queue_program(None if fetched >= self._end else self._program)

    def _in_ring(self) -> int:
        """Samples that were handed over and that the card has not reported as fetched."""
        free = self._card.read(self._card.spcm.SPC_DATA_AVAIL_USER_LEN) // FRAME_BYTES
        return len(self._ring) - free

    def _whole_blocks(self, n_samples: int) -> int:
        return -(-n_samples // self._block) * self._block

    def _hand_over_silence(self, n_samples: int) -> None:
        n_samples = min(len(self._ring), n_samples // self._block * self._block)
        if n_samples <= 0:
            return
        if self._n_written < self._silent_from:
            for n in range(0, n_samples, self._block):
                at = (self._n_written + n) % len(self._ring)
                self._ring[at : at + self._block] = self._silence
        self._hand_over(n_samples)

    def _hand_over_program(self, program: InterleavedRenderer, n_samples: int) -> None:
        """Copy or render the next part of the program into the ring; behind its end there is silence."""
        at, done = self._n_written % len(self._ring), self._n_written - self._start
        part = self._ring[at : at + n_samples]
        if done < self._n_rendered:
            part = part[: self._n_rendered - done]
            part[:] = self._first[done : done + len(part)]
        else:
            start_s = time.perf_counter()
            program.write(done, part)
            self.render_s += time.perf_counter() - start_s
        self._silent_from = self._end + len(self._ring)
        self._hand_over(len(part))

    def _hand_over(self, n_samples: int) -> None:
        card = self._card
        card.write(card.spcm.SPC_DATA_AVAIL_CARD_LEN, n_samples * FRAME_BYTES, "handing samples over")
        self._n_written += n_samples
