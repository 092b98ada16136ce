"""Draw the paper's figures 4 and 5, from runs or from the simulated tables.

    python docs/make_paper_figures.py --figure 5 RUN [RUN2] --output figure5.png
    python docs/make_paper_figures.py --shots-4 10000 --shots-5 10000

The first command draws a run of ``sequences/figure5_multicycle.yaml`` or ``figure4_dop_scan.yaml``, or two
runs to compare. The second takes many shots of these sequences with labseq's sequencer, keeps their sums
instead of files, draws the figures of the documentation, and writes the tables of its page, with the
differences from the paper in standard errors. Seeds are fixed. Both figures continue from their tables, so
a long simulation can be stopped. A table names its planner, and is begun again with another one; after any
other change that matters, delete the tables first.
"""

from __future__ import annotations

import argparse
import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from labseq import Run, Session, ShotRecord, open_run
from labseq.analysis.statistics import Statistics, statistics_of
from labseq.data.points import scan_points
from labseq.files import write_file
from labseq.model.estimate import Estimate, Rate
from labseq.model.policies import RunPolicy
from labseq.sequencer.run import Sequencer

DOCS = Path(__file__).parent
SEQUENCES = DOCS.parent / "sequences"
FIGURES = DOCS / "_static" / "paper"
PAGE = DOCS / "explanation" / "virtual-lab.md"

FIGURE_4, FIGURE_5 = "figure4_dop_scan.yaml", "figure5_multicycle.yaml"
DOP = "planner.degree_of_parallelism"

DARK, LIGHT, ORANGE, LIGHT_ORANGE, RED, GREY = "#1f4e8c", "#86b6e0", "#f28e2b", "#f7c48f", "#c8102e", "0.5"

PAPER_ATOMS = 225
PAPER_LIFETIME_S = 33.0
PAPER_FILLING = ((7, 0.9766, 0.0004),)
"""Degree of parallelism, filling after one cycle, its error (figure 4)."""
PAPER_DEFECT_FREE = ((1, 0.015, 0.003), (2, 0.169, 0.008), (10, 0.33, 0.01))
"""Cycles, defect-free probability, its error (figure 5)."""

PLANNER_KEYS = ("variant", "lanes")
"""Settings of a planner that say which algorithm it is."""
FEWEST = ("planner.variant=fewest",)
"""Overrides for the generalised PSCA."""
UNTUNED = (
    "profile.simulation.transport_loss_spread=0",
    "profile.simulation.imaging_loss=0.314 %",
)
"""Overrides of the profile `paper`, after which only the loss of a moved atom is fitted."""
GRID = ("planner={use: grid, degree_of_parallelism: 7, lanes: weaving}",)
"""Overrides for the planner `grid`."""
SERIES_5: dict[str, tuple[str, tuple[str, ...]]] = {
    "figure5": ("the sequence as it is", ()),
    "figure5_fewest": ("the generalised PSCA", FEWEST),
    "figure5_no_repair": ("the same, repair off", (*FEWEST, "planner.repair_below=0")),
    "figure5_grid": ("`grid`", GRID),
    "figure5_untuned": ("only the loss per atom fitted", UNTUNED),
    "figure5_pairs": ("pairs leave one atom", ("profile.simulation.pair_survival=66.7 %",)),
}
"""Table of each series of figure 5 -> its name and its overrides."""
DRAWN_5 = ("figure5", "figure5_fewest")
SEED_5, PART_5, PART_4 = 51, 250, 250


@dataclass
class Tally:
    """A recorder that keeps what the figures need of each shot."""

    defects: list[list[int]] = field(default_factory=list[list[int]])
    n_atom_moves: list[list[int]] = field(default_factory=list[list[int]])
    target: Any = None

    def write_shot(self, shot: ShotRecord) -> None:
        images = [image for image in shot.images if image.cycle >= 0]
        self.defects.append([int(self.target.n_defects(image.occupancy)) for image in images])
        played = [list(cycle.plan.batches)[: cycle.n_batches_played] for cycle in shot.cycles]
        self.n_atom_moves.append([sum(len(b) for b in batches if not b.linked) for batches in played])
        shot.images.clear()


SUMS = ("filling", "filling_squared")
"""Columns of a table of figure 4: means over the shots."""


