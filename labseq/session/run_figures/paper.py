"""The paper's figures 4 and 5, drawn from a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from labseq.config.wording import clean
from labseq.drawing import CyclesDrawing, ParallelismDrawing, Series
from labseq.model.estimate import Estimate
from labseq.recording import Run
from labseq.recording.points import ScanPoint, scan_points
from labseq.recording.rates import Rate
from labseq.recording.statistics import Statistics, statistics_of
from labseq.session.ceiling import AtomLosses, max_defect_free, survival
from labseq.session.run_figures.words import note_of, unfit
from labseq.units import format_quantity

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
