"""Draws the overview of a run: filling, survival, losses, times and scans."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product, zip_longest
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

import numpy as np

from labseq.analysis.charts import (
    STYLE,
    Panel,
    average_frame_of,
    defects,
    draw_curves,
    draw_map,
    draw_sites,
    loss_causes,
    points_of,
    signals_of_sites,
    stages_of_a_shot,
    trend,
)
from labseq.analysis.scanned import (
    ScanRequest,
    scan_report,
    shown_unit,
    title_of,
)
from labseq.analysis.statistics import Statistics, Survival, SurvivalCounts, statistics_of
from labseq.analysis.timing import STEP, RunTiming, StageTotals
from labseq.calibration_store import read_entry
from labseq.data.fits import Fit
from labseq.data.images import loading_map
from labseq.data.numbers import readable
from labseq.data.quantities import (
    ANALYSE,
    WITH_TARGET,
    Quantity,
    measured_by,
    quantity_of,
    steps_that_load,
    why_no_results,
)
from labseq.data.reader import Run
from labseq.data.results import own_fits
from labseq.data.scanned import FitAt, Scanned, is_geometric, scanned
from labseq.data.shot import Shot
from labseq.data.site_maps import SiteMap, site_map
from labseq.detection.sites import KnownSites, SiteSettings, known_sites
from labseq.errors import ConfigError, Problem, RecordingError, one_of
from labseq.messages import clean, visible
from labseq.model import CalibrationEntry, SiteGrid
from labseq.model.estimate import Estimate, Estimated, Rate
from labseq.model.image_quantities import OF_IMAGES, parse_name
from labseq.pictures.figures import make_figure, save_figure
from labseq.roles import Context
from labseq.units import factor_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

T = TypeVar("T")
Row = tuple[Panel, ...]

PART_SHOTS: Final = 500
"""Maximum number of shot files read for one part of the overview, or for a table."""
MAX_MAPS: Final = 6
"""Maximum number of maps in a row."""
MAX_PANELS: Final = 2
"""Maximum number of panels of a scan in a row."""
PANEL_IN: Final = (3.7, 3.1)
"""Width and height of a panel in inches."""
X_LABEL_WIDTH: Final = 50
"""Maximum length of a line below a panel, in characters."""
TITLE_IN: Final = 0.55


@dataclass(frozen=True, slots=True, eq=False)
class RunPicture:
    """Panels of a run, row by row.

    Attributes:
        title: Title at the top.
        note: Line below the title.
        rows: The panels. No row is empty.
    """

    title: str
    note: str
    rows: tuple[Row, ...]

    def draw(self) -> Figure:
        """Draw all panels."""
        from matplotlib import rc_context

        style: Any = STYLE
        with rc_context(style):
            return self._draw()

    def _draw(self) -> Figure:
        n_rows, n_cols = len(self.rows), max(map(len, self.rows))
        is_single = n_rows == n_cols == 1
        width, height = (6.4, 4.4) if is_single else (n_cols * PANEL_IN[0], n_rows * PANEL_IN[1])
        figure = make_figure(width, height + TITLE_IN, layout="constrained")
        figure.get_layout_engine().set(w_pad=0.08, h_pad=0.08)  # pyright: ignore[reportOptionalMemberAccess, reportCallIssue]
        parts = figure.subfigures(n_rows, 1, squeeze=False)[:, 0]
        for part, panels in zip(parts, self.rows, strict=True):
            for axes, panel in zip(part.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
                panel(axes)
        figure.suptitle(f"{self.title}\n{self.note}".rstrip(), fontsize=10)
        return figure

    def save(self, path: Path) -> None:
        """Save the picture as a PNG, SVG or PDF file.

        Raises:
            ConfigError: The file cannot be written.
        """
        save_figure(path, self.draw, dpi=150)


def overview(run: Run) -> RunPicture:
    """All panels of a run. Panels that need shot files may use part of the shots, as their titles then say.

    Raises:
        ConfigError: The run has no shots yet.
        RecordingError: The run is damaged.
    """
    summary = _Summary(_with_shots(run), 60)  # files of shots, which take half a second to read
    survival, timing = summary.read
    beside = (
        defects_panel(run, summary.statistics),
        loss_causes(summary.statistics.losses) or lost_by_cycle(run, survival),
    )
    names = measured_by(run)
    measured = (_quantity_row(summary, name) for name in names)
    rows = [_present(*(row or ()), panel) for row, panel in zip_longest(measured, beside)]
    # a single panel is in the row of its quantity
    rows += [panels for name in names if len(panels := summary.scan_row(name)) > 1]
    rows.append(_present(*survival_panels(run, survival), stages_panel(run, timing)))
    return _picture(run, f"run {visible(run.name)}", rows)


def picture_of(run: Run, what: str) -> RunPicture:
    """One part of the overview.

    Args:
        what: One of :data:`CHOICES`.

    Raises:
        ConfigError: There is no such part, or the run lacks the data for it. The message says which.
        RecordingError: The run is damaged.
    """
    if what not in CHOICES:
        problem = f"there is no picture '{clean(what)}' of a run"
        raise ConfigError(Problem(problem, "--what", expected=one_of(sorted(CHOICES))))
    title, draw, needed = CHOICES[what]
    rows = draw(_Summary(_with_shots(run), PART_SHOTS))
    if not any(rows):
        raise cannot_draw(run, f"there is nothing to show of {title}", needed)
    return _picture(run, title, rows)


def cycles_panel(quantity: Quantity, statistics: Statistics) -> Panel | None:
    """A fraction against the cycle, from the image at the end of each cycle. None without cycles."""
    cycles = statistics.cycles
    if not cycles:
        return None
    means = [cycle.defect_free if quantity.is_rate else cycle.filling for cycle in cycles]
    fewer = cycles[-1].n_shots < cycles[0].n_shots
    return partial(
        draw_curves,
        title=f"{title_of(quantity)} by cycle" + (", of the shots that made it" if fewer else ""),
        x_label="cycle",
        y_label=f"{title_of(quantity)} (%)",
        curves={"": points_of([cycle.cycle for cycle in cycles], means)},
        whole=True,
        from_zero=quantity.is_rate,
    )


def survival_panels(run: Run, survival: Survival) -> Row:
    """Maps of the sites: survival of moved atoms, and of atoms that stayed."""

    def panel(counts: SurvivalCounts, title: str) -> Panel:
        low, high = counts.rate.interval
        rate = f"{100 * counts.rate.value:.2f} % ({100 * low:.2f} to {100 * high:.2f})"
        return partial(
            draw_sites,
            title=f"{title}: {rate}{part_text(survival.n_read, run)}",
            label="there on the next image (%)",
            grid=grid_of(run),
            values=counts.fractions,
            outlined=run.target.fill,
        )

    both = ((survival.moved, "moved atoms"), (survival.kept, "atoms that stayed"))
    return tuple(panel(counts, title) for counts, title in both if counts.rate.n_trials)


def lost_by_cycle(run: Run, survival: Survival) -> Panel | None:
    """The fraction of atoms missing on the next image, for each cycle. None without cycles."""
    cycles = range(len(survival.by_cycle))
    curves = {
        name: points_of(cycles, [_lost(pair[kind].rate) for pair in survival.by_cycle])
        for kind, name in enumerate(("moved", "stayed"))
    }
    curves = {name: points for name, points in curves.items() if points.size}
    if not curves:
        return None
    title = f"atoms lost by cycle{part_text(survival.n_read, run)}"
    labels = {"x_label": "cycle", "y_label": "lost (%)"}
    return partial(draw_curves, title=title, curves=curves, whole=True, from_zero=True, **labels)


def _lost(rate: Rate) -> Rate:
    return Rate(rate.n_trials - rate.n, rate.n_trials)


def defects_panel(run: Run, statistics: Statistics) -> Panel | None:
    """Histogram of the defects at the end of the shots, compared with independent sites."""
    cycles = statistics.cycles
    counts, end = statistics.defects, "on the last image"
    if not counts and cycles:
        counts, end = cycles[-1].defects, f"after {len(cycles)} cycle{'s' * (len(cycles) != 1)}"
    return defects(counts, run.target.n_atoms, len(run.shots), end)


def stages_panel(run: Run, timing: RunTiming) -> Panel | None:
    """The durations of a shot's stages and their budgets. None without stages."""
    stages = [stage for stage in timing.stages if not stage.stage.startswith(STEP)]
    if not stages:
        return None
    clocks = (
        {"session_s": "modelled", "host_s": "this computer"} if run.simulated else {"session_s": "measured"}
    )
    return stages_of_a_shot(f"stages of a shot{part_text(timing.n_read, run)}", stages, clocks)


