"""Draws waveforms as the power of each tone against time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.model import AxisTones, FrequencyCourse, RfSpec, SegmentKind, ToneProgram
from labseq.motion.rendering import FULL_SCALE, Renderer
from labseq.pictures.figures import make_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AT_ONCE: Final = 32
"""Windows that are transformed together, which take a few megabytes."""

CHUNK: Final = 1 << 18
"""Samples that are rendered at a time."""


@dataclass(frozen=True, slots=True)
class WaveformPieces:
    """Pieces of a waveform that a picture shows end to end.

    Attributes:
        first: int64 (n,), first sample of each piece in the waveform.
        at: int64 (n + 1,), start of each piece in the picture, in samples, and the end.
    """

    first: NDArray[np.int64]
    at: NDArray[np.int64]

    @classmethod
    def of(cls, pieces: list[tuple[int, int]]) -> WaveformPieces:
        """Lay pieces end to end.

        Args:
            pieces: First sample of each, and the sample after its last.

        Example:
            >>> WaveformPieces.of([(10, 14), (20, 25)]).at.tolist()
            [0, 4, 9]
        """
        bounds = np.array(pieces, np.int64).reshape(-1, 2)
        lengths = bounds[:, 1] - bounds[:, 0]
        return cls(bounds[:, 0], np.concatenate([[0], np.cumsum(lengths)]))

    @property
    def n_samples(self) -> int:
        """Samples in all pieces together."""
        return int(self.at[-1])

    def in_waveform(self, place: NDArray[np.int64]) -> NDArray[np.int64]:
        """Samples of the waveform at places in the picture, in samples."""
        piece = np.searchsorted(self.at[1:-1], place, side="right")
        return place - self.at[piece] + self.first[piece]


def spectrogram(
    renderer: Renderer, channel: int, stretches: WaveformPieces, n_columns: int, band_hz: tuple[float, float]
) -> tuple[NDArray[np.float32], tuple[float, float]]:
    """Compute the strength of each frequency column by column, without ever holding all samples.

    Args:
        channel: 0 for the row tones, 1 for the column tones.
        band_hz: Lowest and highest frequency of the result.

    Returns:
        float32 (n_bins, n_columns), in dB relative to a tone at full scale, low frequencies first,
        and the frequencies of the lower edge of the first bin and the upper edge of the last.
    """
    rate_hz = renderer.sample_rate_hz
    # a Hann window of 6 us separates tones 0.5 MHz apart, and a chirp of 1.6 MHz per site, which takes about
    # 35 us, moves by less than that in it
    length = max(16, round(6e-6 * rate_hz))
    n_fft = 2 << (length - 1).bit_length()
    window = np.hanning(length).astype(np.float32)
    low, high = (int(np.rint(hz / rate_hz * n_fft)) for hz in band_hz)
    low, high = max(0, low), min(n_fft // 2, max(low, high))
    wide = stretches.n_samples / n_columns
    n_windows = min(8, math.ceil(2 * wide / length))  # so a long program does not use all samples
    centre = (np.arange(n_columns * n_windows) + 0.5) * (wide / n_windows)
    start = np.maximum(0, stretches.in_waveform(centre.astype(np.int64)) - length // 2)
    samples = np.empty((AT_ONCE, length), np.int16)
    power = np.empty((len(start), high - low + 1), np.float32)
    for i in range(0, len(start), AT_ONCE):
        its = start[i : i + AT_ONCE]
        for out, first in zip(samples, its, strict=False):
            renderer.write(channel, int(first), out)
        spectrum = np.fft.rfft(samples[: len(its)] * window, n_fft)[:, low : high + 1]
        power[i : i + len(its)] = (2 / (window.sum() * FULL_SCALE) * np.abs(spectrum)) ** 2
    mean = power.reshape(n_columns, n_windows, -1).mean(axis=1)
    level_db = 10 * np.log10(np.maximum(mean, 1e-12))
    edges_hz = (low - 0.5) * rate_hz / n_fft, (high + 0.5) * rate_hz / n_fft
    return level_db.T.astype(np.float32), edges_hz


def envelope(
    renderer: Renderer, channel: int, stretches: WaveformPieces, n_columns: int
) -> NDArray[np.float64]:
    """The largest sample of each column as a fraction of full scale, float64 (n_columns,)."""
    edges = np.rint(np.linspace(0, stretches.n_samples, n_columns + 1)).astype(np.int64)
    cuts = np.unique(np.concatenate([edges, stretches.at]))
    column = np.searchsorted(edges, cuts[:-1], side="right") - 1
    first = stretches.in_waveform(cuts[:-1])
    out = np.empty(CHUNK, np.int16)
    largest = np.zeros(n_columns)
    for k, start, n in zip(column.tolist(), first.tolist(), np.diff(cuts).tolist(), strict=True):
        for at in range(0, n, CHUNK):
            part = out[: min(CHUNK, n - at)]
            renderer.write(channel, start + at, part)
            largest[k] = max(largest[k], int(part.max()), -int(part.min()))
    return largest / FULL_SCALE


Floats = NDArray[np.float64]

DPI: Final = 150
SIZE_IN: Final = (11.0, 8.5)
HEIGHTS: Final = (0.5, 3.0, 1.0, 3.0, 1.0)
"""Relative heights of the strip of batches, and of spectrogram and envelope of each axis."""
N_COLUMNS: Final = 1400
"""Columns of a spectrogram, about as many as the picture has pixels."""
MARGIN_HZ: Final = 2.5e6
N_POINTS: Final = 25
"""Points of the line of a tone whose speed changes."""

KINDS: Final = {
    SegmentKind.PICK_UP: ("pick-up", "#59a14f"),
    SegmentKind.TRANSPORT: ("transport", "#4e79a7"),
    SegmentKind.DROP_OFF: ("drop-off", "#f28e2b"),
}
INTENDED, PEAK, CUT = "#c8102e", "#4e79a7", "0.35"
DASHES: Final = (0, (4, 3))
LABELS: Final = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
"""Intervals of the batch numbers. The first interval with enough room for its labels is used."""
LABEL_PART: Final = (0.008, 0.0067)
"""The space next to a number, and the width of a digit, as parts of the picture's width."""


