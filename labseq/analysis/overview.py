"""A run at a glance: filling, survival, losses and scans."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from labseq.analysis.charts import (
    Chart,
    CurvesChart,
    DefectsChart,
    LossCausesChart,
    MapChart,
    RunDrawing,
    SitesChart,
    StageBar,
    StagesChart,
    TrendChart,
)
from labseq.analysis.statistics import CycleStatistics, Rate, Statistics, jeffreys, statistics_of
from labseq.analysis.timing import STEP, RunTiming, StageTotals
from labseq.calibration.store import read_entry
from labseq.detection.sites import KnownSites, known_sites
from labseq.errors import ConfigError, Problem, RecordingError, one_of
from labseq.messages import clean
from labseq.model import CalibrationEntry, CycleRecord, Occupancy, SiteGrid, TargetPattern
from labseq.model.estimate import Estimate, mean
from labseq.pictures.figures import Series
from labseq.pictures.plans import on_grid
from labseq.recording import Run, Shot
from labseq.recording.points import scan_points

MeasureName = Literal["filling", "success"]

MIN_WINDOW: Final = 10
"""Least number of shots of a running mean."""
N_WINDOWS: Final = 10
"""So many of its windows a longer run holds."""
MAX_POINTS: Final = 200
"""Most points of its line."""


@dataclass(frozen=True, slots=True)
class Measure:
    """What is said of each shot, and its mean over shots.

    Attributes:
        name: "filling" or "success".
        title: What it is called in titles.
        label: What it is called beside an axis.
    """

    name: MeasureName
    title: str
    label: str

    @property
    def is_rate(self) -> bool:
        """Whether it is true or false of each shot."""
        return self.name == "success"

    def of_shot(self, shot: Shot, target: TargetPattern) -> float:
        """Of the image that the shot is judged on, else of the last one after a cycle; NaN without."""
        if not math.isnan(shot.filling_fraction):
            return float(shot.success) if self.is_rate else shot.filling_fraction
        images = shot.summary.images
        if not len(images) or not images.cycle[-1] or not target.n_atoms:
            return math.nan
        n_defects, n_surplus = images.n_defects[-1], images.n_surplus[-1]
        return float(not n_defects and not n_surplus) if self.is_rate else 1.0 - n_defects / target.n_atoms

    def of_many(self, statistics: Statistics | CycleStatistics) -> Estimate | Rate:
        """The mean over some shots."""
        return statistics.defect_free if self.is_rate else statistics.filling

    def over(self, values: Sequence[float]) -> Estimate | Rate:
        """The mean of some shots' values."""
        return Rate(round(math.fsum(values)), len(values)) if self.is_rate else mean(values)


FILLING: Final = Measure("filling", "filling", "filling (%)")
SUCCESS: Final = Measure("success", "defect-free", "defect-free (%)")