class Filled(NamedTuple):
    """Shots of a point of figure 4: their number, the mean filling and the mean of its square."""

    shots: int
    filling: float
    squared: float

    @property
    def error(self) -> float:
        """Standard error of the mean filling."""
        return math.sqrt(max(self.squared - self.filling**2, 0.0) / self.shots)

    def with_shots(self, filling: NDArray[np.float64]) -> Filled:
        """These shots and more, of which the filling is given."""
        n = self.shots + len(filling)
        means = (
            (self.shots * mean + more.sum()) / n
            for mean, more in ((self.filling, filling), (self.squared, filling**2))
        )
        return Filled(n, *(float(mean) for mean in means))


class NoObserver:
    """Ignores the events of a run."""

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        del name, values


def planner_text(settings: Mapping[str, Any]) -> str:
    """Which algorithm a planner is: "psca variant=paper"; ``settings`` are all it has, and "use"."""
    return " ".join([settings["use"], *(f"{key}={settings[key]}" for key in PLANNER_KEYS if key in settings)])


def planner_of(sequence: str, overrides: Sequence[str] = ()) -> str:
    """Which algorithm plans in a sequence."""
    return planner_text(Session.open(SEQUENCES / sequence, overrides=overrides).assembly.planner.dump())


def points_4() -> list[tuple[int, int]]:
    """Degree of parallelism and window in ms of each point of the sequence of figure 4."""
    assembly = Session.open(SEQUENCES / FIGURE_4).assembly
    assert assembly.scanned is not None
    points = [assembly.at(i).parameters for i in range(assembly.scanned.scan.n_points)]
    return [(int(point[DOP]), round(1e3 * point["shot.2.rearrange.window"])) for point in points]


def take(sequence: str, shots: Sequence[int], overrides: Sequence[str], seed: int) -> Tally:
    """Take the shots of a sequence, and keep what the figures need."""
    session = Session.open(SEQUENCES / sequence, overrides=overrides, seed=seed)
    lab = session.build_lab()
    session.warm(lab)
    tally = Tally(target=lab.target)
    first = session.assembly.first_point
    sequencer = Sequencer(
        lab,
        first.steps,
        session.stop_flag,
        tally,
        NoObserver(),
        seed=seed,
        policy=RunPolicy(attempts=1),
        parameters={},
    )
    try:
        sequencer.open()
        for shot in shots:
            sequencer.take(shot)
    finally:
        sequencer.shut_down()
    return tally