@dataclass(frozen=True, slots=True, eq=False)
class WaveformDrawing:
    """The intended tones of a program and the samples of its renderer, to draw.

    Attributes:
        source: Source of the plan, for the line below the title.
        notes: Titles of the row axis and of the column axis.
        segments: The segments of the program to draw. At least one has tones.
    """

    title: str
    source: str
    notes: tuple[str, str]
    program: ToneProgram
    renderer: Renderer
    segments: range
    rf: RfSpec


@dataclass(frozen=True, slots=True, eq=False)
class _Timeline:
    """Places of the segments with tones in the picture, without the pauses between them.

    Attributes:
        on: Their indices in the program.
        at_s: float64 (n + 1,), start of each segment in the picture, and the end.
        stretches: The same in samples.
    """

    on: list[int]
    at_s: Floats
    stretches: WaveformPieces


def save_waveform(path: Path, drawing: WaveformDrawing) -> None:
    """Draw spectrogram and envelope of both axes, with the intended tones on top.

    Raises:
        ConfigError: The file cannot be written.
    """
    metadata = {"Title": drawing.title, "Software": None}
    save_figure(path, lambda: _draw(drawing), dpi=DPI, metadata=metadata)


def _draw(drawing: WaveformDrawing) -> Figure:
    program, timeline = drawing.program, _lay_out(drawing)
    figure = make_figure(*SIZE_IN)
    figure.set_layout_engine("constrained", rect=(0.0, 0.0, 1.0, 0.945))  # room for the title
    panels: list[Axes] = list(
        figure.subplots(len(HEIGHTS), 1, sharex=True, gridspec_kw={"height_ratios": HEIGHTS})
    )
    _draw_batches(panels[0], program, timeline)
    images: list[Any] = []
    for channel, name in enumerate(("row", "column")):
        above, below = panels[1 + 2 * channel : 3 + 2 * channel]
        images.append(_draw_spectrogram(above, drawing, channel, timeline))
        above.set_title(drawing.notes[channel], fontsize=8, loc="left", pad=3)
        above.set_ylabel(f"{name} tones / MHz")
        _draw_envelope(below, drawing, channel, timeline)
        below.set_ylabel(f"{name} axis\npeak / V")
    strongest_db = max(float(image.get_array().max()) for image in images)
    top_db = 5 * np.ceil(strongest_db / 5)
    for image in images:
        image.set_clim(top_db - 50, top_db)
    bar = figure.colorbar(images[0], ax=panels[1:], pad=0.01, aspect=40)
    bar.set_label("samples: level / dB of a tone at full scale")
    left_out = " (vertical lines mark omitted pauses)" if _cuts(program, timeline) else ""
    panels[-1].set_xlabel(f"playing time with tones on / ms{left_out}")
    panels[-1].set_xlim(0.0, 1e3 * float(timeline.at_s[-1]))
    _write_head(figure, drawing)
    return figure


