"""From tones to the samples that an AWG plays."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from enum import IntEnum
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from labseq.errors import LimitError
from labseq.model import AxisTones, ToneProgram, Waveform
from labseq.motion.render_comb import find_comb

if TYPE_CHECKING:
    from labseq.kernels.render_types import Axis

FULL_SCALE: Final = 32767
"""Sample at which the amplitudes of an axis add up to 1."""

N_CHANNELS: Final = 2
"""Channel 0 plays the row tones, channel 1 the column tones."""

N_WORKERS: Final = 2
"""Threads that can render at the same time."""

ROUNDING: Final = 1e-9
"""By how much a sum of amplitudes may exceed full scale."""


class RenderPath(IntEnum):
    """How the tones of an axis are rendered in a segment.

    Attributes:
        SILENT: There are none, or all have amplitude 0.
        COMB: They start on the teeth of one comb, in at most three groups that share a
            chirp: left-moving, right-moving, parked. The cost per sample does not grow
            with their number.
        BLENDED: The same, but amplitudes that change by different factors, or tones a
            little beside their teeth, are followed by a cubic in time: four tables per
            group are blended. Worth it if all cubics together err by less than 1e-7 of
            full scale.
        DIRECT: Everything else: each tone by itself.
    """

    SILENT = 0
    COMB = 1
    BLENDED = 2
    DIRECT = 3


class Renderer:
    """Renders any stretch of a tone program into buffers of the caller.

    Sample n is what the program says at the time n / fs. Segment i owns the samples from
    round(t_i fs) to round(t_(i+1) fs), where t_i is the sum of the durations before it: a
    sample up to half a sample time outside of its segment follows the segment's own
    formulas there. So a joint causes no error of phase wherever it falls between two
    samples. A squared amplitude below 0 counts as 0.

    Each sample is the sum of its tones, 32767 for amplitudes that add up to 1, worked
    out to better than 0.01 and rounded to the nearest integer.

    Attributes:
        sample_rate_hz: Sample rate fs, in Hz.
        n_samples: Samples per channel.
        first_sample: int64 (n_segments + 1,), first sample of each segment, and the end.
        path: int8 (2, n_segments), a :class:`RenderPath` for each channel and segment.
    """

    def __init__(self, program: ToneProgram, sample_rate_hz: float = 625e6) -> None:
        """Look at a program and choose how to render each of its segments.

        Args:
            program: The tone program.
            sample_rate_hz: Sample rate; fastest at :func:`comb_sample_rate`.

        Raises:
            LimitError: A value is not finite, a duration or an amplitude is negative, a
                sum of amplitudes exceeds full scale, or a frequency half the sample rate.
        """
        from labseq.kernels.render_types import room

        _check(program, sample_rate_hz)
        starts = np.concatenate([[0.0], np.cumsum(program.duration_s)]) * sample_rate_hz
        self.sample_rate_hz = float(sample_rate_hz)
        self.first_sample = np.rint(starts).astype(np.int64)
        self.n_samples = int(self.first_sample[-1])
        delta = (self.first_sample - starts)[:-1].copy()
        length = program.duration_s * sample_rate_hz
        for array in (self.first_sample, delta, length):
            array.flags.writeable = False
        axes: list[Axis] = [
            _prepare(axis, program.course, self.first_sample, delta, length, self.sample_rate_hz)
            for axis in (program.row, program.column)
        ]
        self._axes = axes
        self._rooms = [[room(axis[-1]) for axis in axes] for _ in range(N_WORKERS)]
        self.path = np.stack([axis[3] for axis in axes])
        self.path.flags.writeable = False

    def write(self, channel: int, start: int, out: NDArray[np.int16], worker: int = 0) -> None:
        """Render samples ``start`` to ``start + len(out)`` of a channel; after the end there is silence.

        Allocates nothing and holds no lock of Python. Two threads can render at the same
        time, each as a worker of its own. The samples depend neither on where a stretch
        starts nor on the worker.

        Args:
            channel: 0 for the row tones, 1 for the column tones.
            start: First sample, counted from the start of the program.
            out: Result, int16 (n,), contiguous.
            worker: 0 or 1: which room to work in.
        """
        from labseq.kernels.render_axis import render

        render(self._axes[channel], start, out, self._rooms[worker][channel])


def render(program: ToneProgram, sample_rate_hz: float = 625e6) -> Waveform:
    """Render a whole tone program; see :class:`labseq.motion.Renderer` for what a sample is.

    Args:
        program: The tone program.
        sample_rate_hz: Sample rate; fastest at :func:`labseq.motion.comb_sample_rate`.

    Returns:
        int16 (2, n): channel 0 plays the row tones, channel 1 the column tones.

    Raises:
        LimitError: The program is not playable: see :class:`labseq.motion.Renderer`.

    Example:
        >>> from labseq import Plan, tone_program
        >>> program = tone_program(Plan.from_batches([([(0, 0)], [(0, 3)])]))
        >>> render(program, 250e6).samples.shape
        (2, 180904)
    """
    renderer = Renderer(program, sample_rate_hz)
    samples = np.empty((N_CHANNELS, renderer.n_samples), np.int16)
    with ThreadPoolExecutor(1) as other:
        _write_both(renderer, 0, samples, other)
    samples.flags.writeable = False
    return Waveform(samples, renderer.sample_rate_hz)


def render_chunks(
    program: ToneProgram,
    sample_rate_hz: float = 625e6,
    chunk_samples: int = 1 << 20,
    buffers: tuple[NDArray[np.int16], ...] = (),
) -> Iterator[NDArray[np.int16]]:
    """Render a tone program chunk by chunk, one thread per channel.

    Args:
        program: The tone program.
        sample_rate_hz: Sample rate.
        chunk_samples: Samples of a chunk, per channel; the last chunk ends in silence.
        buffers: int16 (2, chunk_samples) each, C-contiguous, used in turn; two of its own by default.

    Yields:
        int16 (2, chunk_samples), one of the buffers.

    Raises:
        LimitError: The program is not playable, or chunks have no samples.
    """
    if chunk_samples < 1:
        raise LimitError("the number of samples in a chunk", chunk_samples, "at least 1")
    renderer = Renderer(program, sample_rate_hz)
    shape = (N_CHANNELS, chunk_samples)
    buffers = buffers or (np.empty(shape, np.int16), np.empty(shape, np.int16))
    with ThreadPoolExecutor(1) as other:
        for n, start in enumerate(range(0, renderer.n_samples, chunk_samples)):
            out = buffers[n % len(buffers)]
            _write_both(renderer, start, out, other)
            yield out


def _write_both(renderer: Renderer, start: int, out: NDArray[np.int16], other: ThreadPoolExecutor) -> None:
    """Let two threads render one half of a stretch each, whichever axis has more tones."""
    half = out.shape[1] // 2
    later = other.submit(_write_half, renderer, start + half, out[:, half:], 1)
    _write_half(renderer, start, out[:, :half], 0)
    later.result()


def _write_half(renderer: Renderer, start: int, out: NDArray[np.int16], worker: int) -> None:
    for channel in range(N_CHANNELS):
        renderer.write(channel, start, out[channel], worker)


def _prepare(
    axis: AxisTones,
    course: NDArray[np.int8],
    first_sample: NDArray[np.int64],
    delta: NDArray[np.float64],
    length: NDArray[np.float64],
    sample_rate_hz: float,
) -> Axis:
    """Bring an axis into the kernels' units, and choose the path of each segment."""
    from labseq.kernels.render_paths import choose_paths

    comb = find_comb(axis, sample_rate_hz)
    tones = np.stack(
        [
            axis.start_hz / sample_rate_hz,
            axis.end_hz / sample_rate_hz,
            axis.start_amplitude,
            axis.end_amplitude,
            axis.phase_rad / (2 * np.pi),
        ]
    )
    path, group = np.empty(len(length), np.int8), np.zeros(tones.shape[1], np.int8)
    tooth = np.zeros(tones.shape[1], np.int32)
    choose_paths(
        tones, axis.offsets, length, course, comb.origin, comb.step, comb.n_teeth, path, tooth, group
    )
    for array in (tones, path, tooth, group):
        array.flags.writeable = False
    return (
        tones, axis.offsets, course, path, tooth, group, comb.teeth, first_sample, delta, length,
        comb.step, comb.block,
    )  # fmt: skip


