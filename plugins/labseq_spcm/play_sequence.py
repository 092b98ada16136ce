"""Mode ``sequence``, in which the card loops an idle segment while programs are uploaded.

The rules come from the manual's chapter "Sequence Mode". Steps may be written at any time, and a segment of
the sample memory may be written while the card runs as long as no step in use leads to it.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import DeviceError, LimitError, ToneProgram, TransientError
from labseq_spcm.card import AwgCard, Buffer
from labseq_spcm.keep_warm import KeepWarm, tone_samples
from labseq_spcm.limits import FRAME_BYTES, OUTPUT_FIFO_BYTES, SAMPLE_STEP
from labseq_spcm.play_mode import PlayMode
from labseq_spcm.replay_fifo import CHUNK, InterleavedRenderer
from labseq_spcm.settings import SpcmSettings
from labseq_spcm.stream import silent_joints

IDLE_SEGMENT: Final = 0
SILENT_SAMPLES: Final = 1024
"""Length of the idle segment. A program begins at its end, 1.6 us later at most at 624 MS/s."""
WARM_SAMPLES: Final = 16384
"""The same with keep-warm tones, whose frequencies are multiples of the sample rate over this length."""
SEGMENT_SAMPLES: Final = 1 << 20
"""Least room for samples in a segment, in a memory that can be divided accordingly."""
BEGINNING_S: Final = 1e-3
"""A program is cut after that time."""
POLL_S: Final = 20e-6
"""Time between two reads of the status while samples are transferred."""


@dataclass(frozen=True, slots=True)
class Part:
    """A part of a program, in a segment of its own.

    Attributes:
        number: Counted from the beginning of the program, including appended parts.
        start: Its first sample, within the parts that are uploaded together.
        stop: The sample after its last one.
        first: Number of the first part that is linked together with it.
        is_last: Whether it is the last part that is linked then.
    """

    number: int
    start: int
    stop: int
    first: int
    is_last: bool


class SequenceReplay(PlayMode):
    """Uploads parts of a program into segments, and links the steps that play them.

    Part i of a program is in segment i + 1. Two steps belong to it. The first plays it, the second then waits
    by playing the idle segment until it is led elsewhere. An appended part is linked from both steps before
    it, so it follows without a gap if it comes in time, and else after some silence. Programs use the two
    halves of the step memory in turn, because the card still waits in the last step of the program before.

    Only parts that begin and end with silence are linked one by one, so tones that are on never wait for
    the computer, and their phases run on through a program.

    Args:
        card: The open card.
        settings: Settings of the driver.
        sample_rate_hz: The rate that the card's clock really makes.
        keep_warm: Tones of the idle segment, or None for silence.

    Attributes:
        delay_s: From ``start``, or from the edge, to the first sample at the output, at most.
        n_pauses: How often the card had to wait for the next part in the middle of a program.

    Raises:
        DeviceError: The card has no sequence mode.
    """

    beginning_s = BEGINNING_S

    def __init__(
        self, card: AwgCard, settings: SpcmSettings, sample_rate_hz: float, keep_warm: KeepWarm | None = None
    ) -> None:
        super().__init__(card)
        spcm = card.spcm
        if not card.read(spcm.SPC_PCIFEATURES) & spcm.SPCM_FEAT_SEQUENCE:
            text = f"the {card.product} has no sequence mode (SPCM_FEAT_SEQUENCE)"
            raise DeviceError(card.name, f"{text}; use `mode: replay`, or update the card's firmware")
        self._row_channel, self._rate_hz = settings.row_index, sample_rate_hz
        self._waits_for_edge = settings.trigger == "external"
        n_idle = SILENT_SAMPLES if keep_warm is None else WARM_SAMPLES
        self.delay_s = (n_idle + OUTPUT_FIFO_BYTES // 2 // FRAME_BYTES) / sample_rate_hz
        self.n_pauses = 0
        self._is_on = False
        self._divide_memory()
        self._buffers = (Buffer(), Buffer())
        for buffer in self._buffers:
            buffer.reserve(2 * CHUNK)[:] = 0  # so that the memory is there
        idle = Buffer().reserve(n_idle)
        idle[:] = 0
        if keep_warm is not None:
            idle[:] = tone_samples(keep_warm, sample_rate_hz, self._row_channel, n_idle)
        self._send(IDLE_SEGMENT, idle)
        self._card.finish_upload(idle.nbytes, POLL_S)

    def _divide_memory(self) -> None:
        """Set the mode, and divide the memory into as many segments as the steps allow."""
        card, spcm = self._card, self._card.spcm
        memory_samples = card.read(spcm.SPC_PCIMEMSIZE) // FRAME_BYTES
        self._n_steps = card.read(spcm.SPC_SEQMODE_AVAILMAXSTEPS)
        most = min(self._n_steps // 4, card.read(spcm.SPC_SEQMODE_AVAILMAXSEGMENT))
        self._n_segments = max(2, min(most, memory_samples // SEGMENT_SAMPLES))
        self._room = memory_samples // self._n_segments
        card.set(spcm.SPC_CARDMODE, spcm.SPC_REP_STD_SEQUENCE, "card mode")
        card.set(spcm.SPC_SEQMODE_MAXSEGMENTS, self._n_segments, "number of segments")
        card.write_setup()
        # the next program uses the other half of the steps, from 0 on
        self._waiting = self._end = self._n_steps // 2
        self._first = self._n_parts = 0

    def idle(self) -> None:
        """Start the loop over the idle segment. No effect if it plays."""
        if self._is_on:
            return
        card, spcm = self._card, self._card.spcm
        self._write_step(self._waiting, IDLE_SEGMENT, self._waiting)
        card.set(spcm.SPC_SEQMODE_STARTSTEP, self._waiting, "start step")
        # the detection of edges stays disabled until a program waits for one
        card.command(spcm.M2CMD_CARD_START | spcm.M2CMD_CARD_FORCETRIGGER, "start")
        self._is_on = True

    def halt(self) -> None:
        """Link nothing more. The caller stops the card."""
        self._is_on = False

    def check_memory(self, frames: NDArray[np.int16]) -> None:
        """Send samples to a segment."""
        self._send(IDLE_SEGMENT + 1, frames[: self._room])
        self._card.finish_upload(frames.nbytes, POLL_S)

    def prepare(self, program: ToneProgram) -> float:
        """Render and upload a program or its beginning, and return its playing time in seconds."""
        self._first = 0 if self._waiting >= self._n_steps // 2 else self._n_steps // 2
        self._n_parts = 0
        renderer = InterleavedRenderer(program, self._rate_hz, self._row_channel)
        n_samples = renderer.n_samples
        self._upload(renderer, self._split([n_samples], self._part_size(n_samples, 1)))
        return n_samples / self._rate_hz

    def start(self, command: int) -> None:  # noqa: ARG002 - the card runs already
        """Lead the idle loop to the prepared program, at once or at the next edge."""
        if not self._is_on:  # another thread has made the card safe
            return
        spcm = self._card.spcm
        condition = spcm.SPCSEQ_ENDLOOPONTRIG if self._waits_for_edge else spcm.SPCSEQ_ENDLOOPALWAYS
        self._write_step(self._waiting, IDLE_SEGMENT, self._first, condition)
        if self._waits_for_edge:
            self._card.command(spcm.M2CMD_CARD_ENABLETRIGGER, "enabling the trigger")

    def append(self, program: ToneProgram) -> float:
        """Have the rest of a program follow, each part when it has arrived. Returns its playing time (s)."""
        renderer = InterleavedRenderer(program, self._rate_hz, self._row_channel)
        n_samples = renderer.n_samples
        size = self._part_size(n_samples, 2)  # a batch may fill its last segment in part only
        ends = [0]
        for joint in silent_joints(program, renderer.first_sample).tolist():
            end = math.ceil(joint / SAMPLE_STEP) * SAMPLE_STEP
            if end - ends[-1] >= size <= n_samples - end:
                ends.append(end)
        self._upload(renderer, self._split([*ends[1:], n_samples], size))
        return n_samples / self._rate_hz

    @property
    def triggered(self) -> bool:
        """Whether the program has begun."""
        return self._card.read(self._card.spcm.SPC_SEQMODE_STATUS) != self._waiting

    def finished(self) -> bool:
        """Whether the card waits after the last part."""
        card, spcm = self._card, self._card.spcm
        if not card.running:
            text = "the card was stopped in the middle of a program; close what else uses it"
            raise TransientError(text, card.name)
        if card.read(spcm.SPC_SEQMODE_STATUS) != self._end:
            return False
        if self._waits_for_edge:  # an edge too many is not kept for the next program
            card.command(spcm.M2CMD_CARD_DISABLETRIGGER, "disabling the trigger")
        self._waiting = self._end
        return True

    # Parts of a program

    def _part_size(self, n_samples: int, room: int) -> int:
        """Samples of a part, so that a program of this length finds room for ``room`` times as many parts.

        Raises:
            LimitError: There is none.
        """
        n_free = (self._n_segments - 1 - self._n_parts) // room
        least = math.ceil(n_samples / max(1, n_free) / SAMPLE_STEP) * SAMPLE_STEP
        if least > self._room:
            quantity = f"{self._card.name}: length of the program"
            length, most = (f"{n / self._rate_hz:.4g} s" for n in (n_samples, n_free * self._room))
            hint = "use `mode: fifo`, or a lower sample_rate"
            raise LimitError(quantity, length, f"{most} (the card's memory)", hint)
        return max(min(CHUNK, self._room), least)

    def _split(self, ends: Sequence[int], size: int) -> Iterator[Part]:
        """Split samples that are linked at once, with joints at ``ends``, into parts of about equal size."""
        for start, end in itertools.pairwise([0, *ends]):
            length, first = end - start, self._n_parts
            n = max(1, round(length / size), math.ceil(length / self._room))
            starts = [start + math.ceil(length * i / n / SAMPLE_STEP) * SAMPLE_STEP for i in range(n)]
            for part_start, stop in itertools.pairwise([*starts, end]):
                yield Part(self._n_parts, part_start, stop, first, stop == end)
                self._n_parts += 1

    def _upload(self, renderer: InterleavedRenderer, parts: Iterable[Part]) -> None:
        """Upload parts of a program, each while the next one is being rendered, and link them."""
        self.render_s, on_the_way = 0.0, None
        for part in parts:
            frames = self._buffers[part.number % 2].reserve(part.stop - part.start)
            start_s = time.perf_counter()
            renderer.write(part.start, frames)
            self.render_s += time.perf_counter() - start_s
            if on_the_way is None:
                self._send(part.number + 1, frames)
            else:
                self._arrive(on_the_way)
                self._send(part.number + 1, frames)  # before the steps are written, to keep the bus busy
                self._link(on_the_way)
            on_the_way = part
        if on_the_way is not None:
            self._arrive(on_the_way)
            self._link(on_the_way)

    def _send(self, segment: int, frames: NDArray[np.int16]) -> None:
        """Begin the transfer of samples to a segment."""
        card, spcm = self._card, self._card.spcm
        card.set(spcm.SPC_SEQMODE_WRITESEGMENT, segment, "segment to write")
        card.set(spcm.SPC_SEQMODE_SEGMENTSIZE, len(frames), "size of the segment")
        card.begin_upload(frames)

    def _arrive(self, part: Part) -> None:
        """Wait until a part has arrived."""
        self._card.finish_upload(FRAME_BYTES * (part.stop - part.start), POLL_S)
        if not self._is_on:
            raise DeviceError(self._card.name, "stopped by safe_state() while a program was uploaded")

    def _link(self, part: Part) -> None:
        """Write the steps of a part that has arrived. The last one before a joint is linked."""
        plays, waits = self._first + 2 * part.number, self._first + 2 * part.number + 1
        if not part.is_last:
            self._write_step(plays, part.number + 1, plays + 2)
            return
        self._write_step(waits, IDLE_SEGMENT, waits)
        self._write_step(plays, part.number + 1, waits)
        if part.first:  # to part 0 the idle step leads, in `start`
            self._follow(part.first)
        self._end = waits

    def _follow(self, part: int) -> None:
        """Let a part follow the one before, which may play, be over, or be about to end."""
        plays = self._first + 2 * part
        self.n_pauses += self._card.read(self._card.spcm.SPC_SEQMODE_STATUS) == plays - 1
        self._write_step(plays - 2, part, plays)
        self._write_step(plays - 1, IDLE_SEGMENT, plays)

    def _write_step(self, step: int, segment: int, next_step: int, condition: int = 0) -> None:
        """Write a step that plays a segment once, and then goes on."""
        word = (condition | 1) << 32 | next_step << 16 | segment
        self._card.set(self._card.spcm.SPC_SEQMODE_STEPMEM0 + step, word, f"step {step}")