def _write_head(figure: Figure, drawing: WaveformDrawing) -> None:
    """Write the title, and the meaning of lines and colours."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    plain: dict[str, Any] = {"va": "top", "parse_math": False}  # a file may be called $x$
    figure.text(0.01, 0.99, drawing.title, fontsize=11, **plain)
    figure.text(0.01, 0.965, drawing.source, fontsize=8, color="0.4", **plain)
    handles: list[Any] = [Patch(color=colour, label=label) for label, colour in KINDS.values()]
    handles += [
        Line2D([], [], color=INTENDED, linewidth=1, linestyle=DASHES, label="intended tone"),
        Line2D([], [], color="black", linewidth=0.8, linestyle=":", label="edge of the AOD's band"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8, frameon=False)


def _lay_out(drawing: WaveformDrawing) -> _Timeline:
    program, first = drawing.program, drawing.renderer.first_sample
    on = [i for i in drawing.segments if program.kind[i] != SegmentKind.IDLE]
    at_s = np.concatenate([[0.0], np.cumsum(program.duration_s[on])])
    return _Timeline(on, at_s, WaveformPieces.of([(int(first[i]), int(first[i + 1])) for i in on]))


def _cuts(program: ToneProgram, timeline: _Timeline) -> list[float]:
    """Times of omitted pauses, in ms."""
    pairs = enumerate(pairwise(timeline.on), start=1)
    return [1e3 * float(timeline.at_s[k]) for k, (a, b) in pairs if program.duration_s[a + 1 : b].sum() > 0.0]


def _draw_batches(axes: Axes, program: ToneProgram, timeline: _Timeline) -> None:
    """Draw a strip that says which batch plays and what it does."""
    at_ms, on = 1e3 * timeline.at_s, np.array(timeline.on)
    for kind, (_, colour) in KINDS.items():
        its = np.flatnonzero(program.kind[on] == kind)
        spans = list(zip(at_ms[its], np.diff(at_ms)[its], strict=True))
        axes.broken_barh(spans, (0.0, 1.0), facecolors=colour, linewidth=0)
    batch = program.batch[on]
    starts = np.flatnonzero(np.diff(batch, prepend=-1))
    edges = np.append(at_ms[starts], at_ms[-1])
    middles, numbers = (edges[1:] + edges[:-1]) / 2, batch[starts]
    for x in edges[1:-1]:
        axes.axvline(x, color="white", linewidth=0.8)
    needed = (LABEL_PART[0] + LABEL_PART[1] * len(str(numbers[-1]))) * at_ms[-1]
    every = next((n for n in LABELS if _fit(middles[numbers % n == 0], needed)), LABELS[-1])
    for x, number in zip(middles, numbers, strict=True):
        if number % every == 0:
            axes.text(x, 1.15, str(number), fontsize=7, ha="center", va="bottom", clip_on=True)
    axes.set_ylim(0.0, 2.2)
    axes.set_axis_off()
    axes.text(-0.005, 0.75, "batch", fontsize=8, ha="right", va="center", transform=axes.transAxes)


def _fit(places: Floats, needed: float) -> bool:
    """True if labels at these places are far enough apart."""
    return len(places) < 2 or float(np.diff(places).min()) >= needed


def _draw_spectrogram(axes: Axes, drawing: WaveformDrawing, channel: int, timeline: _Timeline) -> Any:
    """Spectrogram of the samples, and the intended tones on top."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LinearSegmentedColormap

    tones = (drawing.program.row, drawing.program.column)[channel]
    lines = tone_lines(drawing.program, tones, timeline.on, timeline.at_s)
    hz = np.concatenate([line[:, 1] for line in lines])
    low_hz, high_hz = float(hz.min()) - MARGIN_HZ, float(hz.max()) + MARGIN_HZ
    n_columns = min(N_COLUMNS, timeline.stretches.n_samples)
    level_db, edges_hz = spectrogram(
        drawing.renderer, channel, timeline.stretches, n_columns, (low_hz, high_hz)
    )
    extent = 0.0, 1e3 * float(timeline.at_s[-1]), 1e-6 * edges_hz[0], 1e-6 * edges_hz[1]
    # 25 shades, one per 2 dB, because steps that the eye hardly sees halve the size of the file
    shades = LinearSegmentedColormap.from_list("samples", ("white", "0.75", "0.4"), N=25)
    image = axes.imshow(
        level_db, extent=extent, origin="lower", aspect="auto", cmap=shades, interpolation="nearest"
    )
    shown = [line * (1e3, 1e-6) for line in lines]
    axes.add_collection(LineCollection(shown, colors=INTENDED, linewidths=0.7, linestyles=[DASHES]))
    for edge_hz in (drawing.rf.row_band_hz, drawing.rf.column_band_hz)[channel]:
        axes.axhline(1e-6 * edge_hz, color="black", linewidth=0.8, linestyle=":")
    _mark_cuts(axes, drawing.program, timeline)
    axes.set_ylim(1e-6 * low_hz, 1e-6 * high_hz)
    return image


