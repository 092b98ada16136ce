"""`labseq compare` and `labseq trend`: results of several runs, overlaid or over time."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from labseq.analysis.charts import COLOURS, draw_curves, points_of
from labseq.analysis.overview import RunPicture
from labseq.analysis.scanned import shown_unit, title_of, value_text
from labseq.console.output import say
from labseq.console.report import aligned, filled_columns, print_report
from labseq.console.runs import chosen_run
from labseq.console.text import plural
from labseq.data.catalogue import runs
from labseq.data.described import read_entry
from labseq.data.entry import RunEntry
from labseq.data.fits import Fit
from labseq.data.numbers import Parameter, Result, readable
from labseq.data.quantities import Quantity, find_quantity, measured_by
from labseq.data.reader import Run
from labseq.data.results import as_parameter, own_fits, reported
from labseq.data.scanned import Axis, is_geometric, scanned
from labseq.errors import ConfigError, LabseqError, Problem
from labseq.messages import clean
from labseq.model.estimate import Estimate, Estimated
from labseq.pictures.figures import check_place
from labseq.units import factor_of, si_unit_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """A quantity of one of the compared runs.

    Attributes:
        entry: The run as an entry in the list of runs.
        quantity: The quantity.
        mean: Its mean over all shots.
        axis: The scanned address. None without a scan of one numerical value.
        x: The scanned value at each point, in the unit of the axis, rising.
        means: The quantity at each point.
        fit: The fit that the run's sequence asks for. None if there is none or it failed.
        result: The parameter of the fit that the sequence reports.
    """

    entry: RunEntry
    quantity: Quantity
    mean: Estimated
    axis: Axis | None
    x: Sequence[float]
    means: Sequence[Estimated]
    fit: Fit | None
    result: Result | None

    @classmethod
    def of(cls, run: Run, name: str) -> Compared:
        """Evaluate a quantity of a run.

        Raises:
            ConfigError: The run has no such quantity.
            RecordingError: The run is damaged.
        """
        quantity, scan = find_quantity(run, name), scanned(run)
        on_axis = scan.on_axis(0) if scan is not None and len(scan.axes) == 1 else None
        means = [] if scan is None else scan.over(quantity)
        fits = own_fits(run, scan, quantity, means) if scan is not None and on_axis else []
        fit, result = (fits[0].fit, reported(run, quantity, fits[0])) if fits else (None, None)
        x, axis = list[float](), None
        if scan is not None and on_axis is not None:
            axis, order = scan.axes[0], np.argsort(on_axis[0], kind="stable")
            x, means = [on_axis[0][i] for i in order], [means[i] for i in order]
        return cls(read_entry(run.path), quantity, quantity.over(run.shots), axis, x, means, fit, result)


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Several runs and a quantity that all of them have."""

    runs: tuple[Compared, ...]

    @classmethod
    def of(cls, opened: Sequence[Run], name: str | None = None) -> Comparison:
        """Compare runs by a quantity. Default: what the first run measures.

        Raises:
            ConfigError: A run has no such quantity.
            RecordingError: A run is damaged.
        """
        wanted = name or measured_by(opened[0])[0]
        return cls(tuple(Compared.of(run, wanted) for run in opened))

    @property
    def _settings(self) -> list[dict[str, str]]:
        """The changed settings of each run that are not the same in all runs."""
        all_changes = [{"sequence": run.entry.name, **run.entry.changes} for run in self.runs]
        common = set.intersection(*({*changes.items()} for changes in all_changes))
        return [{a: v for a, v in changes.items() if (a, v) not in common} for changes in all_changes]

    def as_json(self) -> dict[str, Any]:
        """The runs with their values, fits and differing settings."""
        compared = [
            {
                "run": run.entry.id,
                "quantity": run.quantity.name,
                "mean": run.mean,
                "fit": run.fit,
                "settings": settings,
                "note": run.entry.note,
            }
            for run, settings in zip(self.runs, self._settings, strict=True)
        ]
        return {"runs": compared}

    def as_text(self) -> list[str]:
        """A row for each run: mean over all shots, fitted values, and settings in which the runs differ."""
        names = list(dict.fromkeys(name for run in self.runs if run.fit for name in run.fit.free))
        rows = [("run", title_of(self.runs[0].quantity), *names, "chi-square", "shots", "settings", "note")]
        for run, settings in zip(self.runs, self._settings, strict=True):
            fit = run.fit
            fitted = [str(fit.parameters[name]) if fit and name in fit.parameters else "-" for name in names]
            rows.append(
                (
                    run.entry.number,
                    value_text(run.mean, run.quantity, short=True),
                    *fitted,
                    "-"
                    if fit is None or math.isnan(fit.reduced_chi_square)
                    else f"{fit.reduced_chi_square:.2f}",
                    str(run.entry.shots),
                    clean(", ".join(f"{address}={value}" for address, value in settings.items())),
                    clean(run.entry.note),
                )
            )
        return aligned(filled_columns(rows))

    def picture(self) -> RunPicture:
        """The scans of the runs in one panel, with their fits. Without scans, the means side by side.

        Raises:
            ConfigError: The runs scan different addresses, or no shot has a value.
        """
        addresses = {run.axis.address if run.axis else "" for run in self.runs}
        if len(addresses) > 1:
            what = "the runs have not scanned the same value"
            raise ConfigError(
                Problem(what, expected="runs with the same scan, of one number, or without any")
            )
        values = [
            one.value for run in self.runs for one in (run.mean, *run.means) if not math.isnan(one.value)
        ]
        if not values:
            raise ConfigError(Problem(f"no shot has a value of '{clean(self.runs[0].quantity.name)}'"))
        unit, factor = shown_unit(self.runs[0].quantity, values)
        title = title_of(self.runs[0].quantity)
        label = f"{title} ({unit})" if unit else title
        panel = partial(self._draw_scans, factor=factor, label=label)
        if addresses == {""}:
            panel = partial(
                draw_curves,
                title=f"{title} over all shots",
                x_label="run",
                y_label=label,
                curves={"": points_of(range(len(self.runs)), [run.mean for run in self.runs])},
                ticks=[run.entry.number for run in self.runs],
                scale=1 / factor,
            )
        return RunPicture(f"{title} of {plural(len(self.runs), 'run')}", "", ((panel,),))

    def _draw_scans(self, axes: Axes, *, factor: float, label: str) -> None:
        from matplotlib import colormaps

        shades = colormaps[COLOURS](np.linspace(0.0, 0.85, len(self.runs)))
        first = self.runs[0].axis
        assert first is not None
        assert first.numbers is not None
        unit = first.numbers[1]
        for run, colour in zip(self.runs, shades, strict=True):
            assert run.axis is not None
            assert run.axis.numbers is not None
            to_shown = factor_of(run.axis.numbers[1]) / factor_of(unit)  # runs may be written in other units
            x, y, low, high = points_of([value * to_shown for value in run.x], run.means)
            bars = np.nan_to_num([y - low, high - y]).clip(min=0.0) / factor
            look: dict[str, Any] = {"color": colour, "marker": "o", "markersize": 4, "capsize": 2}
            style = "none" if run.fit else "-"
            axes.errorbar(x, y / factor, bars, linestyle=style, label=_legend(run), linewidth=0.9, **look)
            if run.fit is not None:
                curve = np.linspace(x.min(), x.max(), 200)
                axes.plot(curve, run.fit.at(curve * factor_of(unit)) / factor, color=colour, linewidth=1.2)
        if is_geometric(sorted({*self.runs[0].x})):
            axes.set_xscale("log")
        x_label = f"{first.address} ({unit})" if unit else first.address
        axes.set(xlabel=x_label, ylabel=label)
        axes.legend()


