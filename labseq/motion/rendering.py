"""Renders the samples of a tone program.

A :class:`Renderer` checks a program. Its kernels do the work:

- ``comb_kernels`` find the spacing of the tones of an axis;
- ``render_group_kernels`` choose how each segment is rendered, and which of its tones share a chirp;
- ``render_comb_kernels`` render these groups; ``render_direct_kernels`` render everything else, tone by tone;
- ``render_kernels`` hold the shared parts, which are arrays of axes and workspaces, envelopes and rounding.

``render_reference`` defines the samples in plain numpy, for tests.
"""

from __future__ import annotations

import importlib
import math
import weakref
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import IntEnum
from fractions import Fraction
from functools import lru_cache
from itertools import count
from typing import TYPE_CHECKING, Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from labseq.errors import LimitError
from labseq.kernels.kernel import c_address
from labseq.model import SiteGrid, ToneProgram, Waveform

if TYPE_CHECKING:
    from labseq.motion.render_kernels import Axis, Workspace


MIN_BLOCK: Final = 1536
"""Smallest size of a block, in samples. Tones half-way between sites repeat after four periods of 390."""

TEETH: Final = 8
"""Number of teeth whose tables are made at a time, so that the next program can reuse them."""

MIN_PERIOD: Final = 128
"""Shortest period of a table, in samples."""

MIN_REUSED: Final = 1 << 19
MAX_REUSED: Final = 1 << 26
"""Fewest and most samples of both channels, in waveforms whose memory :func:`render` reuses (1 to 128 MB)."""

_NUMBERS: Final = count()


_FREE_SAMPLES: Final[deque[NDArray[np.int16]]] = deque(maxlen=2)


@dataclass(frozen=True, slots=True, eq=False)
class Comb:
    """The comb of an axis at a sample rate.

    Attributes:
        first: Number of the first tooth. Tooth 0 is 0 Hz.
        step: Spacing of the teeth, in cycles per sample. ``step * period`` is whole.
        teeth: float64 (2 n_teeth, period), cosine and sine of each tooth. Empty without a comb.
        block: Samples after which parked tones may repeat, a multiple of the period.
    """

    first: int
    step: float
    teeth: NDArray[np.float64]
    block: int

    @property
    def n_teeth(self) -> int:
        """Number of teeth."""
        return len(self.teeth) // 2


NO_COMB: Final = Comb(0, 1.0, np.empty((0, 0)), 1024)


def comb_sample_rate(
    grid: SiteGrid, max_hz: float = 625e6, min_hz: float = 50e6, clock_step_hz: int = 8
) -> float:
    """Find the fastest sample rate at which the sites of both axes make a comb of whole samples.

    The sum of tones on a comb of spacing D repeats after fs / D samples. Where that is
    a whole number, on both axes, :func:`labseq.render` is at its fastest.

    Args:
        grid: Its row and column frequencies, equally spaced on each axis.
        max_hz: Fastest sample rate allowed.
        min_hz: Slowest sample rate allowed.
        clock_step_hz: Sample rates of the AWG are multiples of this. It is 8 Hz for the Spectrum M4i.66xx.

    Returns:
        The rate in Hz, a whole number of clock steps. If the spacing is not a round number
        the teeth miss it by half a clock step divided by fs / D at most, which rendering
        takes into account.

    Raises:
        LimitError: No rate in the range suits both axes.

    Example:
        >>> comb_sample_rate(SiteGrid())
        624000000.0
    """
    steps = [_spacing(grid.row_frequency_hz), _spacing(grid.column_frequency_hz)]
    steps = [step for step in steps if step > 0.0]
    if not steps:
        return max_hz // clock_step_hz * clock_step_hz
    first = max(steps)
    for period in range(int(max_hz / first), int(min_hz / first), -1):
        rate_hz = round(period * first / clock_step_hz) * clock_step_hz
        off = [abs(rate_hz / step - round(rate_hz / step)) * step for step in steps]
        if rate_hz <= max_hz and max(off) <= clock_step_hz:
            return float(rate_hz)
    raise LimitError(
        "the spacing of row and column tones",
        " and ".join(f"{step:.9g} Hz" for step in steps),
        f"a divisor of one sample rate from {min_hz:.9g} to {max_hz:.9g} Hz for both",
        "make them equal, or multiples of one another",
    )