def course(run: Run, measure: Measure, values: Sequence[float]) -> TrendChart:
    """A measure against the shot.

    Args:
        run: The run.
        measure: What is shown.
        values: It for each shot of the run; at least one is known.
    """
    numbers = np.array([shot.index + 1.0 for shot in run.shots])
    known = np.isfinite(values)
    x, y = numbers[known], np.array(values)[known]
    window = min(len(y), max(MIN_WINDOW, len(y) // N_WINDOWS))
    starts = np.unique(np.linspace(0, len(y) - window, MAX_POINTS).astype(np.int64))
    means = [measure.over(y[start : start + window].tolist()) for start in starts]
    at = [float(x[start] + x[start + window - 1]) / 2 for start in starts]
    shots = "1 shot" if window == 1 else f"{window} shots"
    title = f"{measure.title} by shot; line: mean of {shots}"
    running = series_of("", at, means)
    return TrendChart(title, measure.label, x, y, running, is_rate=measure.is_rate)


def by_cycle(measure: Measure, statistics: Statistics) -> CurvesChart | None:
    """A measure against the cycle, each on the image that ended it; None without cycles."""
    cycles = statistics.cycles
    if not cycles:
        return None
    series = series_of("", [one.cycle for one in cycles], [measure.of_many(one) for one in cycles])
    ended = cycles[-1].n_shots < cycles[0].n_shots
    title = f"{measure.title} by cycle" + (", of the shots that made it" if ended else "")
    return CurvesChart(title, "cycle", measure.label, (series,), whole=True, from_zero=measure.is_rate)


def series_of(label: str, x: Iterable[float], values: Iterable[Estimate | Rate]) -> Series:
    """Means with their errors; those of nothing are left out.

    Args:
        label: What the key calls them.
        x: Where they stand.
        values: The means.
    """
    rows = [(at, *ends_of(value)) for at, value in zip(x, values, strict=True) if not math.isnan(value.value)]
    columns = np.array(rows, np.float64).reshape(-1, 4).T
    return Series(label, *(np.ascontiguousarray(column) for column in columns))


def ends_of(value: Estimate | Rate) -> tuple[float, float, float]:
    """A mean and the ends of its error of 1 sigma: standard error, or Jeffreys interval of a rate."""
    if isinstance(value, Rate):
        return value.value, *value.interval
    return value.value, value.value - value.error, value.value + value.error


Counts = NDArray[np.int64]


@dataclass(slots=True, eq=False)
class SurvivalCounts:
    """Atoms of one kind, by the site that they were expected on.

    Attributes:
        n_expected: int64 (n_rows, n_cols).
        n_seen: int64 (n_rows, n_cols), how many of them the next image shows.
    """

    n_expected: Counts
    n_seen: Counts

    @property
    def rate(self) -> Rate:
        """Of all sites together."""
        return Rate(int(self.n_seen.sum()), int(self.n_expected.sum()))

    @property
    def fractions(self) -> NDArray[np.float64]:
        """For each site, float64 (n_rows, n_cols); NaN where no atom was expected."""
        with np.errstate(invalid="ignore"):
            return np.where(self.n_expected > 0, self.n_seen / np.maximum(self.n_expected, 1), np.nan)

    def add(self, expected: Occupancy, seen: Occupancy) -> None:
        """Count the atoms of one shot."""
        self.n_expected += expected
        self.n_seen += expected & seen


@dataclass(slots=True, eq=False)
class Survival:
    """What became of atoms between an image and the next one.

    It is what the detector saw: an atom that is missed counts as lost, and whatever else stands on its
    site as the atom.

    Attributes:
        moved: Those that were moved, by the site that they were brought to.
        kept: Those that stayed on their site.
        by_cycle: Moved and kept for each cycle, counted from 1 over all rearrangements of the shot.
        n_read: Shots that were looked at.
    """

    moved: SurvivalCounts
    kept: SurvivalCounts
    by_cycle: list[tuple[SurvivalCounts, SurvivalCounts]] = field(
        default_factory=list[tuple[SurvivalCounts, SurvivalCounts]]
    )
    n_read: int = 0

    @classmethod
    def of_nothing(cls, shape: tuple[int, int]) -> Survival:
        """Before any shot is counted, on a grid of this shape."""
        return cls(_nothing(shape), _nothing(shape))

    def add(self, shot: Shot, loads: frozenset[int]) -> None:
        """Count the atoms of a shot.

        Args:
            shot: Its file is read.
            loads: Indices of the steps that load atoms: what comes after them is not what was before.

        Raises:
            RecordingError: The file cannot be read.
        """
        occupancies, cycles, images = shot.occupancies, iter(shot.cycles), shot.summary.images
        loaded_s = [timing.t_start_s for timing in shot.timing if timing.step in loads]
        if len(images) != len(occupancies):
            raise RecordingError(shot.file, "has other images than the index tells of; take it from a backup")
        number = 0
        for i, is_cycle in enumerate(images.cycle):
            made = next(cycles, None) if is_cycle else None
            number += made is not None
            start_s, end_s = images.t_start_s[i - 1] if i else -1.0, images.t_start_s[i]
            if not i or any(start_s <= t_s < end_s for t_s in loaded_s):
                continue
            moved, kept = expected(occupancies[i - 1], made)
            self._count(moved, kept, occupancies[i], number if made is not None else 0)
        self.n_read += 1

    def _count(self, moved: Occupancy, kept: Occupancy, seen: Occupancy, cycle: int) -> None:
        self.moved.add(moved, seen)
        self.kept.add(kept, seen)
        if cycle:
            while len(self.by_cycle) < cycle:
                self.by_cycle.append((_nothing(seen.shape), _nothing(seen.shape)))
            self.by_cycle[cycle - 1][0].add(moved, seen)
            self.by_cycle[cycle - 1][1].add(kept, seen)


def steps_that_load(run: Run) -> frozenset[int]:
    """Indices of the steps of a run's shots that load atoms."""
    resolved: Mapping[str, Any] = run.record.get("resolved") or {}
    steps: Sequence[Mapping[str, Any]] = resolved.get("shot", ())
    return frozenset(i for i, step in enumerate(steps) if "load" in step)


def expected(before: Occupancy, cycle: CycleRecord | None) -> tuple[Occupancy, Occupancy]:
    """Where atoms stand after a cycle if none is lost: those that were moved, and those that stayed.

    Args:
        before: bool (n_rows, n_cols), the image that the cycle was planned on.
        cycle: The cycle; None if nothing was moved.

    Returns:
        Two arrays, bool (n_rows, n_cols).
    """
    atoms, moved = before.copy(), np.zeros_like(before)
    for batch in () if cycle is None else cycle.plan.batches[: cycle.n_batches_played]:
        start, end = batch.from_sites, batch.to_sites[on_grid(batch.to_sites, before.shape)]
        atoms[tuple(start.T)] = moved[tuple(start.T)] = False
        atoms[tuple(end.T)] = moved[tuple(end.T)] = True
    return moved, atoms & ~moved


def _nothing(shape: tuple[int, ...]) -> SurvivalCounts:
    return SurvivalCounts(np.zeros(shape, np.int64), np.zeros(shape, np.int64))


T = TypeVar("T")

A_GLANCE: Final = 60
"""Shots whose files are opened for a picture of everything: about half a second."""
A_LOOK: Final = 500
"""Shots whose files are opened for a picture or a table of their own."""


def spread(shots: Sequence[T], most: int) -> list[T]:
    """At most so many of the shots, evenly spread over the run.

    Example:
        >>> spread(range(10), 4)
        [1, 3, 6, 8]
    """
    n = len(shots)
    return list(shots) if n <= most else [shots[(2 * i + 1) * n // (2 * most)] for i in range(most)]


def part_of(n_read: int, run: Run) -> str:
    """Says that not all shots were opened; nothing if all were.

    Args:
        n_read: How many were.
        run: The run.
    """
    n = len(run.shots)
    return "" if n_read == n else f", {n_read} of {n} shots"


@dataclass(frozen=True, slots=True)
class _Geometry:
    """What the detector's settings say of the sites."""

    sites: Path | None
    frame: tuple[int, int]
    centre_px: tuple[float, float]
    pixel_size: float
    angle: float


@dataclass(frozen=True, slots=True, eq=False)
class _Context:
    grid: SiteGrid
    calibrations: Mapping[str, CalibrationEntry]
    name: str = "detector"


def grid_of(run: Run) -> SiteGrid:
    """The grid of a run's sites, as the recorded profile has it."""
    n_rows, n_cols = run.target.shape
    profile = _mapping(_mapping(run.record.get("resolved")).get("profile"))
    sheared_left = _mapping(profile.get("grid")).get("shear") == -1
    lattice = "square" if run.record.get("lattice") == "square" else "triangular"
    spacing: Any = run.record.get("grid_spacing_m")
    known = isinstance(spacing, float | int) and spacing > 0
    spacing_m = float(spacing) if known else SiteGrid(1, 1).spacing_m
    return SiteGrid(n_rows, n_cols, spacing_m, lattice, -1 if sheared_left else 1)


def sites_of(run: Run) -> KnownSites | None:
    """Where a run's sites are on its frames: as the detector took them.

    That is by the file that the detector's settings name, by the calibration that was copied into the run's
    folder, or by the settings themselves.

    Returns:
        None if the run does not tell, or the file is gone.
    """
    profile = _mapping(_mapping(run.record.get("resolved")).get("profile"))
    told = _mapping(profile.get("detector"))
    try:
        height, width = told["frame"]
        y, x = told["centre_px"]
        file = told.get("sites")
        pixel_size, angle = float(told["pixel_size"]), float(told["angle"])
        geometry = _Geometry(Path(file) if file else None, (height, width), (y, x), pixel_size, angle)
        return known_sites(geometry, _Context(grid_of(run), _copies(run)))
    except (KeyError, TypeError, ValueError, ConfigError):
        return None


def _copies(run: Run) -> dict[str, CalibrationEntry]:
    path = run.path / "calibration_sites.json"
    return {"sites": read_entry(path)} if path.is_file() else {}


def _mapping(value: object) -> Mapping[str, Any]:
    return cast("Mapping[str, Any]", value) if isinstance(value, Mapping) else {}


HIDDEN = 1e-6
"""Shorter times than this, in seconds, are those of a model that counts a stage as nothing."""


def survival_charts(run: Run, survival: Survival) -> tuple[SitesChart, ...]:
    """Maps of the sites: atoms that were moved there, and atoms that stayed."""
    part = part_of(survival.n_read, run)
    return tuple(
        _map(run, tracked, f"{title}: {_percent(tracked.rate)}{part}")
        for title, tracked in (("moved atoms", survival.moved), ("atoms that stayed", survival.kept))
        if tracked.rate.n_trials
    )


def _map(run: Run, tracked: SurvivalCounts, title: str) -> SitesChart:
    target = run.target
    return SitesChart(title, "there on the next image (%)", grid_of(run), tracked.fractions, target.fill)


def _percent(rate: Rate) -> str:
    low, high = rate.interval
    return f"{100 * rate.value:.2f} % ({100 * low:.2f} to {100 * high:.2f})"


def lost_by_cycle(run: Run, survival: Survival) -> CurvesChart | None:
    """The share of the atoms that the next image does not show, for each cycle; None without cycles."""
    cycles = range(1, len(survival.by_cycle) + 1)
    if not cycles:
        return None
    series = [
        series_of(name, cycles, [_lost(pair[kind]) for pair in survival.by_cycle])
        for kind, name in enumerate(("moved", "stayed"))
    ]
    title = f"atoms lost by cycle{part_of(survival.n_read, run)}"
    shown = tuple(one for one in series if len(one.x))
    return CurvesChart(title, "cycle", "lost (%)", shown, whole=True, from_zero=True) if shown else None


def _lost(tracked: SurvivalCounts) -> Rate:
    rate = tracked.rate
    return Rate(rate.n_trials - rate.n, rate.n_trials)


def causes_chart(statistics: Statistics) -> LossCausesChart | None:
    """What a simulation's atoms were lost to; None where that is not known, or none were lost."""
    worst = sorted(statistics.losses.items(), key=lambda item: -item[1].value)
    shown = [(cause.replace("_", " "), loss) for cause, loss in worst if loss.value > 0]
    if not shown:
        return None
    causes, losses = zip(*shown, strict=True)
    means, errors = np.array([[loss.value, loss.error] for loss in losses]).T
    return LossCausesChart(
        "lost in a shot, by cause", "atoms (the simulation's truth)", causes, means, errors
    )


def defects_chart(run: Run, statistics: Statistics) -> DefectsChart | None:
    """How many shots have how many defects in the end, and what independent sites would give."""
    cycles, n_sites = statistics.cycles, run.target.n_atoms
    counts = statistics.defects or (cycles[-1].defects if cycles else ())
    n_shots = sum(counts)
    if not n_shots or not n_sites:
        return None
    where = "on the last image" if statistics.defects else f"after cycle {len(cycles)}"
    number = np.arange(len(counts), dtype=np.float64)
    low, high = np.array([jeffreys(count, n_shots) for count in counts]).T
    shares = Series("shots" if n_shots > 1 else "shot", number, np.array(counts) / n_shots, low, high)
    empty = float(np.dot(counts, number)) / n_shots / n_sites
    title = f"{mean(np.repeat(number, counts))} defects in a shot, {n_shots} of {len(run.shots)} shots"
    return DefectsChart(title, f"defects {where}", shares, binomial(n_sites, empty, len(counts)))


def binomial(n: int, p: float, least: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Probabilities of 0, 1, 2, ... of n independent things that each happen with probability p.

    They go on as far as there is anything to see, and at least so far.

    Example:
        >>> binomial(2, 0.5, 1).tolist()
        [0.25, 0.5, 0.25]
    """
    if p <= 0.0 or p >= 1.0:
        return np.array([float(k == round(n * p)) for k in range(max(least, round(n * p) + 1))])
    steps = [math.log((n - k) / (k + 1)) + math.log(p / (1 - p)) for k in range(n)]
    terms = np.exp(np.concatenate([[0.0], np.cumsum(steps)]) + n * math.log1p(-p))
    seen = np.flatnonzero(terms > 1e-3)
    return terms[: min(n + 1, max(least, int(seen[-1]) + 1 if len(seen) else 0))]


def stages_chart(run: Run, timing: RunTiming) -> StagesChart | None:
    """The stages of a shot against their budgets; None if there is nothing to show."""
    clocks = ("modelled", "this computer") if run.simulated else ("measured",)
    bars: list[StageBar] = []
    for stage in timing.stages:
        if not stage.stage.startswith(STEP):
            session_s = stage.session_s if stage.session_s[0] > HIDDEN else (math.nan, math.nan)
            of = (session_s, stage.host_s) if run.simulated else (session_s,)
            bars.append(StageBar(stage.stage, of, stage.budget_s))
    if not bars:
        return None
    return StagesChart(f"stages of a shot{part_of(timing.n_read, run)}", clocks, tuple(bars))


MAX_MAPS: Final = 6
"""Most maps in a row."""
MIN_FULL: Final = 0.5
"""Part of the cells of all maps that must have a point; below that, points are drawn in their order."""
LOGARITHMIC: Final = 20.0
"""From this ratio of the largest value to the least on, values at equal ratios get a logarithmic axis."""
EQUAL: Final = 0.25
"""Relative difference of ratios that count as equal: "1, 2, 5, 10" does."""

_NUMBER: Final = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(\S*)\Z")
_MICRO: Final = re.compile(r"\bu(?=[msVWK]\b)")


@dataclass(frozen=True, slots=True)
class Axis:
    """A scanned address and its values.

    Attributes:
        address: The address, with those that go together with it.
        words: Its values as written, in the scan's order, each once.
    """

    address: str
    words: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Scanned:
    """The points of a scan.

    Attributes:
        axes: What was scanned: independent addresses, the first slowest.
        places: For each point the index of its value on each axis.
        statistics: For each point what came of its shots.
    """

    axes: tuple[Axis, ...]
    places: tuple[tuple[int, ...], ...]
    statistics: tuple[Statistics, ...]

    def means(self, measure: Measure) -> list[Estimate | Rate]:
        """A measure at each point; where no shot is judged, on the images that ended the last cycles."""
        judged = any(one.defect_free.n_trials for one in self.statistics)
        of = [one if judged or not one.cycles else one.cycles[-1] for one in self.statistics]
        return [measure.of_many(one) for one in of]


def scanned(run: Run) -> Scanned | None:
    """The points of a run's scan that have shots; None without a scan.

    Raises:
        RecordingError: What run.json says of the scan is damaged.
    """
    points = scan_points(run)
    if not points:
        return None
    rows = [tuple(map(clean, row)) for row in run.scan["written"]]
    columns = list(zip(*rows, strict=True))
    addresses = list(map(clean, points[0].written))
    varied = [i for i, column in enumerate(columns) if len({*column}) > 1] or [0]
    together: dict[int, list[str]] = {}
    for i in varied:
        leader = next((k for k in together if _follows(columns[i], columns[k])), i)
        together.setdefault(leader, []).append(addresses[i])
    axes = tuple(
        Axis(" with ".join(names), tuple(dict.fromkeys(columns[i]))) for i, names in together.items()
    )
    written = [tuple(map(clean, point.written.values())) for point in points]
    places = tuple(
        tuple(axis.words.index(row[i]) for axis, i in zip(axes, together, strict=True)) for row in written
    )
    return Scanned(axes, places, tuple(statistics_of(point.shots, run.target) for point in points))


def _follows(values: Sequence[str], others: Sequence[str]) -> bool:
    """Whether each of the others goes with one value only, and that not by chance.

    Of an optimiser's points no two share a value; so where none do, numbers must rise or fall together.
    """
    if len({*zip(values, others, strict=True)}) > len({*others}):
        return False
    numbers, along = _numbers(values), _numbers(others)
    if len({*others}) < len(others) or numbers is None or along is None:
        return True
    steps = np.diff(np.array(numbers[0])[np.argsort(along[0], kind="stable")])
    return bool((steps >= 0).all() or (steps <= 0).all())


def _numbers(words: Sequence[str]) -> tuple[list[float], str] | None:
    """Words as numbers and their unit; None if they are none, or of several units."""
    found = [match for word in words if (match := _NUMBER.match(word.strip()))]
    units = {match[2] for match in found}
    if len(found) < len(words) or len(units) != 1:
        return None
    return [float(match[1]) for match in found], _MICRO.sub("µ", units.pop())


def scan_charts(found: Scanned, measure: Measure) -> tuple[CurvesChart | MapChart, ...]:
    """A measure against what was scanned: a curve for one axis, maps for more.

    Args:
        found: The points.
        measure: What is shown.

    Returns:
        None of them if nothing is known at any point.
    """
    means = found.means(measure)
    if all(math.isnan(one.value) for one in means):
        return ()
    if len(found.axes) == 1:
        return (_curve(found.axes[0], [place[0] for place in found.places], means, measure),)
    n_cells = math.prod(len(axis.words) for axis in found.axes)
    if len({*found.places}) < MIN_FULL * n_cells:
        return (_in_order(found, means, measure),)
    return _maps(found, means, measure)


def _curve(
    axis: Axis, places: Sequence[int], means: Sequence[Estimate | Rate], measure: Measure
) -> CurvesChart:
    title = f"{measure.title} by scanned value"
    numbers = _numbers(axis.words)
    if numbers is None:
        series = series_of("", places, means)
        return CurvesChart(
            title, axis.address, measure.label, (series,), axis.words, from_zero=measure.is_rate
        )
    values, unit = numbers
    rows = sorted(zip((values[place] for place in places), means, strict=True), key=lambda row: row[0])
    series = series_of("", [x for x, _ in rows], [y for _, y in rows])
    x_label = f"{axis.address} ({unit})" if unit else axis.address
    return CurvesChart(
        title,
        x_label,
        measure.label,
        (series,),
        logarithmic=_is_geometric(sorted({*values})),
        from_zero=measure.is_rate,
    )


def _is_geometric(values: Sequence[float]) -> bool:
    if len(values) < 3 or values[0] <= 0 or values[-1] < LOGARITHMIC * values[0]:
        return False
    steps = np.diff(np.log(values))
    return float(np.ptp(steps)) <= 2 * EQUAL * float(steps.mean())


def _in_order(found: Scanned, means: Sequence[Estimate | Rate], measure: Measure) -> CurvesChart:
    """Points of which hardly two share a value, as those of an optimiser."""
    series = series_of("", range(1, len(means) + 1), means)
    title = f"{measure.title} by point of {len(found.axes)} values"
    return CurvesChart(
        title, "point of the scan", measure.label, (series,), whole=True, from_zero=measure.is_rate
    )


def _maps(found: Scanned, means: Sequence[Estimate | Rate], measure: Measure) -> tuple[MapChart, ...]:
    """A map against the last two axes for each combination of the others."""
    *others, y, x = found.axes
    values = np.full([len(axis.words) for axis in found.axes], np.nan)
    for place, one in zip(found.places, means, strict=True):
        values[place] = ends_of(one)[0]
    limits = float(np.nanmin(values)), float(np.nanmax(values))
    combinations = list(product(*(range(len(axis.words)) for axis in others)))
    charts: list[MapChart] = []
    for number, chosen in enumerate(combinations[:MAX_MAPS], start=1):
        at = ", ".join(f"{axis.address} {axis.words[i]}" for axis, i in zip(others, chosen, strict=True))
        more = f" ({number} of {len(combinations)})" if len(combinations) > MAX_MAPS else ""
        title = (at or f"{measure.title} by scanned values") + more
        charts.append(
            MapChart(title, x.address, y.address, x.words, y.words, values[chosen], measure.label, limits)
        )
    return tuple(charts)


def note_of(run: Run) -> str:
    """The line below a picture's title: which run, how it ended, and of what kind it is."""
    ended = "" if run.status == "complete" else f" ({run.status}, {len(run.shots)} of {run.n_shots} shots)"
    atoms = f"{clean(run.target.name)}, {run.target.n_atoms} atoms"
    kind = "simulated" if run.simulated else "measured"
    return f"{clean(run.path.parent.name)}/{clean(run.path.name)}{ended}: {atoms}, seed {run.seed}, {kind}"


def unfit(run: Run, what: str, expected: str, picture: str = "figure") -> ConfigError:
    """An error that says why a picture cannot be drawn from a run.

    Args:
        run: The run.
        what: What is in the way.
        expected: What the picture needs.
        picture: What it is called.
    """
    text = f"the {picture} cannot be drawn from this run: {what}"
    return ConfigError(Problem(text, clean(str(run.path)), expected=expected))


Row = tuple[Chart, ...]


class _Sums:
    """What a run came to, worked out when it is asked for.

    Args:
        run: The run.
        most: Most shots whose files are read.
    """

    def __init__(self, run: Run, most: int) -> None:
        self.run = run
        self._most = most

    @cached_property
    def statistics(self) -> Statistics:
        """Of all shots, from the index."""
        return statistics_of(self.run.shots, self.run.target)

    @cached_property
    def scan(self) -> Scanned | None:
        """Of all shots, from the index; None without a scan."""
        return scanned(self.run)

    @cached_property
    def read(self) -> tuple[Survival, RunTiming]:
        """Of the shots whose files are read; those that cannot be are left out."""
        survival, watch = Survival.of_nothing(self.run.target.shape), StageTotals()
        loads = steps_that_load(self.run)
        for shot in spread(self.run.shots, self._most):
            with suppress(RecordingError):
                survival.add(shot, loads)
                watch.add(shot)  # the file is still in memory
        return survival, watch.sum_up(self.run)


def overview(run: Run) -> RunDrawing:
    """Everything of a run on one sheet.

    What needs the shots' files is worked out of some of them, which the panels say.

    Args:
        run: The run; it may be going on.

    Raises:
        ConfigError: It has no shots yet.
        RecordingError: It is damaged.
    """
    sums = _Sums(_with_shots(run), A_GLANCE)
    filling, success = (_against(sums, measure) for measure in (FILLING, SUCCESS))
    causes, defects = causes_chart(sums.statistics), defects_chart(run, sums.statistics)
    survival, timing = sums.read
    lost = causes or lost_by_cycle(run, survival)
    rows = [
        _there(*filling, defects),
        _there(*success, lost),
        _there(*survival_charts(run, survival), stages_chart(run, timing)),
    ]
    if sums.scan is not None and len(maps := scan_charts(sums.scan, SUCCESS)) > 1:
        rows.insert(2, maps)
    return _drawing(run, f"run {clean(run.name)}", rows)


def picture_of(run: Run, what: str) -> RunDrawing:
    """One part of the overview, alone.

    Args:
        run: The run; it may be going on.
        what: One of :data:`CHOICES`.

    Raises:
        ConfigError: There is no such part, or the run has nothing to show in it; says what it needs.
        RecordingError: It is damaged.
    """
    if what not in CHOICES:
        expected = one_of(sorted(CHOICES))
        raise ConfigError(
            Problem(f"there is no picture '{clean(what)}' of a run", "--what", expected=expected)
        )
    title, draw, expected = CHOICES[what]
    rows = draw(_Sums(_with_shots(run), A_LOOK))
    if not any(rows):
        raise unfit(run, f"there is nothing to show of {title}", expected, "picture")
    return _drawing(run, title, rows)


def _drawing(run: Run, title: str, rows: Sequence[Row]) -> RunDrawing:
    shown = tuple(row for row in rows if row)
    if not shown:
        raise unfit(run, "its shots hold neither images nor cycles", "shots with an 'image' step", "picture")
    return RunDrawing(title, note_of(run), shown)


def _with_shots(run: Run) -> Run:
    if run.shots:
        return run
    what = "it has no shots yet" if run.status == "running" else "it has no shots that count"
    raise unfit(run, what, "at least one complete shot", "picture")


def _against(sums: _Sums, measure: Measure) -> Row:
    """A measure against shot, cycle and scanned value, as far as each there is."""
    target = sums.run.target
    values = [_value(measure, shot, target) for shot in sums.run.shots]
    by_shot = course(sums.run, measure, values) if np.isfinite(values).any() else None
    maps = scan_charts(sums.scan, measure) if sums.scan is not None else ()
    return _there(by_shot, by_cycle(measure, sums.statistics), *(maps if len(maps) == 1 else ()))


def _value(measure: Measure, shot: Shot, target: TargetPattern) -> float:
    try:
        return measure.of_shot(shot, target)
    except RecordingError:  # an index before format 1.1, and the file is damaged
        return math.nan


def _there(*charts: Chart | None) -> Row:
    return tuple(chart for chart in charts if chart is not None)


def _filling(sums: _Sums) -> list[Row]:
    return [_against(sums, FILLING)]


def _success(sums: _Sums) -> list[Row]:
    return [_against(sums, SUCCESS)]


def _survival(sums: _Sums) -> list[Row]:
    return [survival_charts(sums.run, sums.read[0])]


def _defects(sums: _Sums) -> list[Row]:
    return [_there(defects_chart(sums.run, sums.statistics))]


def _timing(sums: _Sums) -> list[Row]:
    return [_there(stages_chart(sums.run, sums.read[1]))]


def _scan(sums: _Sums) -> list[Row]:
    if sums.scan is None:
        return []
    filling, success = (scan_charts(sums.scan, measure) for measure in (FILLING, SUCCESS))
    return [(*filling, *success)] if len(filling) == len(success) == 1 else [filling, success]


def _losses(sums: _Sums) -> list[Row]:
    return [_there(lost_by_cycle(sums.run, sums.read[0]), causes_chart(sums.statistics))]


CHOICES: Final[Mapping[str, tuple[str, Callable[[_Sums], list[Row]], str]]] = MappingProxyType(
    {
        "filling": ("filling", _filling, "shots with an 'image' step or a rearrangement"),
        "success": ("defect-free shots", _success, "shots with an 'image' step or a rearrangement"),
        "survival": ("survival by site", _survival, "readable shots with at least two images"),
        "defects": ("defects that are left", _defects, "shots with an 'image' step or a rearrangement"),
        "timing": ("the stages of a shot", _timing, "readable shots"),
        "scan": ("the scan", _scan, "a run of a sequence with 'scan:'"),
        "losses": ("lost atoms", _losses, "readable shots with a rearrangement"),
    }
)
"""Picture -> its title, what draws it, and what a run needs for it."""
