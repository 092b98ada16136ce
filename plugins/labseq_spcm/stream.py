"""Mode ``stream``, in which the card plays all the time, and programs are spliced into its silence."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import (
    Context,
    DeviceError,
    LabseqError,
    Plan,
    ToneProgram,
    TransientError,
    format_quantity,
)
from labseq.plugin.motion import tone_program
from labseq.plugin.native import WakeSignal, n_cores, new_timer, raise_priority, set_signal
from labseq.plugin.rendering import Renderer, render_address
from labseq_spcm import stream_kernels as k
from labseq_spcm.card import AwgCard, Buffer
from labseq_spcm.keep_warm import KeepWarm, tone_samples
from labseq_spcm.limits import FRAME_BYTES, OUTPUT_FIFO_BYTES, SAMPLE_STEP
from labseq_spcm.play_mode import PlayMode
from labseq_spcm.settings import SpcmSettings

BEGINNING_S: Final = 1e-3
"""A program is cut after that time. Making the rest takes less, even if the computer is busy."""
TRIES: Final = 5
BUS_SAMPLES: Final = 1 << 22
"""Most samples that are sent to measure the speed of the bus, 6 ms at 2.8 GB/s."""
PCIE_BYTES_PER_S: Final = {1: 0.175e9, 2: 0.35e9, 3: 0.69e9}
"""Speed of a lane of each generation to the card, 70 % of its bits, as in the manual's 2.8 GB/s over eight
lanes of generation 2 (with payloads of 256 bytes). Later ones carry at least as much as the third."""


def check_rendering(name: str, context: Context, sample_rate_hz: float, row_channel: int) -> None:
    """Render programs with as many tones as the profile allows, on one core. The fastest of each part counts.

    Raises:
        DeviceError: This computer renders more slowly than the card plays.
    """
    grid, motion = context.grid, context.motion
    along = 1 if grid.n_cols > 1 else 0  # a site is a pair (row, column)
    most_tweezers = min(motion.max_tweezers, (motion.max_row_tones, motion.max_column_tones)[along])
    n_tones = max(1, min(most_tweezers, grid.shape[along] - 1))
    sources = np.zeros((n_tones, 2), np.int16)
    sources[:, along] = np.arange(n_tones)
    goals = sources.copy()
    goals[:, along] += grid.shape[along] > 1
    moves = Plan.from_batches([(sources, goals), (goals, sources)] * 5)
    workspaces: dict[tuple[int, int], Any] = {}
    program = stream_program(tone_program(moves, grid, motion), sample_rate_hz, row_channel, 1, workspaces)
    n_samples = int(program.words[k.LENGTH])
    box, scratch, out = np.zeros(k.N_WORDS, np.int64), new_scratch(), np.zeros((n_samples, 2), np.int16)
    box[k.RENDER], box[k.SCRATCH] = render_address(), scratch.ctypes.data
    parts = range(0, n_samples, k.MOST_SAMPLES)
    took_s, rendered_hz = np.full(len(parts), np.inf), 0.0
    for _ in range(TRIES):
        for number, start in enumerate(parts):
            place, n_part = out[start:].ctypes.data, min(k.MOST_SAMPLES, n_samples - start)
            start_s = time.perf_counter()
            k.render_frames(box, program.words, start, place, n_part)
            took_s[number] = min(took_s[number], time.perf_counter() - start_s)
        # two cores are 1.6 times as fast as one, as each renders an axis and one interleaves both
        rendered_hz = n_samples / took_s.sum() * (1.6 if n_cores() > 1 else 1.0)
        if sample_rate_hz < 0.9 * rendered_hz:  # the rest is for other work of the computer
            return
    required, reached = (format_quantity(hz, "frequency") for hz in (sample_rate_hz, rendered_hz))
    text = f"`mode: stream` needs {required}, but this computer renders {n_tones} moving tones at {reached}"
    hint = "lower sample_rate, best to a whole number of samples per tone spacing, or use `mode: sequence`"
    raise DeviceError(name, f"{text}; {hint}")


@dataclass(frozen=True, slots=True, eq=False)
class Program:
    """A program as the loop takes it.

    Attributes:
        words: See :mod:`labseq_spcm.stream_kernels`.
        axes: Axes of its renderer.
        cuts: Samples where pieces end.
        renderer: Owner of the memory of the axes.
        playing_s: Its length.
    """

    words: NDArray[np.int64]
    axes: NDArray[np.int64]
    cuts: NDArray[np.int64]
    renderer: Renderer
    playing_s: float


def stream_program(
    program: ToneProgram,
    sample_rate_hz: float,
    row_channel: int,
    block: int,
    workspaces: dict[tuple[int, int], Any],
) -> Program:
    """Make a program for the loop, whole blocks of samples long. It needs the workspaces while it plays."""
    renderer = Renderer(program, sample_rate_hz)
    axes, words = renderer.words(workspaces), np.zeros(k.N_PROGRAM, np.int64)
    n_samples = max(1, math.ceil(renderer.n_samples / SAMPLE_STEP)) * SAMPLE_STEP
    words[k.LENGTH], words[k.ROW_CHANNEL] = -(-n_samples // block) * block, row_channel
    words[k.AXES], words[k.N_AXIS] = axes.ctypes.data, axes.shape[1]
    cuts = np.append(silent_joints(program, renderer.first_sample), words[k.LENGTH])
    words[k.CUTS], words[k.N_CUTS] = cuts.ctypes.data, len(cuts)
    return Program(words, axes, cuts, renderer, n_samples / sample_rate_hz)


def silent_joints(program: ToneProgram, first_sample: NDArray[np.int64]) -> NDArray[np.int64]:
    """First samples after the joints between segments at which no tone is on, int64 (n,).

    Args:
        program: The program.
        first_sample: First sample of each segment, and the end, int64 (n_segments + 1,).
    """
    joints = np.empty(len(first_sample), np.int64)
    axis_tones = [
        (axis.offsets, axis.start_amplitude, axis.end_amplitude) for axis in (program.row, program.column)
    ]
    return joints[: k.find_cuts(first_sample, *axis_tones[0], *axis_tones[1], joints)]


def new_scratch() -> NDArray[np.int16]:
    """Room for the samples of both axes before they are interleaved."""
    return np.zeros((2, k.CHUNK), np.int16)


class Stream(PlayMode):
    """Mode ``stream``, which keeps the card supplied from ``idle`` to ``halt``.

    Samples go into a ring in the computer, from there over the bus into the card's buffer and its
    output FIFO, and from there to the outputs. The whole ring is handed over at all times, silence where no
    program plays, so that a delay of the computer costs nothing then. A program is written over the silence
    that the card is about to fetch. It is rendered faster than it is played, so more and more of it is ahead.
    A compiled loop does that in a thread of its own, without Python's lock
    (:mod:`labseq_spcm.stream_kernels`), and sleeps for a quarter of the ring when there is nothing to do. On
    a virtual clock the simulated card calls its steps in its time. Python fills the card before its start,
    also after it ran dry.

    Attributes:
        n_underruns: How often the card ran dry in silence, and was started again.
        delay_s: From ``start`` to the first sample at the output, at most.
        bus_bytes_per_s: Measured speed of the bus.

    Raises:
        DeviceError: The bus is too slow for the sample rate.
    """

    max_wait_s = 1e-3
    beginning_s = BEGINNING_S

    def __init__(
        self, card: AwgCard, settings: SpcmSettings, sample_rate_hz: float, keep_warm: KeepWarm | None = None
    ) -> None:
        super().__init__(card)
        self._rate_hz = sample_rate_hz
        self._row_channel = settings.row_index
        self._block = block = settings.notify_size // FRAME_BYTES
        self._on_card = (settings.card_buffer + OUTPUT_FIFO_BYTES) // FRAME_BYTES
        # a block less than the whole, since the card may keep some bytes and reports whole blocks
        self._to_start = settings.card_buffer // FRAME_BYTES // block * block - block
        ahead = settings.look_ahead_s(sample_rate_hz) * sample_rate_hz - self._on_card
        self._ahead = max(2, int(ahead / block)) * block
        self.delay_s = (self._ahead + self._on_card) / sample_rate_hz
        least = 2 * self._whole_blocks(self._ahead + self._on_card)
        n_samples = max(self._whole_blocks(math.ceil(settings.fill_s * sample_rate_hz)), least)
        self._ring = Buffer().reserve(n_samples)
        self._silence = np.zeros((block, 2), np.int16)
        if keep_warm is not None:
            self._silence[:] = tone_samples(keep_warm, sample_rate_hz, settings.row_index, block)
        self._ring.reshape(-1, block, 2)[:] = self._silence
        # for samples rendered between `prepare` and `start`, at most 0.8 ms at 625 MS/s
        self._ready = [Buffer().reserve(1 << 19) for _ in range(3)]
        for frames in self._ready:
            frames[:] = 0  # so that the memory is there
        self._scratch = new_scratch()
        self._workspaces: dict[tuple[int, int], Any] = {}
        self._timer = new_timer()
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._signals: tuple[WakeSignal, ...] = ()  # of the loop, and of its helper
        self._is_on = self._has_thread = False
        self._failure: LabseqError | None = None
        self._prepared: Program | None = None
        self._alive = deque[Program](maxlen=2 * k.N_QUEUE)  # the loop may still use earlier ones
        self._box = self._new_box()
        self.n_underruns = self._n_pauses = 0
        self.bus_bytes_per_s = self._check_bus()
        self._set_mode(settings)

    def _new_box(self) -> NDArray[np.int64]:
        """The words that Python and the loop share. A loop that has not ended yet keeps its own."""
        box = np.zeros(k.N_WORDS, np.int64)
        box[k.GET], box[k.SET] = self._card.library.functions()
        box[k.HANDLE], box[k.RENDER] = self._card.handle, render_address()
        box[k.RING], box[k.N_RING] = self._ring.ctypes.data, len(self._ring)
        box[k.BLOCK], box[k.ON_CARD], box[k.AHEAD] = self._block, self._on_card, self._ahead
        box[k.SILENCE], box[k.SCRATCH] = self._silence.ctypes.data, self._scratch.ctypes.data
        box[k.VALUE] = box[k.FOUND :].ctypes.data
        spcm, box[k.TO_START] = self._card.spcm, self._to_start
        start = spcm.M2CMD_CARD_START | spcm.M2CMD_CARD_ENABLETRIGGER | spcm.M2CMD_CARD_FORCETRIGGER
        box[k.START_COMMAND] = start
        return box

    def _check_bus(self) -> float:
        """Check that the bus carries the stream, and return its speed in bytes per second.

        The card first tells its slot. Then transfers of two sizes go to its memory, so that only the
        difference of samples counts. Of each size the fastest counts.

        Raises:
            DeviceError: It is too slow.
        """
        card, spcm, needed = self._card, self._card.spcm, FRAME_BYTES * self._rate_hz
        generation, lanes = card.read(spcm.SPC_PCIEXPGENERATION), card.read(spcm.SPC_PCIEXPLANES)
        slot = lanes * PCIE_BYTES_PER_S.get(generation, PCIE_BYTES_PER_S[3])
        if slot < needed:
            raise self._too_slow(f"the slot with {lanes} lanes of PCIe generation {generation}", slot)
        frames, sizes = Buffer().reserve(BUS_SAMPLES), (BUS_SAMPLES // 4, BUS_SAMPLES)
        card.set(spcm.SPC_MEMSIZE, BUS_SAMPLES, "memory size")
        took_s = [min(card.upload(frames[:n], poll_s=20e-6) for _ in range(TRIES)) for n in sizes]
        speed = FRAME_BYTES * (sizes[1] - sizes[0]) / max(took_s[1] - took_s[0], 1e-9)
        if speed < needed:
            raise self._too_slow("the bus", speed)
        return speed

    def _too_slow(self, what: str, bytes_per_s: float) -> DeviceError:
        rate, most = (format_quantity(hz, "frequency") for hz in (self._rate_hz, bytes_per_s / FRAME_BYTES))
        needed = FRAME_BYTES * self._rate_hz
        text = f"{what} carries {bytes_per_s / 1e9:.3g} GB/s, but `mode: stream` at {rate} needs"
        hint = f"use a slot with more lanes, a sample_rate below {most}, or `mode: sequence`"
        return DeviceError(self._card.name, f"{text} {needed / 1e9:.3g} GB/s; {hint}")

    def _set_mode(self, settings: SpcmSettings) -> None:
        card, spcm = self._card, self._card.spcm
        card.set(spcm.SPC_CARDMODE, spcm.SPC_REP_FIFO_SINGLE, "card mode")
        card.set(spcm.SPC_LOOPS, 0, "loops")  # it plays until it is stopped
        card.set(spcm.SPC_DATA_OUTBUFSIZE, settings.card_buffer, "size of the card's buffer in bytes")
        card.write_setup()

    def idle(self) -> None:
        """Start the stream. No effect if it is on."""
        with self._lock:
            if self._is_on:
                return
            is_silent = self._ring_is_silent()
            self._n_pauses = self.n_pauses
            self._box, self._alive = self._new_box(), deque(maxlen=2 * k.N_QUEUE)
            self._begin(is_silent=is_silent)
            self._is_on, self._stop = True, threading.Event()
        self._has_thread = not self._card.library.call_in_virtual_time(self._virtual_step)
        if self._has_thread:
            self._box[k.LOCK], self._box[k.TIMER] = self._card.lock.word.ctypes.data, self._timer.ctypes.data
            threads = [("spcm stream", self._run)] + [("spcm helper", self._help)] * (n_cores() > 1)
            self._signals = tuple(WakeSignal() for _ in threads)
            for (name, target), signal in zip(threads, self._signals, strict=True):
                arguments = self._box, self._stop, signal, self._alive
                threading.Thread(target=target, args=arguments, name=name, daemon=True).start()

    def halt(self) -> None:
        """End the supply and drop the programs. The caller stops the card."""
        self._stop.set()
        self._card.library.call_in_virtual_time(None)
        with self._lock:
            box, self._is_on, self._failure, self._prepared = self._box, False, None, None
            box[k.STOP] = 1
            self._wake()
            until_s = time.perf_counter() + 0.1  # it looks for the stop after each part that it renders
            while box[k.IS_FEEDING] and time.perf_counter() < until_s:
                time.sleep(50e-6)

    def prepare(self, program: ToneProgram) -> float:
        """Hand a program to the loop, which renders it until it starts. Returns its playing time (s)."""
        start_s = time.perf_counter()
        stream = self._prepared = self._new_program(program)
        if self._has_thread:  # in virtual time this thread would do the loop's work
            with self._lock:
                self._box[k.PREPARED] = stream.words.ctypes.data
                self._wake()
        self.render_s = time.perf_counter() - start_s
        self._check_failure()
        return stream.playing_s

    def _new_program(self, program: ToneProgram) -> Program:
        stream = stream_program(program, self._rate_hz, self._row_channel, self._block, self._workspaces)
        self._ready.append(self._ready.pop(0))
        stream.words[k.READY_MADE] = self._ready[-1].ctypes.data
        stream.words[k.ROOM] = len(self._ready[-1])
        self._alive.append(stream)
        return stream

    def start(self, command: int) -> None:  # noqa: ARG002 - the card runs already
        """Have the prepared program follow the samples that were handed over."""
        self._check_failure()
        with self._lock:
            program, self._prepared = self._prepared, None
            if program is not None:  # else another thread has made the card safe
                self._box[k.LEAST] = len(self._ring)
                self._queue(program)

    def append(self, program: ToneProgram) -> float:
        """Have the rest of a program follow its beginning, or the silence after it."""
        stream = self._new_program(program)
        self._check_failure()
        with self._lock:
            self._queue(stream)
        return stream.playing_s

    def _queue(self, program: Program) -> None:
        box, n = self._box, int(self._box[k.QUEUED])
        box[k.QUEUE + n % k.N_QUEUE] = program.words.ctypes.data
        box[k.QUEUED] = n + 1
        self._wake()

    def _wake(self) -> None:
        """Let the loop look at once. On a virtual clock its step is due now."""
        for signal in self._signals[:1]:
            set_signal(signal.words)
        if self._is_on and not self._has_thread:
            self._card.library.call_in_virtual_time(self._virtual_step)

    @property
    def n_pauses(self) -> int:
        """Number of moves that came later than planned because the computer was too slow."""
        return self._n_pauses + int(self._box[k.N_PAUSES])

    @property
    def least_ahead_s(self) -> float:
        """Least time by which the last program was written ahead of the card, below 0 if too late."""
        return float(self._box[k.LEAST]) / self._rate_hz

    def finished(self) -> bool:
        """Whether the program has been played to its end."""
        self._check_failure()
        box = self._box
        is_taken = box[k.TAKEN] == box[k.QUEUED]
        return bool(is_taken and box[k.MADE] == box[k.END] <= box[k.FETCHED] - self._on_card)

    def _check_failure(self) -> None:
        """Let a virtual clock's steps be done, and raise the error that ended the stream."""
        if not self._has_thread:  # with a thread, a call could meet the thread's error
            _ = self._card.status
        with self._lock:
            failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    # Both threads keep alive what their loops know the addresses of.

    def _help(
        self, box: NDArray[np.int64], _stop: threading.Event, signal: WakeSignal, _programs: deque[Program]
    ) -> None:
        """The thread that renders one of the two axes, which the loop uses from now on."""
        raise_priority(above=1)
        box[k.HELPER] = signal.words.ctypes.data
        k.assist(box, new_timer(), signal.words)

    def _run(
        self, box: NDArray[np.int64], stop: threading.Event, signal: WakeSignal, _programs: deque[Program]
    ) -> None:
        """The thread that supplies the card."""
        raise_priority(above=2)  # so that the card does not run dry because other threads are busy
        timer, rate_hz, code = self._timer, int(self._rate_hz), 0
        while (pause_s := self._step(box, code)) is not None:
            if pause_s:
                stop.wait(pause_s)
                code = 0
            else:
                code = k.feed(box, rate_hz, timer, signal.words)

    def _virtual_step(self) -> float | None:
        """One step of the thread's work."""
        pause_s = self._step(self._box, 0)
        if pause_s != 0.0:
            return pause_s
        self._box[k.NOW_NS] = round(1e9 * self._card.library.step_time_s())
        code = k.supply(self._box, int(self._rate_hz))
        return self._step(self._box, code) if code < 0 else 1e-9 * code

    def _step(self, box: NDArray[np.int64], code: int) -> float | None:
        """React to a code of the loop in Python.

        Returns:
            Time to wait in seconds, 0 if the loop can go on, None if it is over.
        """
        if not self._lock.acquire(blocking=False):  # the driver is about to halt, or to read a failure
            return 10e-6
        try:
            if not self._is_on or box is not self._box:
                return None
            if code:
                self._recover(code)
            return 0.0
        except LabseqError as failure:
            self._is_on, self._failure = False, failure
            return None
        finally:
            self._lock.release()

    def _ring_is_silent(self) -> bool:
        return bool(self._box[k.WRITTEN] >= self._box[k.SILENT_FROM])

    def _begin(self, *, is_silent: bool) -> None:
        """Fill the card with silence, and start it when it has some. The ring may hold silence already."""
        card, spcm, box = self._card, self._card.spcm, self._box
        card.stop()
        box[k.WRITTEN] = box[k.FETCHED] = box[k.START] = box[k.END] = box[k.MADE] = 0
        box[k.PART] = box[k.RENDERED_AT] = -1
        box[k.SILENT_FROM] = 0 if is_silent else len(self._ring)
        card.define_transfer(self._ring, self._block * FRAME_BYTES)
        if k.supply_silence(box, len(self._ring)):
            raise self._error()
        card.command(spcm.M2CMD_DATA_STARTDMA, "transfer")
        box[k.IS_FILLING] = 1

    def _error(self) -> DeviceError:
        """The error that the library reported to the loop."""
        reason = self._card.clear_error(int(self._box[k.ERROR]))
        return DeviceError(self._card.name, f"supplying the card: {reason}")

    def _recover(self, code: int) -> None:
        """Begin again after the card ran dry or was too fast, with the program if it cannot have begun.

        Raises:
            TransientError: In the middle of a program.
            DeviceError: The card runs, but the library reports an error, or it does not fetch samples.
        """
        box, card = self._box, self._card
        if code == k.STUCK:
            raise card.not_fetched(int(box[k.FETCHED]) * FRAME_BYTES, int(box[k.TO_START]) * FRAME_BYTES)
        if code == k.FAILED:
            error = self._error()
            if box[k.IS_FILLING] or (card.running and not card.ran_dry):
                raise error
            if k.look(box) == k.FAILED:
                raise self._error()
        start, made, end, fetched = (int(box[word]) for word in (k.START, k.MADE, k.END, k.FETCHED))
        is_unfinished = made < end or fetched < end  # silence after what was made may have been fetched
        # only whole blocks are reported as fetched, so a part of the first one may have been played
        may_have_begun = start <= fetched and start < made
        if code == k.LATE or (may_have_begun and is_unfinished):
            played = max(0, min(fetched, made) - start) / (end - start)
            length = format_quantity((end - start) / self._rate_hz, "time")
            share = f"{played:.0%} of a part of {length} was played"
            was_full = made - start >= len(self._ring) - self._ahead - self._on_card
            remedy = (
                f"raise `{'fill' if was_full else 'look_ahead'}`, lower sample_rate, or use `mode: sequence`"
            )
            raise TransientError(
                f"underrun: the card ran out of samples ({share}); {remedy}", self._card.name
            )
        self.n_underruns += 1
        if is_unfinished:
            box[k.TAKEN] -= 1
        self._begin(is_silent=self._ring_is_silent())

    def _whole_blocks(self, n_samples: int) -> int:
        return -(-n_samples // self._block) * self._block