def tone_lines(program: ToneProgram, tones: AxisTones, on: list[int], at_s: Floats) -> list[Floats]:
    """Lines of the intended tones of an axis in the segments ``on``, which start at ``at_s`` in the picture.

    Returns:
        Time in the picture in s, and frequency in Hz, as one float64 (n_points, 2) per tone and segment.
    """
    lines: list[Floats] = []
    for k, i in enumerate(on):
        course = FrequencyCourse(int(program.course[i]))
        n_points = 2 if course is FrequencyCourse.LINEAR else N_POINTS
        u = np.linspace(0.0, 1.0, n_points)
        s = np.array([course.fraction(float(x)) for x in u])
        t_s = at_s[k] + u * (at_s[k + 1] - at_s[k])
        for n in range(tones.offsets[i], tones.offsets[i + 1]):
            hz = tones.start_hz[n] + (tones.end_hz[n] - tones.start_hz[n]) * s
            lines.append(np.stack([t_s, hz], axis=1))
    return lines


def _draw_envelope(axes: Axes, drawing: WaveformDrawing, channel: int, timeline: _Timeline) -> None:
    # columns of at least 2 us contain some periods of the beat of neighbouring tones
    n_columns = max(1, min(N_COLUMNS, int(timeline.at_s[-1] / 2e-6)))
    volts = drawing.rf.full_scale_v * envelope(drawing.renderer, channel, timeline.stretches, n_columns)
    edges_ms = np.linspace(0.0, 1e3 * timeline.at_s[-1], n_columns + 1)
    axes.stairs(volts, edges_ms, fill=True, color=PEAK)
    _mark_cuts(axes, drawing.program, timeline)
    axes.set_ylim(0.0, 1.1 * float(volts.max()) or 1.0)


def _mark_cuts(axes: Axes, program: ToneProgram, timeline: _Timeline) -> None:
    cuts = _cuts(program, timeline)
    for x in cuts:
        axes.axvline(x, color=CUT, linewidth=0.5 * min(1.0, 40 / len(cuts)), linestyle=(0, (2, 2)))