def scan_panels(
    scan: Scanned, quantity: Quantity, means: Sequence[Estimated], fits: Sequence[FitAt] = ()
) -> Row:
    """A quantity against the scanned values: a curve for one axis, maps for more. Empty if it is unknown.

    Args:
        means: Mean of the quantity at each point.
    """
    values = [mean.value for mean in means if not math.isnan(mean.value)]
    if not values:
        return ()
    unit, factor = shown_unit(quantity, values)
    label = f"{title_of(quantity)} ({unit})" if unit else title_of(quantity)
    if len(scan.axes) > 1 and scan.is_map:
        maps = _scan_maps(scan, title_of(quantity), [mean.value / factor for mean in means], label)
        return (*maps, *_parameter_panels(scan, fits))
    fit = fits[0].fit if fits else None
    from_zero = quantity.is_rate and (fit is None or quantity.name == "defect_free")
    common: dict[str, Any] = {"y_label": label, "scale": 1 / factor, "from_zero": from_zero}
    if len(scan.axes) == 1:
        return (_scan_curve(scan, title_of(quantity), means, fit, common),)
    return (  # few points share a value, for example those of an optimiser
        partial(
            draw_curves,
            title=f"{title_of(quantity)} by point of {len(scan.axes)} values",
            x_label="point of the scan",
            curves={"": points_of(range(len(means)), means)},
            whole=True,
            **common,
        ),
    )