def find_comb(spacing: float, lowest_hz: float, span_hz: float, sample_rate_hz: float) -> Comb:
    """The comb that contains most tones of an axis, if one matches the sample rate.

    Args:
        spacing: Spacing of which most gaps between the tones are multiples, in Hz. See ``common_spacing``.
        lowest_hz: Frequency of the first tone.
        span_hz: Distance from the first tone to the last.
        sample_rate_hz: Sample rate.
    """
    from labseq.motion.comb_kernels import MAX_TEETH, TOLERANCE_HZ

    if spacing < 0.0:
        return NO_COMB
    origin = lowest_hz / sample_rate_hz
    if spacing == 0.0:  # a single tone may use a tooth of the 0 Hz comb, and so repeat itself
        spacing = sample_rate_hz / _ratio(origin).denominator
    ratio = _ratio(spacing / sample_rate_hz)
    periods = math.ceil(MIN_PERIOD / ratio.denominator)
    period, step = periods * ratio.denominator, float(ratio)
    span = span_hz / sample_rate_hz
    near = abs(step * sample_rate_hz - spacing) <= TOLERANCE_HZ
    if step <= 0.0 or not near or round(span / step) >= MAX_TEETH:
        return NO_COMB
    first = math.floor(origin / step) // TEETH * TEETH
    n_teeth = math.ceil((math.floor((origin + span) / step) + 2 - first) / TEETH) * TEETH
    teeth = _teeth(periods * ratio.numerator, period, first, n_teeth)
    return Comb(first, step, teeth, period * math.ceil(MIN_BLOCK / period))


@lru_cache(maxsize=64)
def _ratio(value: float) -> Fraction:
    """The nearest fraction of small numbers, which takes 0.04 ms to find."""
    return Fraction(value).limit_denominator(4096)  # tables of a comb with a longer period are not worth it


@lru_cache(maxsize=8)
def _teeth(numerator: int, period: int, first: int, n_teeth: int) -> NDArray[np.float64]:
    """The array :attr:`Comb.teeth`, cached for the next program."""
    from labseq.motion.comb_kernels import fill_teeth

    angles = 2 * np.pi / period * np.arange(period)
    teeth = np.empty((2 * n_teeth, period))
    fill_teeth(np.cos(angles), np.sin(angles), numerator, first, teeth)
    teeth.flags.writeable = False
    return teeth


def _spacing(site_hz: NDArray[np.float64]) -> float:
    """Mean spacing of the sites' frequencies, or 0 for a single site."""
    if len(site_hz) < 2:
        return 0.0
    return float(site_hz[-1] - site_hz[0]) / (len(site_hz) - 1)


FULL_SCALE: Final = 32767
"""Sample at which the amplitudes of an axis add up to 1."""

N_CHANNELS: Final = 2
"""Channel 0 plays the row tones, channel 1 the column tones."""

MAX_SAMPLES: Final = 2**53
"""Largest number of samples that float64 counts exactly."""

MAX_WORKSPACES: Final = 8
"""Number of workspaces kept for rendering threads, up to 9 MB each."""


def warm_rendering() -> None:
    """Compile the kernels of rendering, or load them from the cache, for drivers that play samples."""
    for kernels in ("comb_kernels", "render_direct_kernels"):  # the second imports the others
        importlib.import_module(f"labseq.motion.{kernels}")