def _legend(run: Compared) -> str:
    return run.entry.number if run.result is None else f"{run.entry.number}: {run.result}"


@dataclass(frozen=True, slots=True)
class TrendPoint:
    """A number in one of the runs.

    Attributes:
        entry: The run.
        value: The number.
        new_calibrations: Kinds of calibrations that changed since the run before.
    """

    entry: RunEntry
    value: Parameter
    new_calibrations: tuple[str, ...]

    @property
    def began(self) -> datetime:
        """When the run began, by this computer's clock."""
        return datetime.fromisoformat(self.entry.t_start_utc).astimezone()


@dataclass(frozen=True, slots=True)
class Trend:
    """A number in the runs of a data folder, the oldest first."""

    name: str
    points: tuple[TrendPoint, ...]

    @classmethod
    def of(cls, name: str, data: Path | None, conditions: Mapping[str, Any]) -> Trend:
        """Look up a number in all runs that meet conditions, see :func:`labseq.data.catalogue.runs`.

        Args:
            name: A fitted parameter, a quantity, or a setting that was changed by ``--set``.
            conditions: Arguments of that function.

        Raises:
            ConfigError: No run has the number, or a condition cannot be read.
        """
        points, before, others = list[TrendPoint](), dict[str, str](), dict[str, None]()
        for entry in reversed([*runs(data, **conditions)]):
            value = _number(entry, name)
            others |= dict.fromkeys(result.name for result in entry.results)
            if value is None or not entry.t_start_utc:
                continue
            new = tuple(
                kind for kind, id_ in entry.calibrations.items() if points and before.get(kind) != id_
            )
            points.append(TrendPoint(entry, value, new))
            before |= entry.calibrations
        if not points:
            expected = f"one of {', '.join(map(clean, others))}" if others else "runs with results"
            raise ConfigError(Problem(f"no run has a value '{clean(name)}'", expected=expected))
        return cls(name, tuple(points))

    def as_json(self) -> dict[str, Any]:
        """The runs with their values."""
        points = [
            {
                "run": point.entry.id,
                "t_start_utc": point.entry.t_start_utc,
                **point.value.as_json(),
                "new_calibrations": point.new_calibrations,
            }
            for point in self.points
        ]
        return {"name": self.name, "points": points}

    def as_text(self) -> list[str]:
        """A row for each run."""
        rows = [("run", "began", clean(self.name), "new calibrations", "note")]
        for point in self.points:
            calibrations, note = ", ".join(point.new_calibrations), clean(point.entry.note)
            began = f"{point.began:%Y-%m-%d %H:%M}"
            rows.append((point.entry.number, began, _text(point.value), calibrations, note))
        return aligned(filled_columns(rows))

    def picture(self) -> RunPicture:
        """The number against the time, with a line where a calibration has changed.

        Raises:
            ConfigError: The number has several units, such as the centres of scans of time and frequency.
        """
        units = list(dict.fromkeys(point.value.text_unit for point in self.points))
        if len(units) > 1:
            what = f"'{clean(self.name)}' has several units: {' and '.join(unit or 'none' for unit in units)}"
            expected = "runs in which it has one unit, for example by --sequence"
            raise ConfigError(Problem(what, expected=expected))
        n_runs = plural(len(self.points), "run")
        return RunPicture(f"{clean(self.name)} of {n_runs}", "", ((self._draw,),))

    def _draw(self, axes: Axes) -> None:
        from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num

        parameters = [point.value for point in self.points]
        unit, factor = readable(max(abs(one.value) for one in parameters), parameters[0].text_unit)
        times: list[float] = [float(date2num(point.began)) for point in self.points]
        curve = points_of(times, [Estimate(one.value, one.error) for one in parameters])
        label = f"{clean(self.name)} ({unit})" if unit else clean(self.name)
        draw_curves(axes, title="", x_label="began", y_label=label, curves={"": curve}, scale=1 / factor)
        for time, point in zip(times, self.points, strict=True):
            if point.new_calibrations:
                axes.axvline(time, color="0.5", linestyle=":", linewidth=1.0, zorder=1)
                at: dict[str, Any] = {"xytext": (2, -2), "textcoords": "offset points", "rotation": 90}
                text = ", ".join(point.new_calibrations)
                axes.annotate(text, (time, 1), xycoords=("data", "axes fraction"), va="top", fontsize=7, **at)
        locator = AutoDateLocator()
        axes.xaxis.set_major_locator(locator)
        axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))