def _scan_curve(
    scan: Scanned, title: str, means: Sequence[Estimated], fit: Fit | None, common: Mapping[str, Any]
) -> Panel:
    axis, numbers = scan.axes[0], scan.on_axis(0)
    title = f"{title} by scanned value"
    if numbers is None:
        curves = {"": points_of([place[0] for place in scan.places], means)}
        return partial(
            draw_curves, title=title, x_label=axis.address, curves=curves, ticks=axis.labels, **common
        )
    values, unit = numbers
    rows = sorted(zip(values, means, strict=True), key=lambda row: row[0])
    below = [f"{axis.address} ({unit})" if unit else axis.address]
    if fit is not None:  # a legend would hide points, which for an oscillation are everywhere
        below.append(fit.caption())
    return partial(
        draw_curves,
        title=title,
        x_label="\n".join(
            line for text in below for line in textwrap.wrap(text, X_LABEL_WIDTH, break_on_hyphens=False)
        ),
        curves={"": points_of([x for x, _ in rows], [y for _, y in rows])},
        logarithmic=is_geometric(sorted({*values})),
        line=None if fit is None else partial(_fitted, fit, factor_of(unit)),
        **common,
    )


def _parameter_panels(scan: Scanned, fits: Sequence[FitAt]) -> Row:
    """Each fitted parameter against the remaining axis. Empty if there are several remaining axes."""
    made = [(at, at.fit) for at in fits if at.fit is not None]
    if not made or len(made[0][0].values) != 1:
        return ()
    (address,) = made[0][0].values
    axis = next(axis for axis in scan.axes if axis.address == address)
    numbers, unit = axis.numbers or (tuple(range(len(axis.labels))), "")
    x = [numbers[axis.labels.index(at.written[address])] for at, _ in made]
    panels: list[Panel] = []
    for name in dict.fromkeys(name for _, fit in made for name in fit.free):
        parameters = [fit.parameters[name] for _, fit in made]
        shown, factor = readable(max(abs(one.value) for one in parameters), parameters[0].text_unit)
        panels.append(
            partial(
                draw_curves,
                title=f"{name} of the {made[0][1].model} fits",
                x_label=f"{address} ({unit})" if unit else address,
                y_label=f"{name} ({shown})" if shown else name,
                curves={"": points_of(x, [Estimate(one.value, one.error) for one in parameters])},
                ticks=() if axis.numbers else axis.labels,
                scale=1 / factor,
            )
        )
    return tuple(panels)