class RenderPath(IntEnum):
    """How the tones of an axis are rendered in a segment.

    Attributes:
        SILENT: There are no tones, or all have amplitude 0.
        COMB: At most four groups share a chirp each, such as left-moving, right-moving and parked tones. All
            groups are on combs of one spacing. Some parked tones may be ramped together. The cost per sample
            does not grow with the number of tones.
        BLENDED: The same, but cubics in time follow amplitudes that change by different factors, or tones a
            little off their teeth, by blending four tables per group. Chosen if all cubics together err by
            less than 1e-7 of full scale, and groups have more than four tones on average.
        DIRECT: Everything else, each tone by itself.
    """

    SILENT = 0
    COMB = 1
    BLENDED = 2
    DIRECT = 3


class Renderer:
    """Renders any part of a tone program into the caller's buffers.

    Sample n is the value of the program at the time n / fs. Segment i owns the samples from round(t_i fs) to
    round(t_(i+1) fs), where t_i is the sum of the durations before it. A sample up to half a sample time
    outside its segment still follows the segment's formulas. So a joint causes no phase error wherever it
    falls between two samples. A squared amplitude below 0 counts as 0.

    Each sample is the sum of its tones, 32767 for amplitudes that add up to 1, computed to better than 0.01
    and rounded to the nearest integer.

    Attributes:
        sample_rate_hz: Sample rate fs, in Hz.
        n_samples: Samples per channel.
        first_sample: int64 (n_segments + 1,), first sample of each segment, and the end.
        path: int8 (2, n_segments), a :class:`RenderPath` for each channel and segment.
    """

    def __init__(self, program: ToneProgram, sample_rate_hz: float = 625e6) -> None:
        """Analyse a program and choose how to render each of its segments.

        Args:
            program: The tone program.
            sample_rate_hz: Sample rate. Rendering is fastest at :func:`comb_sample_rate`.

        Raises:
            LimitError: A value is not finite, a duration or an amplitude is negative, a
                sum of amplitudes exceeds full scale, a frequency half the sample rate, or the
                samples can no longer be counted.
        """
        if not 0 < sample_rate_hz < np.inf:
            raise LimitError("the sample rate", f"{sample_rate_hz} Hz", "more than 0 and finite")
        from labseq.motion.render_kernels import place_segments

        n = len(program.duration_s)
        self.sample_rate_hz = float(sample_rate_hz)
        self.first_sample, delta, length = np.empty(n + 1, np.int64), np.empty(n), np.empty(n)
        times = self.first_sample, delta, length
        if not place_segments(program.duration_s, self.sample_rate_hz, MAX_SAMPLES, *times):
            _refuse_durations(program, sample_rate_hz)
        self.n_samples = int(self.first_sample[-1])
        for array in (self.first_sample, delta, length):
            array.flags.writeable = False
        axes = [_prepare(program, channel, times, self.sample_rate_hz) for channel in range(N_CHANNELS)]
        self._words, self._arrays = zip(*axes, strict=True)
        self.path = np.stack([arrays.path for arrays in self._arrays])
        self.path.flags.writeable = False

    def write(self, channel: int, start: int, out: NDArray[np.int16]) -> None:
        """Render samples ``start`` to ``start + len(out)`` of a channel, with 0 beyond the end.

        Holds no lock of Python, and any number of threads can render at the same time.
        The samples do not depend on where a stretch starts.

        Args:
            channel: 0 for the row tones, 1 for the column tones.
            start: First sample, counted from the start of the program.
            out: Result, int16 (n,), contiguous.
        """
        from labseq.motion.render_direct_kernels import render_at
        from labseq.motion.render_kernels import BLOCK, N_OUT, Workspace

        block = int(self._words[channel][BLOCK])
        free = _free_workspaces(block)
        try:
            workspace = free.pop()
        except IndexError:
            workspace = Workspace(block)
        words = np.concatenate([self._words[channel], workspace.words])
        words[N_OUT] = len(out)
        render_at(words.ctypes.data, start, out.ctypes.data)
        free.append(workspace)

    def words(self, workspaces: dict[tuple[int, int], Workspace]) -> NDArray[np.int64]:
        """The program for a kernel that calls the function at :func:`render_address`, int64 (2, N_WORDS).

        Args:
            workspaces: Workspaces of the rendering thread, by channel and size of block. Missing ones are
                added. They and the renderer must live as long as the kernel renders.
        """
        from labseq.motion.render_kernels import BLOCK, Workspace

        rows: list[NDArray[np.int64]] = []
        for channel, words in enumerate(self._words):
            key = channel, int(words[BLOCK])
            if key not in workspaces:
                workspaces[key] = Workspace(key[1])
            rows.append(np.concatenate([words, workspaces[key].words]))
        return np.array(rows)