def rows_of(path: Path) -> list[dict[str, str]]:
    """The rows of a table; none if there is no such file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a table."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_file(path, text.getvalue().encode())


def rows_with(name: str, planner: str) -> list[dict[str, str]]:
    """The rows of a table; none if another planner took its shots."""
    return [row for row in rows_of(FIGURES / f"{name}.csv") if row["planner"] == planner]


def table_4(rows: Iterable[Mapping[str, str]]) -> dict[tuple[int, int], Filled]:
    """Degree of parallelism and window in ms -> the shots of that point of figure 4."""
    return {
        (int(row["dop"]), int(row["window_ms"])): Filled(int(row["shots"]), *(float(row[k]) for k in SUMS))
        for row in rows
    }


def simulate_4(n_shots: int) -> None:
    """Add shots to the points of figure 4 until all have so many, in parts."""
    planner, points = planner_of(FIGURE_4), points_4()
    while True:
        before = table_4(rows_with("figure4", planner))
        table = {key: before.get(key, Filled(0, 0.0, 0.0)) for key in points}
        key = min(points, key=lambda key: table[key].shots)
        if table[key].shots >= n_shots:
            return
        part = range(table[key].shots, min(table[key].shots + PART_4, n_shots))
        table[key] = table[key].with_shots(take_4(*key, part))
        rows = [
            {"planner": planner, "dop": dop, "window_ms": window_ms, "shots": one.shots}
            | {name: f"{value:.9f}" for name, value in zip(SUMS, one[1:], strict=True)}
            for (dop, window_ms), one in table.items()
            if one.shots
        ]
        write_rows(FIGURES / "figure4.csv", rows)


def take_4(dop: int, window_ms: int, shots: range) -> NDArray[np.float64]:
    """Filling in each of some shots of a point of figure 4."""
    overrides = [
        f"scan={{planner.degree_of_parallelism: [{dop}]}}",
        f"repeats={shots.stop}",
        f"shot.2.rearrange.window={window_ms} ms",
    ]
    tally = take(FIGURE_4, shots, overrides, 1000 * dop + window_ms)
    return 1 - np.array(tally.defects)[:, 0] / PAPER_ATOMS


def simulate_5(n_shots: int) -> None:
    """Add shots to the series of figure 5 until all have so many, in parts."""
    planners = {name: planner_of(FIGURE_5, overrides) for name, (_, overrides) in SERIES_5.items()}
    while True:
        tables = {name: rows_with(name, planner) for name, planner in planners.items()}
        shots = {name: int(rows[0]["shots"]) if rows else 0 for name, rows in tables.items()}
        name = min(shots, key=lambda name: shots[name])
        if shots[name] >= n_shots:
            return
        part = range(shots[name], min(shots[name] + PART_5, n_shots))
        add_5(name, planners[name], take(FIGURE_5, part, SERIES_5[name][1], SEED_5))


def table_5(name: str) -> list[dict[str, str]]:
    """The table of a series of figure 5, a row for each cycle."""
    return rows_of(FIGURES / f"{name}.csv")


def add_5(name: str, planner: str, tally: Tally) -> None:
    """Add shots to the table of a series of figure 5; those of another planner are dropped."""
    defects, moves = np.array(tally.defects), np.array(tally.n_atom_moves)
    before = rows_with(name, planner)
    rows: list[dict[str, Any]] = []
    for cycle in range(defects.shape[1]):
        old = (
            {key: float(value) for key, value in before[cycle].items() if key != "planner"} if before else {}
        )
        counts = np.bincount(np.minimum(defects[:, cycle], 9), minlength=10)
        n_old = int(old.get("shots", 0))
        n = n_old + len(defects)
        filling = n_old * old.get("filling", 0.0) + (1 - defects[:, cycle] / PAPER_ATOMS).sum()
        n_moves = n_old * old.get("atom_moves", 0.0) + moves[:, cycle].sum()
        squares = n_old * old.get("filling_squared", 0.0) + ((1 - defects[:, cycle] / PAPER_ATOMS) ** 2).sum()
        rows.append(
            {
                "planner": planner,
                "cycles": cycle + 1,
                "shots": n,
                **{f"defects_{k}": int(counts[k] + old.get(f"defects_{k}", 0)) for k in range(10)},
                "filling": f"{filling / n:.9f}",
                "filling_squared": f"{squares / n:.9f}",
                "atom_moves": f"{n_moves / n:.6f}",
            }
        )
    write_rows(FIGURES / f"{name}.csv", rows)


def difference(value: float, error: float, paper: float, paper_error: float) -> str:
    """A difference from the paper in standard errors of both: "+3.1"."""
    return f"{(value - paper) / math.hypot(error, paper_error):+.1f}"


def percent(value: float, error: float) -> str:
    """A fraction with its error in per cent: "1.53(12) %"."""
    return f"{Estimate(value, error).scaled(100)} %"


def lines_5() -> list[str]:
    """The table of figure 5 with its differences from the paper."""
    header = (
        "series",
        "planner",
        "shots",
        "after one cycle",
        "after two",
        "after ten",
        "filling after one",
        "atoms moved",
    )
    cells = [percent(p, e) for _, p, e in (*PAPER_DEFECT_FREE, *PAPER_FILLING)]
    lines = [
        "| " + " | ".join(row) + " |" for row in (header, ["---"] * 8, ["Tian et al.", "", "", *cells, "2.7"])
    ]
    for name, (label, _) in SERIES_5.items():
        rows = table_5(name)
        if not rows:
            continue
        n = int(rows[0]["shots"])
        cells = [label, f"`{rows[0]['planner']}`", str(n)]
        for cycle, paper, paper_error in PAPER_DEFECT_FREE:
            p = int(rows[cycle - 1]["defects_0"]) / n
            error = math.sqrt(p * (1 - p) / n)
            cells.append(f"{percent(p, error)}, {difference(p, error, paper, paper_error)}")
        filling, squared = (float(rows[0][key]) for key in ("filling", "filling_squared"))
        error = math.sqrt(max(squared - filling**2, 0.0) / n)
        cells.append(f"{percent(filling, error)}, {difference(filling, error, *PAPER_FILLING[0][1:])}")
        later = np.mean([float(row["atom_moves"]) for row in rows[1:]])
        cells.append(f"{later:.1f}")
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def lines_4() -> list[str]:
    """The table of figure 4."""
    rows = rows_of(FIGURES / "figure4.csv")
    table = table_4(rows)
    lines = ["| " + " | ".join(row) + " |" for row in (["DOP", *map(str, range(2, 16))], ["---"] * 15)]
    for label, points in series_4(table).items():
        cells = [f"{100 * one.filling:.2f}" for one in points.values()]
        lines.append("| " + " | ".join([label, *cells]) + " |")
    shots, errors = [one.shots for one in table.values()], [100 * one.error for one in table.values()]
    least, most = (f"{end(errors):.3f}" for end in (min, max))
    extent = f"{min(shots)} shots or more for each point, planned by `{rows[0]['planner']}`"
    _, of_7 = (points[7] for points in series_4(table).values())
    away = difference(of_7.filling, of_7.error, *PAPER_FILLING[0][1:])
    value = percent(of_7.filling, of_7.error)
    return [
        *lines,
        "",
        f"{extent}; standard errors {least} to {most} %.",
        f"At DOP 7 in its own window: {value}, {away} standard errors from the paper's 97.66(4) %.",
    ]


def series_4(table: Mapping[tuple[int, int], Filled]) -> dict[str, dict[int, Filled]]:
    """The two series of figure 4: the windows -> degree of parallelism -> shots; the common window first."""
    longest = max(window_ms for _, window_ms in table)
    own = [window_ms for _, window_ms in table if window_ms < longest]
    return {
        f"window {longest} ms": {dop: one for (dop, ms), one in table.items() if ms == longest},
        f"own window, {min(own)} to {max(own)} ms": {
            dop: one for (dop, ms), one in table.items() if ms < longest
        },
    }


def write_page(page: Path = PAGE) -> None:
    """Replace the tables of the page."""
    text = page.read_text(encoding="utf-8")
    for name, lines in (("figure 4", lines_4()), ("figure 5", lines_5())):
        part = re.compile(rf"(?<=<!-- measured: {name} -->\n).*?(?=<!-- end -->)", re.DOTALL)
        body = "\n".join(["", *lines, "", ""])
        text = part.sub(lambda _, body=body: body, text, count=1)
    write_file(page, text.encode())


class Points(NamedTuple):
    """Points of a figure: fractions with the ends of their 1 sigma intervals."""

    label: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @classmethod
    def of(cls, label: str, rows: Iterable[Sequence[float]]) -> Points:
        """Points from rows of x, y and the ends of the interval."""
        return cls(label, *np.array(list(rows), np.float64).reshape(-1, 4).T)


class AtomLosses(NamedTuple):
    """Losses of atoms that are not moved, and missed atoms.

    Attributes:
        lifetime_s: Lifetime of an atom in a tweezer, exposures included.
        imaging_loss: Loss in one exposure, in addition to that of the lifetime.
        imaging_loss_exposure_s: The exposure that the imaging loss belongs to.
        false_negative: Probability that an atom is not seen; None if it is not known.
    """

    lifetime_s: float
    imaging_loss: float
    imaging_loss_exposure_s: float
    false_negative: float | None = None

    @classmethod
    def of(cls, devices: Mapping[str, Any]) -> AtomLosses | None:
        """The constants of a run's simulation; None if the run does not contain them.

        Args:
            devices: ``describe()`` of each device, as in ``run.record["devices"]``.
        """
        simulation: Any = devices.get("simulation")
        if not isinstance(simulation, Mapping):
            return None
        names = ("lifetime", "imaging_loss", "imaging_loss_exposure", "false_negative")
        values = [simulation.get(name) for name in names]
        values = [v if isinstance(v, float | int) and math.isfinite(v) else None for v in values]
        lifetime_s, loss, exposure_s, missed = values
        if lifetime_s is None or loss is None or exposure_s is None:
            return None
        if lifetime_s <= 0 or exposure_s <= 0 or not 0 <= loss < 1:
            return None
        return cls(lifetime_s, loss, exposure_s, missed)


def max_defect_free(n_atoms: int, period_s: float, exposure_s: float, losses: AtomLosses) -> float:
    """The highest probability that an array is defect-free on the image that ends a cycle.

    Between its detection on one image and on the next one, an atom is exposed to the loss of one
    exposure and to the vacuum for a whole period. What is lost in that time is missing on the
    next image, even if every plan is perfect and no atom is lost in a move. An atom that is not
    seen counts as a defect on this image. If it was not seen on the image before, a second
    atom was moved to its site, and both are lost. So each of N atoms is in its place with::

        p = exp(-T / lifetime) (1 - loss) ^ (exposure / 45 ms) (1 - false negative)^2

    and the array with p^N. Empty sites that are taken for full ones change that by about a part in
    a thousand, because few sites are empty.

    Args:
        n_atoms: Atoms of the target, N.
        period_s: From the start of an exposure to the start of the next one, T.
        exposure_s: Exposure time.
        losses: Lifetime, loss in the light and missed atoms.
    """
    exposures = exposure_s / losses.imaging_loss_exposure_s
    log_stays = -period_s / losses.lifetime_s + exposures * math.log1p(-losses.imaging_loss)
    log_seen = 2 * math.log1p(-losses.false_negative) if losses.false_negative else 0.0
    return math.exp(n_atoms * (log_stays + log_seen))


def after_moves(highest: float, n_atom_moves: float, loss: float) -> float:
    """The highest defect-free probability if moved atoms may be lost as well.

    An atom lost in a move is missing on the next image, so each of the m moved atoms contributes
    a factor ``1 - loss``. The number of moves differs from shot to shot; with its mean this is an
    estimate, accurate as long as ``m loss`` is small.

    Args:
        highest: From :func:`max_defect_free`.
        n_atom_moves: Mean number of atom moves of a cycle, m.
        loss: Loss of a moved atom.
    """
    return highest * (1.0 - loss) ** n_atom_moves


def survival(window_s: float, lifetime_s: float) -> float:
    """Probability that an atom outlives a window (paper, figure 4)."""
    return math.exp(-window_s / lifetime_s)


def style(axes: Axes, x: str, y: str) -> None:
    """Label the axes; a thin frame, a faint grid, whole numbers on the x axis."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(visible=True, axis="y", color="0.92", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def errorbars(axes: Axes, points: Points, colour: str, marker: str) -> None:
    """Draw points with error bars, in per cent; the paper's own points are stars."""
    y = 100 * points.y
    bars = np.nan_to_num([y - 100 * points.low, 100 * points.high - y]).clip(min=0.0)
    look: dict[str, Any] = {"markersize": 5, "linewidth": 0.9, "zorder": 3}
    if marker == "*":
        look = {"markersize": 11, "linestyle": "none", "markeredgecolor": "white", "zorder": 4}
    axes.errorbar(points.x, y, bars, label=points.label, color=colour, marker=marker, capsize=2, **look)