def _fitted(fit: Fit, factor: float, x: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """The fitted function at values in the unit of the axis."""
    return fit.at(x * factor)


def _scan_maps(scan: Scanned, title: str, means: Sequence[float], label: str) -> Row:
    """A map against the last two axes for each combination of the other axes."""
    *others, y, x = scan.axes
    values = np.full([len(axis.labels) for axis in scan.axes], np.nan)
    for place, mean in zip(scan.places, means, strict=True):
        values[place] = mean
    combinations = list(product(*(range(len(axis.labels)) for axis in others)))
    panels: list[Panel] = []
    for index, indices in enumerate(combinations[:MAX_MAPS]):
        at = ", ".join(f"{axis.address} {axis.labels[i]}" for axis, i in zip(others, indices, strict=True))
        more = f" ({index + 1} of {len(combinations)})" if len(combinations) > MAX_MAPS else ""
        panels.append(
            partial(
                draw_map,
                title=(at or f"{title} by scanned values") + more,
                x_label=x.address,
                y_label=y.address,
                x_ticks=x.labels,
                y_ticks=y.labels,
                values=values[indices],
                label=label,
                limits=(float(np.nanmin(values)), float(np.nanmax(values))),  # the same in all maps
            )
        )
    return tuple(panels)


def scan_picture(run: Run, request: ScanRequest) -> RunPicture:
    """Quantities at the points of a scan, with their fits.

    Raises:
        ConfigError: The run has no scan, or see :func:`labseq.analysis.scanned.scan_report`.
    """
    report = scan_report(_with_shots(run), request)
    if not report.scan.axes:
        expected = "a run of a sequence with 'scan:'; `labseq show --scan` prints the values of this run"
        raise cannot_draw(run, "it has no scan", expected)
    fits = report.fits or ((),) * len(report.values)
    rows = [
        scan_panels(report.scan, quantity, means, fits_of_quantity)
        for (quantity, means), fits_of_quantity in zip(report.values, fits, strict=True)
    ]
    panels = [panel for row in rows for panel in row]
    if not panels:
        name = report.values[0][0].name
        why = why_no_results(run, name)
        raise cannot_draw(
            run, why or f"no shot has a value of '{clean(name)}'", ANALYSE if why else "shots with it"
        )
    return _picture(run, "the scan", [tuple(panels)] if len(panels) <= MAX_PANELS else rows)


def map_picture(run: Run, names: Sequence[str]) -> RunPicture:
    """Quantities of the images at each site, and how far each site is from the mean.

    Args:
        names: The quantities. Empty for the quantities that the run measures.

    Raises:
        ConfigError: There is no such quantity, or it has no value for a site.
    """
    of_sites = [name for name in measured_by(run) if parse_name(name).kind in OF_IMAGES]
    shots = evenly(_with_shots(run).shots, PART_SHOTS)
    rows = [_map_panels(run, site_map(run, name, shots)) for name in names or of_sites]
    if not rows:
        raise cannot_draw(run, "it measures no quantity of its images", "--map QUANTITY")
    return _picture(run, "quantities by site", rows)


def _map_panels(run: Run, sites: SiteMap) -> Row:
    title = clean(sites.name)
    if not sites.n_trials.any():
        raise cannot_draw(run, f"no shot has a value of '{title}'", "readable shots with its images")
    n_trials = sites.n_trials[sites.n_trials > 0]
    unit = "atom" if parse_name(sites.name).kind == "survival" else "shot"
    each = f"{n_trials.min()}" if np.ptp(n_trials) == 0 else f"{n_trials.min()} to {n_trials.max()}"
    share = f"{100 * sites.mean:.1f} %"
    site: dict[str, Any] = {"grid": grid_of(run), "outlined": run.target.fill}
    return (
        partial(
            draw_sites,
            title=f"{title}: {share}\n{each} {unit}s a site{part_text(sites.n_shots, run)}",
            label=f"{title} (%)",
            values=sites.values,
            **site,
        ),
        partial(
            draw_sites,
            title="difference from the mean,\nin errors of the site",
            label="standard errors",
            values=sites.deviations,
            limit=max(3.0, float(np.nanmax(np.abs(sites.deviations), initial=0.0))),
            **site,
        ),
    )


class _Summary:
    """Sums over a run, computed on first use.

    Args:
        max_read: Maximum number of shots whose files are read.
    """

    def __init__(self, run: Run, max_read: int) -> None:
        self.run = run
        self._max_read = max_read
        self._scan_rows: dict[str, Row] = {}

    @cached_property
    def statistics(self) -> Statistics:
        """Statistics of all shots, from the index."""
        return statistics_of(self.run.shots, self.run.target)

    @cached_property
    def scan(self) -> Scanned | None:
        """The points of the scan, from the index. None without a scan."""
        return scanned(self.run)

    def quantity(self, name: str) -> Quantity:
        """A quantity of the run."""
        return quantity_of(self.run, name)

    def scan_row(self, name: str) -> Row:
        """A quantity at the points of the scan, with the fits of the sequence. Empty without a scan."""
        if self.scan is None:
            return ()
        if name not in self._scan_rows:
            quantity = self.quantity(name)
            means = self.scan.over(quantity)
            fits = own_fits(self.run, self.scan, quantity, means)
            self._scan_rows[name] = scan_panels(self.scan, quantity, means, fits)
        return self._scan_rows[name]

    @cached_property
    def read(self) -> tuple[Survival, RunTiming]:
        """Survival and times, from the files of some shots. Unreadable files are left out."""
        # both in one pass, so that each file is read once
        survival, totals = Survival.empty(self.run.target.shape), StageTotals()
        loads = steps_that_load(self.run)
        # from all parts of the run, as its beginning may differ from its end
        for shot in evenly(self.run.shots, self._max_read):
            with suppress(RecordingError):
                survival.add(shot, loads)
                totals.add(shot)
        return survival, totals.sum_up(self.run)


def _quantity_row(summary: _Summary, name: str) -> Row:
    """A quantity against shot, cycle and scanned value, where available."""
    quantity = summary.quantity(name)
    panels, shots = summary.scan_row(name), summary.run.shots
    by_cycle = cycles_panel(quantity, summary.statistics) if name in WITH_TARGET else None
    values = np.array([quantity.of_shot(shot) for shot in shots])
    indices = np.array([float(shot.index) for shot in shots])
    unit, factor = shown_unit(quantity, values.tolist())
    by_shot = trend(
        title_of(quantity),
        indices,
        values,
        is_yes_or_no=name in ("defect_free", "success"),
        unit=unit,
        scale=1 / factor,
    )
    return _present(by_shot, by_cycle, *(panels if len(panels) == 1 else ()))


def _scan_rows(summary: _Summary) -> list[Row]:
    return [] if summary.scan is None else [*scan_picture(summary.run, ScanRequest()).rows]


def _image_rows(summary: _Summary, draw: Callable[[Sequence[Shot]], Panel]) -> list[Row]:
    """The panel of an image. Empty if no shot has the data for it."""
    with suppress(RecordingError):
        return [(draw(evenly(summary.run.shots, PART_SHOTS)),)]
    return []


def loading_panel(run: Run, shots: Sequence[Shot]) -> Panel:
    """The fraction of shots with an atom on each site, on the first image."""
    values, n = loading_map(shots)
    title = f"loading: {100 * values.mean():.1f} % on the first image of {n} shots"
    site: dict[str, Any] = {"grid": grid_of(run), "outlined": run.target.fill}
    return partial(draw_sites, title=title, label="with an atom (%)", values=values, **site)


def _present(*panels: Panel | None) -> Row:
    return tuple(panel for panel in panels if panel is not None)


def _picture(run: Run, title: str, rows: Sequence[Row]) -> RunPicture:
    nonempty_rows = tuple(row for row in rows if row)
    if not nonempty_rows:
        raise cannot_draw(run, "its shots have neither images nor cycles", "shots with an 'image' step")
    return RunPicture(title, note_of(run), nonempty_rows)


def _with_shots(run: Run) -> Run:
    if run.shots:
        return run
    problem = "it has no shots yet" if run.status == "running" else "it has no shots that count"
    raise cannot_draw(run, problem, "at least one complete shot")


_WITH_IMAGES: Final = "shots with an 'image' step or a rearrangement"

CHOICES: Final[Mapping[str, tuple[str, Callable[[_Summary], list[Row]], str]]] = MappingProxyType(
    {
        "image": (
            "the average image",
            lambda s: _image_rows(s, partial(average_frame_of, s.run)),
            "shots whose frames were kept: 'record_frames: all' in the sequence, or --set record_frames=all",
        ),
        "loading": (
            "the loading",
            lambda s: _image_rows(s, partial(loading_panel, s.run)),
            "readable shots with an image",
        ),
        "counts": (
            "the detector's signals",
            lambda s: _image_rows(s, signals_of_sites),
            "a detector that reports its signals",
        ),
        "filling": ("filling", lambda s: [_quantity_row(s, "filling")], _WITH_IMAGES),
        "success": ("defect-free shots", lambda s: [_quantity_row(s, "defect_free")], _WITH_IMAGES),
        "survival": (
            "survival by site",
            lambda s: [survival_panels(s.run, s.read[0])],
            "readable shots with at least two images",
        ),
        "defects": (
            "defects that are left",
            lambda s: [_present(defects_panel(s.run, s.statistics))],
            _WITH_IMAGES,
        ),
        "timing": (
            "the stages of a shot",
            lambda s: [_present(stages_panel(s.run, s.read[1]))],
            "readable shots",
        ),
        "scan": ("the scan", _scan_rows, "a run of a sequence with 'scan:'"),
        "losses": (
            "lost atoms",
            lambda s: [_present(lost_by_cycle(s.run, s.read[0]), loss_causes(s.statistics.losses))],
            "readable shots with a rearrangement",
        ),
    }
)
"""Part of the overview -> its title, function for its panels, and the data that it needs."""


def evenly(shots: Sequence[T], n_most: int) -> list[T]:
    """Select at most ``n_most`` shots, evenly distributed over the run.

    Example:
        >>> evenly(range(10), 4)
        [1, 3, 6, 8]
    """
    n = len(shots)
    return list(shots) if n <= n_most else [shots[(2 * i + 1) * n // (2 * n_most)] for i in range(n_most)]


def part_text(n_read: int, run: Run) -> str:
    """The number of shots that were read, as text. "" if all were read."""
    n = len(run.shots)
    return "" if n_read == n else f", {n_read} of {n} shots"


def note_of(run: Run) -> str:
    """The line below a picture's title: the run, its status, target and seed."""
    ended = "" if run.status == "complete" else f" ({run.status}, {len(run.shots)} of {run.n_shots} shots)"
    target = run.target
    atoms = "no target" if target.is_none else f"{clean(target.name)}, {target.n_atoms} atoms"
    kind = "simulated" if run.simulated else "measured"
    name = visible(f"{run.path.parent.name}/{run.path.name}")
    return f"{name}{ended}: {atoms}, seed {run.seed}, {kind}"


def cannot_draw(run: Run, problem: str, expected: str) -> ConfigError:
    """The error for a picture that cannot be drawn from a run."""
    text = f"the picture cannot be drawn from this run: {problem}"
    return ConfigError(Problem(text, visible(str(run.path)), expected=expected))


def grid_of(run: Run) -> SiteGrid:
    """The grid of sites in the recorded profile of a run."""
    n_rows, n_cols = run.target.shape
    grid = _mapping(_profile(run).get("grid"))
    spacing: Any = run.record.get("grid_spacing_m")
    is_recorded = isinstance(spacing, float | int) and spacing > 0
    spacing_m = float(spacing) if is_recorded else SiteGrid(1, 1).spacing_m
    lattice = "square" if run.record.get("lattice") == "square" else "triangular"
    return SiteGrid(n_rows, n_cols, spacing_m, lattice, -1 if grid.get("shear") == -1 else 1)


def sites_of(run: Run) -> KnownSites | None:
    """The positions of a run's sites on its frames, as the detector used them.

    They come from the file in the detector's settings, the calibration in the run's folder, or
    the settings.

    Returns:
        None if the run does not contain them, or the file is missing.
    """
    detector = _mapping(_profile(run).get("detector"))
    names = ("frame", "centre_px", "pixel_size", "angle")
    try:
        settings = SiteSettings(sites=detector.get("sites"), **{name: detector[name] for name in names})
        calibration = run.path / "calibration_sites.json"
        calibrations: dict[str, CalibrationEntry] = {}
        if calibration.is_file():
            calibrations["sites"] = read_entry(calibration)
        return known_sites(settings, Context("detector", grid_of(run), calibrations=calibrations))
    except (KeyError, TypeError, ValueError, ConfigError):
        return None


def _profile(run: Run) -> Mapping[str, Any]:
    return _mapping(_mapping(run.record.get("resolved")).get("profile"))


def _mapping(value: object) -> Mapping[str, Any]:
    return cast("Mapping[str, Any]", value) if isinstance(value, Mapping) else {}
