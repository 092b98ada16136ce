"""The paper's figures 4 and 5, drawn from a run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.analysis.overview import note_of, unfit
from labseq.analysis.statistics import Rate, Statistics, statistics_of
from labseq.messages import clean
from labseq.model.estimate import Estimate
from labseq.pictures.figures import (
    ANOTHER,
    DARK,
    FRAME,
    LIGHT,
    LIMIT,
    OTHER,
    Series,
    make_figure,
    paint_quoted,
    paint_series,
    plain,
    save_figure,
    span,
    tidy,
)
from labseq.recording import Run
from labseq.recording.points import ScanPoint, scan_points
from labseq.units import format_quantity

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI: Final = 150
SIZE_IN: Final = (6.4, 4.6)
COLOURS: Final = ((LIGHT, DARK), (ANOTHER, OTHER))
"""Of the series with one window and of that with a window for each point; this run's, and the other's."""
ROOM: Final = 0.25
"""Room above and below the points, relative to their range."""
MIN_RANGE: Final = 0.5
"""Least range of filling that is shown, in per cent."""


@dataclass(frozen=True, slots=True, eq=False)
class ParallelismDrawing:
    """What is drawn.

    Attributes:
        title: Stands at the top.
        note: Stands below it.
        fixed: Filling where all points have one window: of the run, and of one that it is compared with.
        optimised: Filling where each point has a window of its own, likewise; either may be empty.
        survival: What the lifetime leaves of an atom after the window.
        quoted: The paper's points; None if they are of another array.
    """

    title: str
    note: str
    fixed: tuple[Series | None, ...]
    optimised: tuple[Series | None, ...]
    survival: Series
    quoted: Series | None = None


def save_parallelism(path: Path, drawing: ParallelismDrawing) -> None:
    """Draw filling against the degree of parallelism, with the survival during the window.

    Args:
        path: The PNG, SVG or PDF file.
        drawing: What is drawn.

    Raises:
        ConfigError: The file cannot be written.
    """
    save_figure(path, lambda: _draw(drawing), dpi=DPI)


def _draw(drawing: ParallelismDrawing) -> Figure:
    from matplotlib.ticker import MaxNLocator

    figure = make_figure(*SIZE_IN, layout="constrained")
    axes: Axes = figure.add_subplot()
    for kind, marker, series in ((0, "s", drawing.fixed), (1, "o", drawing.optimised)):
        for one, colours in zip(series, COLOURS, strict=False):
            if one is not None:
                paint_series(axes, one, colours[kind], marker, joined=True)
    if drawing.quoted is not None:
        paint_quoted(axes, drawing.quoted)
    low, high = span((*drawing.fixed, *drawing.optimised, drawing.quoted))
    room = ROOM * max(high - low, MIN_RANGE)
    axes.set_ylim(low - room, high + room)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("degree of parallelism")
    axes.set_ylabel("filling after one cycle (%)")
    tidy(axes)
    _draw_survival(axes, drawing.survival)
    figure.legend(loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    figure.suptitle(f"{plain(drawing.title)}\n{plain(drawing.note)}".rstrip(), fontsize=9)
    return figure


def _draw_survival(axes: Axes, survival: Series) -> None:
    """A grey curve with an axis of its own on the right."""
    right = axes.twinx()
    right.plot(survival.x, 100 * survival.y, color=LIMIT, linewidth=1, label=plain(survival.label))
    low, high = span([survival])
    room = ROOM * max(high - low, MIN_RANGE)
    right.set_ylim(low - room, high + room)
    right.set_ylabel("survival of the window (%)", color=LIMIT)
    right.tick_params(colors=LIMIT, width=0.7, labelsize=9)
    for spine in right.spines.values():
        spine.set(color=FRAME, linewidth=0.7)
    axes.set_zorder(right.get_zorder() + 1)
    axes.patch.set_visible(False)


FIGURE5_SIZE_IN: Final = (8.6, 4.4)
WIDTHS: Final = (2.3, 1.0)
"""Of the probabilities and of the histogram; relative."""
HEADROOM: Final = 1.35
"""Height of the panel, relative to the highest point: the key stands above the points."""
MIN_DEFECTS: Final = 4
"""Number of defects up to which the histogram goes at least."""


@dataclass(frozen=True, slots=True, eq=False)
class CyclesDrawing:
    """What is drawn.

    Attributes:
        title: Stands at the top.
        note: Stands below it.
        series: P_n of the run, and of one that it is compared with if there is one.
        defects: For each of them, int64 (n,), how many shots have 0, 1, 2, ... defects after the last cycle.
        quoted: The paper's points; None if they are of another array.
        ceiling: What losses and detection leave at most, by cycle; None if that is not known.
    """

    title: str
    note: str
    series: tuple[Series, ...]
    defects: tuple[NDArray[np.int64], ...]
    quoted: Series | None = None
    max_defect_free: Series | None = None


def save_cycles(path: Path, drawing: CyclesDrawing) -> None:
    """Draw the defect-free probability against the number of cycles, with the defects at the end.

    Args:
        path: The PNG, SVG or PDF file.
        drawing: What is drawn.

    Raises:
        ConfigError: The file cannot be written.
    """
    save_figure(path, lambda: _figure5_draw(drawing), dpi=DPI)


def _figure5_draw(drawing: CyclesDrawing) -> Figure:
    figure = make_figure(*FIGURE5_SIZE_IN, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=WIDTHS)
    _draw_rates(left, drawing)
    _draw_defects(right, drawing)
    figure.suptitle(f"{plain(drawing.title)}\n{plain(drawing.note)}".rstrip(), fontsize=9)
    return figure


def _draw_rates(axes: Axes, drawing: CyclesDrawing) -> None:
    from matplotlib.ticker import MaxNLocator

    for series, colour, marker in zip(drawing.series, (DARK, OTHER), "os", strict=False):
        paint_series(axes, series, colour, marker, joined=True)
    if drawing.quoted is not None:
        paint_quoted(axes, drawing.quoted)
    if drawing.max_defect_free is not None:
        limit = drawing.max_defect_free
        axes.plot(limit.x, 100 * limit.y, color=LIMIT, linewidth=1, linestyle="--", label=plain(limit.label))
    shown = [one for one in (*drawing.series, drawing.quoted, drawing.max_defect_free) if one is not None]
    axes.set_ylim(0.0, HEADROOM * span(shown)[1])
    axes.set_xlim(0.5, max(float(one.x[-1]) for one in shown) + 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("rearrangement cycles n")
    axes.set_ylabel("defect-free on the image that ends cycle n (%)")
    axes.legend(*_key(axes, drawing), frameon=False, fontsize=8, loc="upper left")
    tidy(axes)


def _key(axes: Axes, drawing: CyclesDrawing) -> tuple[list[Any], list[str]]:
    """Handles and labels, points before lines."""
    handles, labels = axes.get_legend_handles_labels()
    if drawing.max_defect_free is not None:  # matplotlib sorts lines before points with error bars
        handles, labels = [*handles[1:], handles[0]], [*labels[1:], labels[0]]
    return handles, labels


def _draw_defects(axes: Axes, drawing: CyclesDrawing) -> None:
    """The histogram: share of the shots with each number of defects."""
    from matplotlib.ticker import MaxNLocator

    for counts, inside, rim in zip(drawing.defects, (LIGHT, None), (DARK, OTHER), strict=False):
        share = 100 * counts / max(1, counts.sum())
        edges = np.arange(len(counts) + 1) - 0.5
        if inside is not None:
            axes.stairs(share, edges, fill=True, color=inside)
        axes.stairs(share, edges, color=rim, linewidth=0.9)
    most = max(MIN_DEFECTS, *(len(counts) - 1 for counts in drawing.defects))
    axes.set_xlim(-0.8, most + 0.8)
    axes.set_ylim(bottom=0.0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel(f"defects after cycle {int(drawing.series[0].x[-1])}")
    axes.set_ylabel("shots (%)")
    tidy(axes)


@dataclass(frozen=True, slots=True)
class AtomLosses:
    """What atoms are lost to although nobody moves them, and how often one is missed.

    Attributes:
        lifetime_s: Lifetime of an atom in a tweezer, exposures included.
        imaging_loss: Loss in one exposure beside the lifetime's.
        imaging_loss_exposure_s: The exposure that the imaging loss belongs to.
        false_negative: Probability that an atom is not seen; None if it is not known.
    """

    lifetime_s: float
    imaging_loss: float
    imaging_loss_exposure_s: float
    false_negative: float | None = None

    @classmethod
    def of(cls, devices: Mapping[str, Any]) -> AtomLosses | None:
        """What a run's simulation says of itself; None without one, or if it does not tell.

        Args:
            devices: ``describe()`` of each device, as run.json has them.
        """
        told: Any = devices.get("simulation")
        if not isinstance(told, Mapping):
            return None
        names = ("lifetime", "imaging_loss", "imaging_loss_exposure", "false_negative")
        lifetime_s, loss, exposure_s, missed = (_number(told.get(name)) for name in names)  # pyright: ignore[reportUnknownMemberType]
        if lifetime_s is None or loss is None or exposure_s is None:
            return None
        makes_sense = lifetime_s > 0 and exposure_s > 0 and 0 <= loss < 1
        return cls(lifetime_s, loss, exposure_s, missed) if makes_sense else None


def max_defect_free(n_atoms: int, period_s: float, exposure_s: float, losses: AtomLosses) -> float:
    """The highest probability that an array is seen defect-free on the image that ends a cycle.

    Between the moment in which an atom is seen on one image and that on the next one,
    it lives through the loss of one exposure, whatever part of it comes before that moment, and
    through the vacuum for a whole period. What was lost is not missed before the next
    image, even if every plan is perfect and nothing is lost on the way. An atom that is not
    seen counts as a defect on this image; and one that was not seen on the image before was
    sent another one, and both are lost. So each of N atoms is seen where it should be with::

        p = exp(-T / lifetime) (1 - loss) ^ (exposure / 45 ms) (1 - false negative)^2

    and the array with p^N. Empty sites that are taken for full ones change that by about a part in
    a thousand: few sites are empty.

    Args:
        n_atoms: Atoms of the target, N.
        period_s: From the start of an exposure to the start of the next one, T.
        exposure_s: Exposure time.
        losses: See :class:`AtomLosses`.

    Example:
        >>> paper = Losses(lifetime_s=33.0, imaging_loss=0.00314, imaging_loss_exposure_s=0.045)
        >>> round(ceiling(225, 0.058, 0.045, paper), 3)
        0.332
    """
    exposures = exposure_s / losses.imaging_loss_exposure_s
    log_stays = -period_s / losses.lifetime_s + exposures * math.log1p(-losses.imaging_loss)
    log_seen = 2 * math.log1p(-losses.false_negative) if losses.false_negative else 0.0
    return math.exp(n_atoms * (log_stays + log_seen))


def after_moves(most: float, n_atom_moves: float, loss: float) -> float:
    """What is left of the ceiling when the moved atoms may be lost as well.

    An atom that is lost on the way is not missed before the next image, so each of the m moved atoms counts
    with ``1 - loss``. Moves come with the defects, so m is not the same in every shot; with its mean this
    is an estimate, good as long as ``m loss`` is small.

    Args:
        most: The ceiling.
        n_atom_moves: Mean number of atom moves of a cycle, m.
        loss: Loss of a moved atom.

    Example:
        >>> round(after_moves(0.336, 6.0, 0.02), 3)
        0.298
    """
    return most * (1.0 - loss) ** n_atom_moves


def survival(window_s: float, lifetime_s: float) -> float:
    """Probability that an atom outlives a window (paper, figure 4).

    Example:
        >>> round(survival(0.2, 33.0), 4)
        0.994
    """
    return math.exp(-window_s / lifetime_s)


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, float | int) and math.isfinite(value) else None


PAPER: Final = "Tian et al."
PAPERS_ATOMS: Final = 225
PAPERS_LIFETIME_S: Final = 33.0
PAPERS_FILLING: Final = ((7, 0.9766, 0.0004),)
"""Degree of parallelism, filling after one cycle, its error (figure 4)."""
PAPERS_DEFECT_FREE: Final = ((1, 0.015, 0.003), (2, 0.169, 0.008), (10, 0.33, 0.01))
"""Cycles, defect-free probability, its error (figure 5)."""
DOP: Final = "planner.degree_of_parallelism"


def figure_5(run: Run, other: Run | None = None) -> CyclesDrawing:
    """Defect-free probability against the number of cycles.

    Args:
        run: A run whose shots all make every cycle.
        other: One to compare it with.

    Raises:
        ConfigError: A run is not of that kind; says what the figure needs.
        RecordingError: A run is damaged.
    """
    runs = [run] if other is None else [run, other]
    found = [_cycles_of(one) for one in runs]
    series = [
        _rates(f"{_name(one, runs)}, {statistics.n_shots} shots", [c.defect_free for c in statistics.cycles])
        for one, statistics in zip(runs, found, strict=True)
    ]
    return CyclesDrawing(
        title="figure 5: defect-free probability after n cycles",
        note=note_of(run),
        series=tuple(series),
        defects=tuple(np.array(statistics.cycles[-1].defects, np.int64) for statistics in found),
        quoted=_quoted(run, PAPERS_DEFECT_FREE),
        max_defect_free=_max_defect_free(run, found[0]),
    )


def _cycles_of(run: Run) -> Statistics:
    if run.record.get("scan"):
        raise unfit(run, "it scans", "a run without a scan, of a sequence like figure5_multicycle.yaml")
    statistics = statistics_of(run.shots, run.target)
    if not statistics.cycles:
        raise unfit(run, "no shot of it rearranges", "shots with rearrangement cycles")
    if statistics.cycles[-1].n_shots < statistics.cycles[0].n_shots:
        n_last, n_first = statistics.cycles[-1].n_shots, statistics.cycles[0].n_shots
        what = f"{n_first} of its shots make the first cycle, and {n_last} the last"
        raise unfit(run, what, "every cycle made in every shot: 'stop_when: never' in the rearrangement")
    return statistics


def _max_defect_free(run: Run, statistics: Statistics) -> Series | None:
    """What losses and detection leave at most; None where the run does not tell of them."""
    losses = AtomLosses.of(run.record.get("devices") or {})
    if losses is None:
        return None
    images = next(shot for shot in run.shots if shot.index not in statistics.unreadable).summary.images
    exposures = [s for s, cycle in zip(images.exposure_s, images.cycle, strict=True) if cycle]
    n_atoms = run.target.n_atoms
    most = [
        max_defect_free(n_atoms, cycle.period_s.value, exposure_s, losses)
        for cycle, exposure_s in zip(statistics.cycles, exposures, strict=False)
    ]
    counted = "losses in the light and with time"
    label = f"ceiling: {counted}" + ("" if losses.false_negative is None else ", missed atoms")
    return _line(label, range(1, len(most) + 1), most)


@dataclass(frozen=True, slots=True)
class _Point:
    """A point of figure 4."""

    dop: int
    window_s: float
    filling: Estimate


def figure_4(run: Run, other: Run | None = None) -> ParallelismDrawing:
    """Filling after one cycle against the degree of parallelism.

    Where a degree has two windows, the longest window of the run is that of one series, and each
    degree's shorter window that of the other.

    Args:
        run: A run of shots with one cycle that scans the degree of parallelism.
        other: One to compare it with.

    Raises:
        ConfigError: A run is not of that kind; says what the figure needs.
        RecordingError: A run is damaged.
    """
    runs = [run] if other is None else [run, other]
    parted = [_parted(one, _points_of(one)) for one in runs]
    fixed, own = ([_fillings(one, runs, points) for one, points in zip(runs, of, strict=True)]
                  for of in zip(*parted, strict=True))  # fmt: skip
    losses = AtomLosses.of(run.record.get("devices") or {})
    lifetime_s = PAPERS_LIFETIME_S if losses is None else losses.lifetime_s
    shown = parted[0][1] or parted[0][0]
    return ParallelismDrawing(
        title="figure 4: filling after one cycle",
        note=note_of(run),
        fixed=tuple(fixed),
        optimised=tuple(own),
        survival=_line(
            f"survival of the {_windows(shown)} (lifetime {format_quantity(lifetime_s, 'time')})",
            [point.dop for point in shown],
            [survival(point.window_s, lifetime_s) for point in shown],
        ),
        quoted=_quoted(run, PAPERS_FILLING),
    )


def _points_of(run: Run) -> list[_Point]:
    points = scan_points(run)
    if not points or DOP not in points[0].parameters:
        raise unfit(run, f"it does not scan {DOP}", "a run of a sequence like figure4_dop_scan.yaml")
    return [_point_of(run, point) for point in points]


def _point_of(run: Run, point: ScanPoint) -> _Point:
    statistics = statistics_of(point.shots, run.target)
    n_read = len(point.shots) - len(statistics.unreadable)
    if len(statistics.cycles) != 1 or statistics.cycles[0].n_shots < n_read:
        raise unfit(run, "not all of its shots make one cycle", "'cycles: 1, stop_when: never'")
    others = [address for address in point.parameters if address != DOP and not address.endswith("window")]
    if others:
        what = f"it also scans {', '.join(map(clean, others))}"
        raise unfit(run, what, "a scan of the degree of parallelism and the window alone")
    return _Point(int(point.parameters[DOP]), _window_s(run, point), statistics.cycles[0].filling)


def _window_s(run: Run, point: ScanPoint) -> float:
    """The window of the cycle, scanned or not."""
    found = [value for address, value in point.parameters.items() if address.endswith("window")]
    steps: Sequence[Mapping[str, Any]] = run.record.get("resolved", {}).get("shot", ())
    found += [step["rearrange"].get("window") for step in steps if "rearrange" in step]
    window: Any = found[0] if found else None
    first: Any = window[0] if isinstance(window, list) and window else window  # pyright: ignore[reportUnknownVariableType]
    if not isinstance(first, float | int):
        raise unfit(run, "its window is not recorded", "a window in 'rearrange'")
    return float(first)


def _parted(run: Run, points: Sequence[_Point]) -> tuple[list[_Point], list[_Point]]:
    """The points with the longest window, and those with the shortest of each degree of parallelism.

    The second list is empty if all points have one window.
    """
    by_dop: dict[int, list[_Point]] = {}
    for point in points:
        by_dop.setdefault(point.dop, []).append(point)
    if max(map(len, by_dop.values())) > 2:
        raise unfit(run, "it has more than two windows for a degree of parallelism", "at most two")
    longest_s = max(point.window_s for point in points)
    ordered = [sorted(by_dop[dop], key=lambda point: point.window_s) for dop in sorted(by_dop)]
    fixed = [of[-1] for of in ordered if of[-1].window_s == longest_s]
    own = [of[0] for of in ordered]
    return fixed, [] if all(point.window_s == longest_s for point in own) else own


def _fillings(run: Run, runs: Sequence[Run], points: Sequence[_Point]) -> Series | None:
    if not points:
        return None
    prefix = f"{_name(run, runs)}, " if len(runs) > 1 else ""
    value = np.array([point.filling.value for point in points])
    error = np.array([point.filling.error for point in points])
    x = np.array([point.dop for point in points], np.float64)
    return Series(prefix + _windows(points), x, value, value - error, value + error)


def _windows(points: Sequence[_Point]) -> str:
    windows = [point.window_s for point in points]
    ends = [format_quantity(end, "time") for end in (min(windows), max(windows))]
    return f"window {ends[0]}" if ends[0] == ends[1] else f"windows {ends[0]} to {ends[1]}"


def _rates(label: str, rates: Sequence[Rate]) -> Series:
    low, high = np.array([rate.interval for rate in rates]).T
    x = np.arange(1.0, len(rates) + 1)
    return Series(label, x, np.array([rate.value for rate in rates]), low, high)


def _line(label: str, x: Sequence[float], y: Sequence[float]) -> Series:
    values = np.array(y, np.float64)
    return Series(label, np.array(x, np.float64), values, values, values)


def _quoted(run: Run, points: Sequence[tuple[int, float, float]]) -> Series | None:
    """What the paper states; None for arrays of another size."""
    if run.target.n_atoms != PAPERS_ATOMS:
        return None
    x, y, error = np.array(points, np.float64).T
    return Series(PAPER, x, y, y - error, y + error)


def _name(run: Run, runs: Sequence[Run]) -> str:
    """What a run is called beside others: by its folder if its name does not tell them apart."""
    alike = sum(one.name == run.name for one in runs) > 1
    return clean(run.path.name if alike else run.name)