def draw_figure_4(
    path: Path,
    note: str,
    fixed: Sequence[Points],
    optimised: Sequence[Points],
    windows: Points,
    quoted: Points | None,
) -> None:
    """Draw filling after one cycle against the degree of parallelism.

    Args:
        path: The picture.
        note: Line below the title.
        fixed: Points with one window, of each run.
        optimised: Points with a window for each degree, of each run.
        windows: Survival of the window at each degree.
        quoted: The paper's points; None if they are of another array.
    """
    figure, axes = plt.subplots(figsize=(6.4, 4.6), layout="constrained")
    for points, colour in zip(fixed, (LIGHT, LIGHT_ORANGE), strict=False):
        errorbars(axes, points, colour, "s")
    for points, colour in zip(optimised, (DARK, ORANGE), strict=False):
        errorbars(axes, points, colour, "o")
    if quoted is not None:
        errorbars(axes, quoted, RED, "*")
    axes.margins(y=0.2)
    style(axes, "degree of parallelism", "filling after one cycle (%)")
    right = axes.twinx()
    right.plot(windows.x, 100 * windows.y, color=GREY, linewidth=1, label=windows.label)
    room = 0.25 * max(float(np.ptp(100 * windows.y)), 0.5)
    right.set_ylim(100 * windows.y.min() - room, 100 * windows.y.max() + room)
    right.set_ylabel("survival of the window (%)", color=GREY)
    right.tick_params(colors=GREY)
    axes.set_zorder(right.get_zorder() + 1)
    axes.patch.set_visible(False)
    figure.legend(loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    figure.suptitle(f"figure 4: filling after one cycle\n{note}", fontsize=9)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def draw_figure_5(
    path: Path,
    note: str,
    series: Sequence[Points],
    defects: Sequence[NDArray[np.int64]],
    quoted: Points | None,
    ceiling: Points | None = None,
) -> None:
    """Draw the defect-free probability against the number of cycles, and the defects that are left.

    Args:
        path: The picture.
        note: Line below the title.
        series: P_n of each run.
        defects: For each of them, how many shots have 0, 1, 2, ... defects after the last cycle.
        quoted: The paper's points; None if they are of another array.
        ceiling: The highest P_n that losses and detection allow; None if it is not known.
    """
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(8.6, 4.4), width_ratios=(2.3, 1.0), layout="constrained"
    )
    for points, colour, marker in zip(series, (DARK, ORANGE), "os", strict=False):
        errorbars(left, points, colour, marker)
    if quoted is not None:
        errorbars(left, quoted, RED, "*")
    if ceiling is not None:
        left.plot(ceiling.x, 100 * ceiling.y, "--", color=GREY, linewidth=1, label=ceiling.label)
    left.set_ylim(0.0, 1.35 * left.get_ylim()[1])
    left.set_xlim(0.5, max(points.x[-1] for points in (*series, *([quoted] if quoted else []))) + 0.5)
    style(left, "rearrangement cycles n", "defect-free after n cycles (%)")
    handles, labels = left.get_legend_handles_labels()
    order = sorted(range(len(labels)), key=lambda i: labels[i].startswith("ceiling"))
    key: dict[str, Any] = {"frameon": False, "fontsize": 8, "loc": "upper left"}
    left.legend([handles[i] for i in order], [labels[i] for i in order], **key)
    for counts, inside, rim in zip(defects, (LIGHT, None), (DARK, ORANGE), strict=False):
        share, edges = 100 * counts / max(1, counts.sum()), np.arange(len(counts) + 1) - 0.5
        if inside is not None:
            right.stairs(share, edges, fill=True, color=inside)
        right.stairs(share, edges, color=rim, linewidth=0.9)
    right.set_xlim(-0.8, max(4, *(len(counts) - 1 for counts in defects)) + 0.8)
    right.set_ylim(bottom=0.0)
    style(right, f"defects after {int(series[0].x[-1])} cycles", "shots (%)")
    figure.suptitle(f"figure 5: defect-free probability after n cycles\n{note}", fontsize=9)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def paper_points(points: Sequence[tuple[int, float, float]], n_atoms: int = PAPER_ATOMS) -> Points | None:
    """Points that the paper states; None for arrays of another size."""
    if n_atoms != PAPER_ATOMS:
        return None
    return Points.of("Tian et al.", [(x, y, y - error, y + error) for x, y, error in points])