def _check(program: ToneProgram, sample_rate_hz: float) -> None:
    """Refuse what cannot be played.

    Raises:
        LimitError: See :class:`Renderer`.
    """
    if not 0 < sample_rate_hz < np.inf:
        raise LimitError("the sample rate", f"{sample_rate_hz} Hz", "more than 0 and finite")
    wrong = np.flatnonzero(~((program.duration_s >= 0) & (program.duration_s < np.inf)))
    if len(wrong):
        which = f"the duration of segment {wrong[0]} in batch {program.batch[wrong[0]]}"
        raise LimitError(which, f"{program.duration_s[wrong[0]]} s", "0 or more and finite")
    for name, axis in (("row", program.row), ("column", program.column)):
        for field, most in (
            ("start_hz", sample_rate_hz / 2),
            ("end_hz", sample_rate_hz / 2),
            ("start_amplitude", 1.0 + ROUNDING),
            ("end_amplitude", 1.0 + ROUNDING),
            ("phase_rad", np.inf),
        ):
            values = getattr(axis, field)
            least = -np.inf if field == "phase_rad" else 0.0
            fine = (values >= least) & (values <= most) & np.isfinite(values)
            if not fine.all():
                tone = int(fine.argmin())
                which = f"{field} of a {name} tone in batch {_batch_of(program, axis, tone)}"
                raise LimitError(which, values[tone], f"{least:.9g} to {most:.9g}")
        _check_sums(program, axis, name)


def _check_sums(program: ToneProgram, axis: AxisTones, name: str) -> None:
    for values in (axis.start_amplitude, axis.end_amplitude):
        sums = np.diff(np.concatenate([[0.0], np.cumsum(values)])[axis.offsets])
        if len(sums) and sums.max() > 1.0 + ROUNDING:
            worst = int(sums.argmax())
            which = f"the sum of the amplitudes of the {name} tones in batch {program.batch[worst]}"
            raise LimitError(which, f"{sums[worst]:.9g}", "1, full scale")


def _batch_of(program: ToneProgram, axis: AxisTones, tone: int) -> int:
    segment = int(np.searchsorted(axis.offsets, tone, "right")) - 1
    return int(program.batch[segment])
