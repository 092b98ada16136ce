"""Measure the planners again, and write the tables and pictures of their page.

    python docs/make_planner_tables.py --loadings 10000

What stands between ``<!-- measured: NAME -->`` and ``<!-- end -->`` on the page is replaced. Times are
those of this machine: let nothing else run.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from labseq.bench.pictures import save_comparison
from labseq.bench.planners import BenchRequest, compare, read_request
from labseq.bench.report import FIGURES, Figure, Report, Row, figure_drawing, points_of
from labseq.model.estimate import Estimate
from labseq.units import format_quantity

DOCS = Path(__file__).parent
PAGE = DOCS / "explanation" / "planners.md"
PICTURES = DOCS / "_static" / "planners"

PLANNERS = "psca,psca:variant=paper,tetris,mta1,hca,compression,lsap,lsap_squared"
SIZES = ((20, 15), (30, 22), (64, 48))


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A table."""
    return ["| " + " | ".join(row) + " |" for row in (header, ["---"] * len(header), *rows)]


def planners(n_loadings: int) -> list[str]:
    """All planners side by side, one after the other so that times are true."""
    request = BenchRequest(planners=PLANNERS, dop=15, loadings=n_loadings)
    report = compare(read_request(request)[0], 1)
    header = (
        "planner",
        "batches",
        "atoms moved",
        "distance",
        "motion",
        "planning",
        "target met",
        "to the bound",
    )
    command = f"labseq bench planners --planners {PLANNERS} --dop 15 --loadings {n_loadings} --workers 1"
    return [*shown(command), *markdown(header, map(planner_cells, report.rows))]


def planner_cells(row: Row) -> list[str]:
    batches, motion_s = row.n_batches, row.motion_s
    scans = f" ({row.n_scans} scans)" if row.scans else ""
    scan_s = f" ({row.scan_s.scaled(1e3)} ms)" if row.scans else ""
    return [
        f"`{row.planner_entry.label}`",
        f"{batches}{scans}",
        str(row.n_atoms_moved),
        f"{row.distance_m.scaled(1e3)} mm",
        f"{motion_s.scaled(1e3)} ms{scan_s}",
        format_quantity(row.planning_median_s, "time"),
        f"{100 * row.target_met.value:.4g} %",
        str(row.ratio_to_bound),
    ]


def sizes(n_loadings: int) -> list[str]:
    """PSCA in growing arrays."""
    rows: list[list[str]] = []
    for grid, side in SIZES:
        target = f"compact:{side}x{side}"
        request = BenchRequest(grid=f"{grid}x{grid}", target=target, dop=15, loadings=n_loadings)
        (row,) = compare(read_request(request)[0], 1).rows
        times = [format_quantity(s, "time") for s in (row.planning_median_s, row.planning_p99_s)]
        rows.append([f"{grid} x {grid} to {side} x {side}", str(row.n_batches), *times])
    command = "labseq bench planners --dop 15 --grid 64x64 --target compact:48x48"
    return [
        *shown(f"{command} --loadings {n_loadings} --workers 1"),
        *markdown(("size", "batches", "planning, median", "99 %"), rows),
    ]


def figure_lines(figure: Figure, report: Report, n_loadings: int) -> list[str]:
    """A figure of the paper: a column per curve, a row per point."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    picture = PICTURES / f"figure-{figure.name}.png"
    save_comparison(picture, figure_drawing(report, figure))
    curves = points_of(report, figure)
    factor = 1e3 if figure.y == "motion_s" else 1.0
    name = "N" if figure.x == "n_target_atoms" else "DOP"
    rows = [
        [f"{x:.0f}", *(str(Estimate(c.y[i], c.error[i]).scaled(factor)) for c in curves)]
        for i, x in enumerate(curves[0].x)
    ]
    if figure.fitted:
        rows.append(["exponent", *(str(c.law.exponent) if c.law else "-" for c in curves)])
    command = f"labseq bench planners --figure {figure.name} --loadings {n_loadings}"
    table = markdown([name, *(c.label for c in curves)], rows)
    what = "milliseconds" if factor > 1.0 else "batches, or scans where the source counts those"
    return [
        *shown(command),
        *table,
        "",
        f"In {what}.",
        "",
        f"![Figure {figure.name}](../_static/planners/{picture.name})",
    ]


def shown(command: str) -> list[str]:
    return ["```console", command, "```", ""]


def figures(names: Sequence[str], n_loadings: int) -> dict[str, list[str]]:
    """The figures; those of the same loadings are measured together."""
    reports: dict[object, Report] = {}
    for figure in (FIGURES[name] for name in names):
        key = (figure.planner_entries, figure.conditions)
        if key not in reports:
            comparison, _ = read_request(BenchRequest(figure=figure.name, loadings=n_loadings))
            reports[key] = compare(comparison)
    return {
        f"figure {name}": figure_lines(
            FIGURES[name], reports[FIGURES[name].planner_entries, FIGURES[name].conditions], n_loadings
        )
        for name in names
    }


def replaced(page: str, name: str, lines: Sequence[str]) -> str:
    """The page with new content in one of its measured parts.

    Raises:
        LookupError: The page has no such part.
    """
    part = re.compile(rf"(<!-- measured: {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
    if not part.search(page):
        raise LookupError(f"{PAGE.name} has no part <!-- measured: {name} -->")
    return part.sub(lambda match: match[1] + "\n" + "\n".join(lines) + "\n\n" + match[2], page)


def main() -> None:
    parser = argparse.ArgumentParser(description="Rewrite the measured tables and figures.")
    parser.add_argument("--loadings", type=int, default=10_000)
    n_loadings: int = parser.parse_args().loadings
    parts: dict[str, Callable[[int], list[str]]] = {"planners": planners, "sizes": sizes}
    measured = {name: measure(n_loadings) for name, measure in parts.items()} | figures(
        [*FIGURES], n_loadings
    )
    page = PAGE.read_text(encoding="utf-8")
    for name, lines in measured.items():
        page = replaced(page, name, lines)
    PAGE.write_text(page, encoding="utf-8")
    sys.stdout.write(f"written: {PAGE.relative_to(DOCS)}, {', '.join(measured)}\n")


if __name__ == "__main__":
    main()