def note_of(run: Run) -> str:
    """Name, target and seed of a run."""
    kind = "simulated" if run.simulated else "measured"
    planner = planner_text(run.record["resolved"]["planner"])
    shots = f"{len(run.shots)} shots, seed {run.seed}, {kind}"
    return f"{run.path.name}: {run.target.n_atoms} atoms, {planner}, {shots}"


def labels_of(runs: Sequence[Run]) -> list[str]:
    """Names of the runs, or of their folders if the names are the same."""
    names = [run.name for run in runs]
    return [run.path.name if len({*names}) < len(names) else run.name for run in runs]


def cycles_of(run: Run) -> Statistics:
    """Statistics of a run for figure 5.

    Raises:
        SystemExit: The run scans, or not all of its shots make every cycle.
    """
    statistics = statistics_of(run.shots, run.target)
    if run.record.get("scan"):
        raise SystemExit(f"{run.path}: figure 5 needs a run without a scan, such as of {FIGURE_5}")
    if not statistics.cycles or statistics.cycles[-1].n_shots < statistics.cycles[0].n_shots:
        raise SystemExit(f"{run.path}: figure 5 needs shots that all make every cycle: 'stop_when: never'")
    return statistics


def figure_5_of(path: Path, runs: Sequence[Run]) -> None:
    """Draw figure 5 from runs."""
    found = [cycles_of(run) for run in runs]
    series = [
        Points.of(
            f"{label}, {statistics.n_shots} shots",
            [(c.cycle + 1, c.defect_free.value, *c.defect_free.interval) for c in statistics.cycles],
        )
        for label, statistics in zip(labels_of(runs), found, strict=True)
    ]
    defects = [np.array(statistics.cycles[-1].defects, np.int64) for statistics in found]
    n_atoms = runs[0].target.n_atoms
    ceiling = ceiling_of(runs[0], found[0])
    draw_figure_5(path, note_of(runs[0]), series, defects, paper_points(PAPER_DEFECT_FREE, n_atoms), ceiling)


