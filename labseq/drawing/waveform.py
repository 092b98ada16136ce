"""A waveform as a picture: what the samples hold, and what they were meant to."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.drawing.saving import make_figure, save_figure
from labseq.drawing.spectrogram import WaveformPieces, envelope, spectrogram
from labseq.model import AxisTones, FrequencyCourse, RfSpec, SegmentKind, ToneProgram
from labseq.motion import Renderer

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

DPI: Final = 150
SIZE_IN: Final = (11.0, 8.5)
HEIGHTS: Final = (0.5, 3.0, 1.0, 3.0, 1.0)
"""Of the strip with the batches, and of spectrogram and envelope of each axis; relative."""
HEAD_BELOW: Final = 0.945
"""Height below which everything but the head is laid out, as a part of the picture's."""
N_COLUMNS: Final = 1400
"""Columns of a spectrogram, about as many as the picture has pixels."""
ENVELOPE_S: Final = 2e-6
"""Least width of a column of an envelope: some periods of the beat of neighbouring tones."""
MARGIN_HZ: Final = 2.5e6
RANGE_DB: Final = 50.0
"""Range of levels that is shown, from the strongest tone down."""
N_POINTS: Final = 25
"""Points of the line of a tone whose speed changes."""

KINDS: Final = {
    SegmentKind.PICK_UP: ("pick-up", "#59a14f"),
    SegmentKind.TRANSPORT: ("transport", "#4e79a7"),
    SegmentKind.DROP_OFF: ("drop-off", "#f28e2b"),
}
INTENDED, PEAK, CUT = "#c8102e", "#4e79a7", "0.35"
SHADES: Final = ("white", "0.75", "0.4")
"""From the weakest level to the strongest; the intended tones must stand out."""
N_SHADES: Final = 25
"""One per 2 dB: steps that the eye hardly sees halve the file."""
DASHES: Final = (0, (4, 3))
LABELS: Final = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
"""Every how many batches one is numbered."""
LABEL_PART: Final = (0.008, 0.0067)
"""The space beside a number, and the width of a digit, as parts of the picture's width."""


@dataclass(frozen=True, slots=True, eq=False)
class WaveformDrawing:
    """What is drawn.

    Attributes:
        title: Stands at the top.
        source: Where the plan comes from; stands below it.
        notes: What stands above the row axis and above the column axis.
        program: The tones that are intended.
        renderer: Makes the samples.
        segments: The segments of the program that are drawn; at least one has tones.
        rf: What drives the AODs.
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
    """Where the segments with tones are in the picture, the pauses between them left out.

    Attributes:
        on: Their indices in the program.
        at_s: float64 (n + 1,), where each starts in the picture, and the end.
        stretches: The same in samples.
    """

    on: list[int]
    at_s: Floats
    stretches: WaveformPieces


def save_waveform(path: Path, drawing: WaveformDrawing) -> None:
    """Draw spectrogram and envelope of both axes, with the intended tones on top.

    Args:
        path: The PNG file.
        drawing: What is drawn.

    Raises:
        ConfigError: The file cannot be written.
    """
    told = {"Title": drawing.title, "Software": None}
    save_figure(path, lambda: _draw(drawing), dpi=DPI, metadata=told)


def _draw(drawing: WaveformDrawing) -> Figure:
    program, timeline = drawing.program, _lay_out(drawing)
    figure = make_figure(*SIZE_IN)
    figure.set_layout_engine("constrained", rect=(0.0, 0.0, 1.0, HEAD_BELOW))
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
        image.set_clim(top_db - RANGE_DB, top_db)
    bar = figure.colorbar(images[0], ax=panels[1:], pad=0.01, aspect=40)
    bar.set_label("samples: level / dB of a tone at full scale")
    left_out = " (vertical lines: pauses left out)" if _cuts(program, timeline) else ""
    panels[-1].set_xlabel(f"playing time with tones on / ms{left_out}")
    panels[-1].set_xlim(0.0, 1e3 * float(timeline.at_s[-1]))
    _write_head(figure, drawing)
    return figure


def _write_head(figure: Figure, drawing: WaveformDrawing) -> None:
    """The title, and what lines and colours stand for."""
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
    """Where a pause was left out, in ms."""
    pairs = enumerate(pairwise(timeline.on), start=1)
    return [1e3 * float(timeline.at_s[k]) for k, (a, b) in pairs if program.duration_s[a + 1 : b].sum() > 0.0]


def _draw_batches(axes: Axes, program: ToneProgram, timeline: _Timeline) -> None:
    """A strip that says which batch plays, and what it does."""
    at_ms, on = 1e3 * timeline.at_s, np.array(timeline.on)
    for kind, (_, colour) in KINDS.items():
        its = np.flatnonzero(program.kind[on] == kind)
        spans = list(zip(at_ms[its], np.diff(at_ms)[its], strict=True))
        axes.broken_barh(spans, (0.0, 1.0), facecolors=colour, linewidth=0)
    batch = program.batch[on]
    starts = np.flatnonzero(np.diff(batch, prepend=-1))
    edges = np.append(at_ms[starts], at_ms[-1])
    middles, numbers = (edges[1:] + edges[:-1]) / 2, batch[starts] + 1
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
    """Whether things at these places have as much room as each needs."""
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
    shades = LinearSegmentedColormap.from_list("samples", SHADES, N=N_SHADES)
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
    """Lines of the intended tones of an axis: time in the picture in s, frequency in Hz.

    Args:
        program: The tone program.
        tones: Its tones of the axis.
        on: The segments that are drawn.
        at_s: Where each starts in the picture, and the end.

    Returns:
        One float64 (n_points, 2) per tone and segment.
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
    n_columns = max(1, min(N_COLUMNS, int(timeline.at_s[-1] / ENVELOPE_S)))
    volts = drawing.rf.full_scale_v * envelope(drawing.renderer, channel, timeline.stretches, n_columns)
    edges_ms = np.linspace(0.0, 1e3 * timeline.at_s[-1], n_columns + 1)
    axes.stairs(volts, edges_ms, fill=True, color=PEAK)
    _mark_cuts(axes, drawing.program, timeline)
    axes.set_ylim(0.0, 1.1 * float(volts.max()) or 1.0)


def _mark_cuts(axes: Axes, program: ToneProgram, timeline: _Timeline) -> None:
    cuts = _cuts(program, timeline)
    for x in cuts:
        axes.axvline(x, color=CUT, linewidth=0.5 * min(1.0, 40 / len(cuts)), linestyle=(0, (2, 2)))