def _number(entry: RunEntry, name: str) -> Parameter | None:
    """A number of a run: a result, a changed setting, or a quantity of its shots. None if it has none."""
    for result in entry.results:
        if result.name == name and not result.at:
            return result.value
    if isinstance(setting := entry.settings.get(name), int | float):
        return Parameter(float(setting), math.nan, si_unit_of(entry.changes[name]))
    with suppress(LabseqError):
        run = entry.open()
        quantity = find_quantity(run, name)
        value = as_parameter(quantity, quantity.over(run.shots))
        return None if math.isnan(value.value) else value
    return None


def _text(value: Parameter) -> str:
    return str(value).removesuffix(" (fixed)")


def compare_runs(paths: Sequence[Path], name: str | None, output: Path | None, *, as_json: bool) -> None:
    """Print runs side by side, and draw their scans in one panel."""
    comparison = Comparison.of([chosen_run(path) for path in paths], name)
    _print_and_draw(comparison, output, as_json=as_json)


def show_trend(
    name: str, data: Path | None, conditions: Mapping[str, Any], output: Path | None, *, as_json: bool
) -> None:
    """Print a number of many runs, and draw it over time."""
    _print_and_draw(Trend.of(name, data, conditions), output, as_json=as_json)


def _print_and_draw(report: Comparison | Trend, output: Path | None, *, as_json: bool) -> None:
    if output is not None:
        check_place(output)
    print_report(report, as_json=as_json)
    if output is not None:
        report.picture().save(output)
        say(f"written: {output}", stream=sys.stderr)