def ceiling_of(run: Run, statistics: Statistics) -> Points | None:
    """The highest defect-free probability for the times that a run took; None on real hardware."""
    losses = AtomLosses.of(run.record.get("devices") or {})
    if losses is None:
        return None
    images = run.shots[0].row.images
    exposures = [s for s, cycle in zip(images.exposure_s, images.cycle, strict=True) if cycle >= 0]
    label = "ceiling: losses in the light and with time"
    label += "" if losses.false_negative is None else ", missed atoms"
    highest = [
        max_defect_free(run.target.n_atoms, cycle.period_s.value, exposure_s, losses)
        for cycle, exposure_s in zip(statistics.cycles, exposures, strict=False)
    ]
    return Points.of(label, [(n, y, y, y) for n, y in enumerate(highest, start=1)])


def figure_4_of(path: Path, runs: Sequence[Run]) -> None:
    """Draw figure 4 from runs."""
    parted = [divided(run) for run in runs]
    prefixes = [f"{label}, " if len(runs) > 1 else "" for label in labels_of(runs)]
    fixed, optimised = (
        [
            Points.of(prefix + window_text(rows), [(dop, *ends) for dop, _, *ends in rows])
            for prefix, part in zip(prefixes, parted, strict=True)
            if (rows := part[kind])
        ]
        for kind in (0, 1)
    )
    losses = AtomLosses.of(runs[0].record.get("devices") or {})
    lifetime_s = PAPER_LIFETIME_S if losses is None else losses.lifetime_s
    rows = parted[0][1] or parted[0][0]
    left = [(dop, p, p, p) for dop, window_s, *_ in rows for p in (survival(window_s, lifetime_s),)]
    windows = Points.of(f"survival of the {window_text(rows)} (lifetime {lifetime_s:g} s)", left)
    quoted = paper_points(PAPER_FILLING, runs[0].target.n_atoms)
    draw_figure_4(path, note_of(runs[0]), fixed, optimised, windows, quoted)


