"""A plan on the screen: the array before and after, totals, and each batch on request."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Final, NoReturn, TextIO

from rich.console import Console
from rich.text import Text

from labseq.cli.glyphs import glyphs_for
from labseq.cli.output import columns, encodes, writing_to
from labseq.cli.plan_canvas import Canvas
from labseq.cli.plan_steps import Steps
from labseq.cli.words import count_of, plural
from labseq.session import PlannedMoves
from labseq.units import format_quantity

PLAIN_WIDTH: Final = 132
"""Characters per line where there is no terminal."""


class _Console(Console):
    """One that leaves it to others what a closed pipe means, where rich would end the process."""

    def on_broken_pipe(self) -> NoReturn:
        raise  # noqa: PLE0704 - rich calls this while it handles the error


def print_plan(moves: PlannedMoves, stream: TextIO, *, step: bool) -> None:
    """Print a plan.

    Args:
        moves: The plan.
        stream: Where to; if it is a terminal, and the keyboard is there too, the
            batches wait for Enter.
        step: Whether to print it batch by batch first.

    Raises:
        RecordingError: It cannot be written, for example to a full disk.
    """
    console = _Console(file=stream, highlight=False, soft_wrap=True)
    with writing_to(stream):
        _print_all(console, moves, step=step)


def _print_all(console: Console, moves: PlannedMoves, *, step: bool) -> None:
    width = console.width if console.is_terminal else PLAIN_WIDTH
    shear = moves.grid.shear if moves.grid.lattice == "triangular" else 0
    canvas = Canvas(moves.target, shear, width, glyphs_for(console.encoding))
    _print(console, *map(Text, columns(what(moves))), Text())
    if step:
        arrow = "→" if encodes(console.encoding, "→") else "->"
        _print_steps(console, Steps(moves, canvas, arrow))
    before, after = moves.occupancy, moves.report.predicted
    _print(console, *canvas.pair(("before", "after"), (before, after)), Text())
    if key := canvas.key(before, after):
        _print(console, key, Text())
    _print(console, *map(Text, columns(totals(moves))))


def _print_steps(console: Console, steps: Iterable[list[Text]]) -> None:
    waits = console.is_terminal and sys.stdin.isatty()
    for lines in steps:
        _print(console, *lines, Text())
        if waits and not _goes_on(console):
            break


def _goes_on(console: Console) -> bool:
    """Wait for Enter; False for "q" or the end of the input."""
    console.print(Text("Enter: next batch, q: skip the rest ", "dim"), end="")
    answer = sys.stdin.readline()
    console.print()
    return bool(answer) and answer.strip().lower() != "q"


def _print(console: Console, *lines: Text) -> None:
    for line in lines:
        line.rstrip()
        console.print(line)


def title(moves: PlannedMoves) -> str:
    """The plan in a line."""
    plan = moves.plan
    parts = [
        moves.target.name,
        "1 batch" if plan.n_batches == 1 else f"{plan.n_batches} batches",
        plural(plan.n_atom_moves, "atom move"),
        format_quantity(moves.report.duration_s, "time"),
    ]
    return f"{moves.planner}, degree of parallelism {moves.degree_of_parallelism}: {', '.join(parts)}"


def what(moves: PlannedMoves) -> list[tuple[str, str]]:
    """What was planned from what."""
    grid, target = moves.grid, moves.target
    sites = (
        f"{grid.n_rows} x {grid.n_cols} sites, {grid.lattice}, {format_quantity(grid.spacing_m, 'length')}"
    )
    atoms = f"{plural(target.n_atoms, 'atom')}, {plural(int(target.clear.sum()), 'site')} to be empty"
    dop = f", degree of parallelism {moves.degree_of_parallelism}"
    settings = [f", {key} {value}" for key, value in moves.settings.items() if key != "degree_of_parallelism"]
    return [
        ("occupancy", f"{moves.source}: {plural(int(moves.occupancy.sum()), 'atom')} on {sites}"),
        ("target", f"{target.name}: {atoms}"),
        ("planner", "".join([moves.planner, dop, *settings])),
    ]


def totals(moves: PlannedMoves) -> list[tuple[str, str]]:
    """The plan in numbers."""
    plan, report = moves.plan, moves.report
    n_atoms = moves.target.n_atoms
    rows = [
        ("batches", str(plan.n_batches)),
        ("atom moves", str(plan.n_atom_moves)),
        ("duration", format_quantity(report.duration_s, "time")),
        ("tweezers", f"at most {moves.max_tweezers} on at once"),
        ("ejected", plural(moves.n_ejected, "atom")),
        ("filled", f"{count_of(moves.n_filled, n_atoms)} target sites"),
    ]
    if report.n_surplus:
        rows.append(("surplus", f"{plural(report.n_surplus, 'atom')} on sites that must be empty"))
    return rows