def render_address() -> int:
    """Address of a C function that renders a part of an axis, with three arguments, all int64.

    The arguments are the address of a row of :meth:`Renderer.words`, whose first word is the number of
    samples, then the first sample, and the address of the int16 result. It takes no lock of Python.
    """
    from labseq.motion.render_direct_kernels import render_for_c

    return c_address(render_for_c)


@lru_cache(maxsize=4)
def _free_workspaces(block: int) -> deque[Workspace]:  # noqa: ARG001 - the key of the cache
    """Unused workspaces for blocks of ``block`` samples. New memory would cost a millisecond."""
    return deque(maxlen=MAX_WORKSPACES)


def render(program: ToneProgram, sample_rate_hz: float = 625e6) -> Waveform:
    """Render a whole tone program to samples as :class:`labseq.motion.Renderer` defines them.

    Memory of up to two unused waveforms is kept for the next ones, up to 128 MB each, because rendering into
    new memory takes up to twice as long.

    Args:
        program: The tone program.
        sample_rate_hz: Sample rate. Rendering is fastest at :func:`labseq.motion.comb_sample_rate`.

    Returns:
        int16 (2, n). Channel 0 plays the row tones, channel 1 the column tones.

    Raises:
        LimitError: The program is not playable. See :class:`labseq.motion.Renderer`.

    Example:
        >>> from labseq import Plan, tone_program
        >>> program = tone_program(Plan.from_batches([([(0, 0)], [(0, 3)])]))
        >>> render(program, 250e6).samples.shape
        (2, 55904)
    """
    renderer = Renderer(program, sample_rate_hz)
    samples = _new_samples(N_CHANNELS * renderer.n_samples).reshape(N_CHANNELS, -1)
    half = renderer.n_samples // 2
    with ThreadPoolExecutor(1) as other:
        later = other.submit(_write_channels, renderer, half, samples[:, half:])
        _write_channels(renderer, 0, samples[:, :half])
        later.result()
    samples.flags.writeable = False
    return Waveform(samples, renderer.sample_rate_hz)


def _new_samples(size: int) -> NDArray[np.int16]:
    """int16 (size,), in memory that no waveform uses any longer if possible."""
    if not MIN_REUSED <= size <= MAX_REUSED:
        return np.empty(size, np.int16)
    try:
        block = _FREE_SAMPLES.pop()
    except IndexError:
        block = np.empty(0, np.int16)
    if len(block) < size:
        block = np.empty(1 << (size - 1).bit_length(), np.int16)
    samples = np.frombuffer(block.data, np.int16, size)
    all_views = samples.base
    assert isinstance(all_views, memoryview)  # it lives as long as any part of these samples
    weakref.finalize(all_views, _FREE_SAMPLES.append, block).atexit = False
    return samples


def _write_channels(renderer: Renderer, start: int, out: NDArray[np.int16]) -> None:
    for channel in range(N_CHANNELS):
        renderer.write(channel, start, out[channel])