Filling = tuple[float, float, float, float, float]
"""Degree of parallelism, window in seconds, filling and the ends of its interval."""


def divided(run: Run) -> tuple[list[Filling], list[Filling]]:
    """Points of a run with its longest window, and those with the shortest window of each degree.

    The second list is empty if all points have one window.

    Raises:
        SystemExit: The run is not a scan of the degree of parallelism in shots of one cycle.
    """
    by_dop: dict[int, list[Filling]] = {}
    for scanned in scan_points(run):
        others = [
            address for address in scanned.parameters if address != DOP and not address.endswith("window")
        ]
        if others:
            raise SystemExit(
                f"{run.path}: figure 4 needs a scan of {DOP} and the window alone, not {others[0]}"
            )
        statistics = statistics_of(scanned.shots, run.target)
        if DOP not in scanned.parameters or len(statistics.cycles) != 1:
            raise SystemExit(f"{run.path}: figure 4 needs a scan of {DOP} with one cycle, such as {FIGURE_4}")
        dop, filling = int(scanned.parameters[DOP]), statistics.cycles[0].filling
        ends = filling.value, filling.value - filling.error, filling.value + filling.error
        by_dop.setdefault(dop, []).append((dop, window_of(run, scanned.parameters), *ends))
    if not by_dop:
        raise SystemExit(f"{run.path}: figure 4 needs a scan of {DOP}, such as {FIGURE_4}")
    ordered = [sorted(by_dop[dop], key=lambda row: row[1]) for dop in sorted(by_dop)]
    if max(map(len, ordered)) > 2:
        raise SystemExit(f"{run.path}: figure 4 needs at most two windows for a degree of parallelism")
    longest_s = max(rows[-1][1] for rows in ordered)
    fixed = [rows[-1] for rows in ordered if rows[-1][1] == longest_s]
    shortest = [rows[0] for rows in ordered]
    return fixed, [] if all(row[1] == longest_s for row in shortest) else shortest


def window_of(run: Run, parameters: Mapping[str, Any]) -> float:
    """The window of the cycle in seconds, scanned or set in the sequence."""
    scanned = [value for address, value in parameters.items() if address.endswith("window")]
    steps: Sequence[Mapping[str, Any]] = run.record.get("resolved", {}).get("shot", ())
    window: Any = [*scanned, *(step["rearrange"].get("window") for step in steps if "rearrange" in step)][0]
    return float(window[0] if isinstance(window, list) else window)


def window_text(rows: Sequence[Filling]) -> str:
    """The windows of points: "windows 60 to 94 ms"."""
    low, high = (1e3 * end(row[1] for row in rows) for end in (min, max))
    return f"window {low:.3g} ms" if low == high else f"windows {low:.3g} to {high:.3g} ms"


def draw_4(path: Path) -> None:
    """Draw figure 4 from its table."""
    rows = rows_of(FIGURES / "figure4.csv")
    table = table_4(rows)
    fixed, own = (
        Points.of(
            label, [(dop, f.filling, f.filling - f.error, f.filling + f.error) for dop, f in points.items()]
        )
        for label, points in series_4(table).items()
    )
    windows_s = {dop: ms / 1e3 for dop, ms in sorted(table, reverse=True)}  # the shortest of each comes last
    left = [(dop, *3 * [survival(s, PAPER_LIFETIME_S)]) for dop, s in sorted(windows_s.items())]
    windows = Points.of(f"survival of the {own.label} (lifetime {PAPER_LIFETIME_S:g} s)", left)
    shots = min(one.shots for one in table.values())
    note = f"profile paper, {rows[0]['planner']}, {shots} shots for each point"
    draw_figure_4(path, note, [fixed], [own], windows, paper_points(PAPER_FILLING))


def draw_5(path: Path) -> None:
    """Draw figure 5 from its tables."""
    series: list[Points] = []
    defects: list[NDArray[np.int64]] = []
    for name in DRAWN_5:
        rows = table_5(name)
        rates = [Rate(int(row["defects_0"]), int(row["shots"])) for row in rows]
        points = [(n, rate.value, *rate.interval) for n, rate in enumerate(rates, start=1)]
        series.append(Points.of(f"{rows[0]['planner']}, {rows[0]['shots']} shots", points))
        defects.append(np.array([int(rows[-1][f"defects_{n}"]) for n in range(10)]))
    note = "profile paper, 15 x 15 atoms, degree of parallelism 7"
    draw_figure_5(path, note, series, defects, paper_points(PAPER_DEFECT_FREE))


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--figure", choices=("4", "5"), help="draw this figure from runs")
    parser.add_argument("runs", nargs="*", type=Path, help="a run of its sequence, and one to compare")
    parser.add_argument("--output", type=Path, help="the picture; by default figure4.png or figure5.png")
    parser.add_argument(
        "--shots-4", type=int, default=0, help="shots of each point of figure 4; 0: draw only"
    )
    parser.add_argument("--shots-5", type=int, default=0, help="shots of figure 5; 0: draw only")
    given = parser.parse_args(arguments)
    if given.figure is not None:
        if not 1 <= len(given.runs) <= 2:
            parser.error("give one run, or two to compare")
        output = given.output or Path(f"figure{given.figure}.png")
        draw = figure_4_of if given.figure == "4" else figure_5_of
        draw(output, [open_run(path) for path in given.runs])
        return
    FIGURES.mkdir(parents=True, exist_ok=True)
    if given.shots_4:
        simulate_4(given.shots_4)
    if given.shots_5:
        simulate_5(given.shots_5)
    write_page()
    draw_4(FIGURES / "figure4.png")
    draw_5(FIGURES / "figure5.png")


if __name__ == "__main__":
    main()