def _prepare(
    program: ToneProgram,
    channel: int,
    times: tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]],
    sample_rate_hz: float,
) -> tuple[NDArray[np.int64], Axis]:
    """Convert an axis to the kernels' units, and choose how each segment is rendered.

    Returns:
        int64 (WIDTH,), words as in :mod:`labseq.motion.render_kernels`, and the arrays at its addresses.

    Raises:
        LimitError: See :class:`Renderer`.
    """
    from labseq.motion.comb_kernels import find_spacing
    from labseq.motion.render_group_kernels import choose_paths
    from labseq.motion.render_kernels import FINE, N_FIELDS, N_WAVE, Axis, take_tones

    axis, n_segments = (program.row, program.column)[channel], program.n_segments
    start_hz, end_hz, n_tones = axis.start_hz, axis.end_hz, len(axis.start_hz)
    amplitudes, offsets = (axis.start_amplitude, axis.end_amplitude), axis.offsets
    tones, comb_hz = np.empty((N_FIELDS, n_tones)), np.zeros(3)
    fault, index = take_tones(start_hz, end_hz, *amplitudes, axis.phase_rad, offsets, sample_rate_hz, tones)
    if fault != FINE:
        _refuse(fault, index, program, channel, sample_rate_hz)
    find_spacing(start_hz, end_hz, offsets, comb_hz)
    spacing, lowest_hz, span_hz = comb_hz.tolist()
    comb = find_comb(spacing, lowest_hz, span_hz, sample_rate_hz)
    arrays = Axis(
        tones,
        offsets,
        program.course,
        *times,
        comb.teeth,
        path=np.empty(n_segments, np.int8),
        squares=np.empty((2, n_segments)),
        group=np.empty(n_tones, np.int8),
        tooth=np.empty(n_tones, np.int32),
        origin=np.empty(n_tones, np.int32),
        waves=np.empty((N_WAVE, n_tones)),
    )
    numbers = (0, n_tones, n_segments, comb.teeth.shape[1], comb.n_teeth, comb.first)
    bits, addresses = np.float64(comb.step).view(np.int64), (array.ctypes.data for array in arrays)
    words = np.array([*numbers, bits, comb.block, next(_NUMBERS), *addresses], np.int64)
    choose_paths(words)
    return words, arrays


def _refuse_durations(program: ToneProgram, sample_rate_hz: float) -> NoReturn:
    wrong = np.flatnonzero(~((program.duration_s >= 0) & (program.duration_s < np.inf)))
    if len(wrong):
        quantity = f"the duration of segment {wrong[0]} in batch {program.batch[wrong[0]]}"
        raise LimitError(quantity, f"{program.duration_s[wrong[0]]} s", "0 or more and finite")
    with np.errstate(over="ignore"):
        n_samples = float(program.duration_s.sum()) * sample_rate_hz
    raise LimitError("the number of samples", f"{n_samples:.3g}", f"less than {MAX_SAMPLES:.3g}")


def _refuse(fault: int, index: int, program: ToneProgram, channel: int, sample_rate_hz: float) -> NoReturn:
    """Raise the error for a tone that cannot be played."""
    from labseq.motion.render_kernels import SUM

    axis, name = ((program.row, "row"), (program.column, "column"))[channel]
    if fault == SUM:
        tones = slice(axis.offsets[index], axis.offsets[index + 1])
        largest = max(axis.start_amplitude[tones].sum(), axis.end_amplitude[tones].sum())
        quantity = f"the sum of the amplitudes of the {name} tones in batch {program.batch[index]}"
        raise LimitError(quantity, f"{largest:.9g}", "1, full scale")
    field, limit = (
        ("start_hz", f"0 to {sample_rate_hz / 2:.9g}"),
        ("end_hz", f"0 to {sample_rate_hz / 2:.9g}"),
        ("start_amplitude", "0 to 1"),
        ("end_amplitude", "0 to 1"),
        ("phase_rad", "finite"),
    )[fault]
    segment = int(np.searchsorted(axis.offsets, index, "right")) - 1
    quantity = f"{field} of a {name} tone in batch {program.batch[segment]}"
    raise LimitError(quantity, getattr(axis, field)[index], limit)
