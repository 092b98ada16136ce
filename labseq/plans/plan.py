"""`labseq plan` prints or draws the moves for one occupancy."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TextIO

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.text import Text

from labseq.assembly.occupancies import read_source
from labseq.assembly.planning import PlannedMoves, PlanRequest, plan_moves
from labseq.console.arrays import ArrayPair, glyphs_for
from labseq.console.output import STDOUT, check_different, json_writer, report_compiling, say, writing_to
from labseq.console.report import Facts, aligned
from labseq.console.text import count_of, encodes, percent, plural
from labseq.model import Batch, TonePaths
from labseq.motion import Survival
from labseq.pictures.plans import occupancies, on_grid
from labseq.units import format_quantity


@dataclass(frozen=True, slots=True)
class PlanOutput:
    """The output to print and write.

    Attributes:
        step: True to print the plan batch by batch.
        json: Name of the file for the plan as JSON, or "-" for stdout, which then holds nothing else.
        png: The file for the plan as a picture.
        animate: The file for the plan as an animation.
    """

    step: bool = False
    json: str | None = None
    png: Path | None = None
    animate: Path | None = None


def plan_once(request: PlanRequest, output: PlanOutput) -> None:
    """Plan the moves for one occupancy, and print or write them."""
    check_different(request.occupancy, output.json, output.png, output.animate)
    write = json_writer(output.json)
    source = read_source(request.occupancy, request.seed)
    if output.png is not None:
        from labseq.pictures.plans import check_picture

        check_picture(output.png, source.occupancy.shape)
    if output.animate is not None:
        from labseq.pictures.animations import check_animation

        check_animation(output.animate, source.occupancy.shape)
    moves = plan_moves(request, source, announce=report_compiling, keep_refused=True, once=True)
    report = PlanReport.of(moves)
    if output.png is not None:
        _draw(moves, output.png)
    if output.animate is not None:
        _animate(moves, output.animate)
    if output.json != STDOUT:
        write(report)
    if output.step or output.json != STDOUT:
        print_plan(moves, sys.stdout, step=output.step)
    say(*(f"warning: {text}" for text in warnings(moves, request)), stream=sys.stderr)
    if output.json == STDOUT:
        write(report)
    if moves.refused is not None:
        raise moves.refused


def warnings(moves: PlannedMoves, request: PlanRequest) -> list[str]:
    """Warnings for the user about a valid plan. A refused plan has none."""
    if moves.refused is not None:
        return []
    texts: list[str] = []
    requested, used = request.degree_of_parallelism, moves.degree_of_parallelism
    if requested is not None and requested != used:
        texts.append(
            f"--dop {requested}: planned with {used}, the maximum that the planner and the machine allow"
        )
    n_defects, n_surplus = moves.report.n_defects, moves.report.n_surplus
    n_atoms, n_sites = int(moves.occupancy.sum()), moves.target.n_atoms
    if moves.n_missing_atoms:
        too_few = (
            f"{plural(n_atoms, 'atom')} for {plural(n_sites, 'target site')}, {moves.n_missing_atoms} short"
        )
        texts.append(f"{too_few}; the plan fills {moves.n_filled}")
    elif n_defects:
        texts.append(
            f"the plan leaves {plural(n_defects, 'target site')} empty, although there are enough atoms"
        )
    if n_surplus:
        texts.append(f"the plan leaves {plural(n_surplus, 'atom')} on sites that must be empty")
    return texts


def _draw(moves: PlannedMoves, path: Path) -> None:
    from labseq.pictures.plans import PlanDrawing, save_plan

    content = moves.grid, moves.occupancy, moves.target, moves.plan, moves.report, moves.refused
    save_plan(path, PlanDrawing(title(moves), moves.source, *content))


def _animate(moves: PlannedMoves, path: Path) -> None:
    """Save the motion, which ends before the refused batch if the plan is refused."""
    from labseq.pictures.animations import Animation, save_animation
    from labseq.pictures.playback import play_back

    plan = moves.plan if moves.refused is None else moves.plan.first(moves.refused.batch)
    content = plan, moves.occupancy, moves.target, moves.grid, moves.motion
    playback = play_back(*content, end_s=moves.report.duration_s)
    save_animation(path, Animation(title(moves), moves.source, playback))


def batch_lines(moves: PlannedMoves, canvas: ArrayPair, arrow: str) -> Iterator[list[Text]]:
    """Describe and draw each batch, up to the refused batch of a refused plan."""
    plan, report, shape = moves.plan, moves.report, moves.grid.shape
    arrays = occupancies(plan, moves.occupancy)
    for i, batch in enumerate(plan.batches[: len(report.batch_end_s)]):
        stays = on_grid(batch.to_sites, shape)
        n_ejected = int(np.count_nonzero(~stays))
        parts = [
            plural(len(batch), "atom") + (f", {n_ejected} ejected" if n_ejected else ""),
            plural(int(report.n_tweezers[i]), "tweezer"),
            f"done at {format_quantity(float(report.batch_end_s[i]), 'time')}",
        ]
        if batch.linked:
            parts.append("with the tweezers still on from the previous batch")
        marked = batch.from_sites, batch.to_sites[stays]
        yield [
            Text.assemble((f"batch {i}", "bold"), "  ", ", ".join(parts)),
            *(Text(f"  {line}") for line in moves_text(batch, shape, arrow)),
            *canvas.lines(("before", "after"), arrays[i : i + 2], marked),
        ]


def refused_lines(moves: PlannedMoves, canvas: ArrayPair, arrow: str) -> list[Text]:
    """Describe and draw the refused batch and the place of its mistake. Empty for a valid plan."""
    error, plan, shape = moves.refused, moves.plan, moves.grid.shape
    if error is None:
        return []
    batch = plan.batch(error.batch)
    sites = batch.from_sites, batch.to_sites
    titles = "moves from", "moves to"
    if error.move >= 0:
        sites = batch.from_sites[[error.move]], batch.to_sites[[error.move]]
        titles = f"atom move {error.move} from", f"atom move {error.move} to"
    elif error.site is not None:
        sites = batch.from_sites, np.array([error.site], np.int16)
        titles = "moves from", "site that breaks the rule"
    marked = [ends[on_grid(ends, shape)] for ends in sites]
    atoms = moves.report.predicted
    ways = zip(map(tuple, batch.from_sites.tolist()), map(tuple, batch.to_sites.tolist()), strict=True)
    return [
        Text.assemble((f"batch {error.batch}", "bold"), "  ", ("refused", "bold red")),
        Text("  " + ", ".join(f"{start}{arrow}{goal}" for start, goal in ways)),
        *canvas.lines(titles, (atoms, atoms), marked),
        Text(f"rule '{error.rule}': {error.detail}", "red"),
        Text(),
    ]


def moves_text(batch: Batch, shape: tuple[int, int], arrow: str = "->") -> list[str]:
    """Describe the moves of a batch, a line of text per row or column.

    Example:
        >>> moves_text(Batch([(2, 0), (2, 4)], [(2, 3), (2, 5)]), (5, 5))
        ['row 2: columns 0->3, 4->ejected']
    """
    if batch.tones is not None:
        return _paths_text(batch, batch.tones, shape, arrow)
    along_column = bool(np.any(batch.from_sites[:, 0] != batch.to_sites[:, 0]))
    line_index, place = (1, 0) if along_column else (0, 1)
    line_name, place_name = ("column", "row") if along_column else ("row", "column")
    stays = on_grid(batch.to_sites, shape).tolist()
    moves_of_line: dict[int, list[str]] = {}
    for start, end, lands in zip(batch.from_sites.tolist(), batch.to_sites.tolist(), stays, strict=True):
        goal = end[place] if lands else "ejected"
        moves_of_line.setdefault(start[line_index], []).append(f"{start[place]}{arrow}{goal}")
    return [
        f"{line_name} {line}: {place_name}{'s' if len(ways) > 1 else ''} {', '.join(ways)}"
        for line, ways in sorted(moves_of_line.items())
    ]


def _paths_text(batch: Batch, paths: TonePaths, shape: tuple[int, int], arrow: str) -> list[str]:
    """Ways of the tones of each axis, the number of legs, and the atoms that move."""
    lines: list[str] = []
    for name, path, off in (("rows", paths.row, paths.row_off), ("columns", paths.column, paths.column_off)):
        ends = path[off, np.arange(len(off))]
        ways = (f"{start:g}{arrow}{end:g}" for start, end in zip(path[0], ends, strict=True))
        lines.append(f"{name} {', '.join(ways)}")
    stays = on_grid(batch.to_sites, shape).tolist()
    ways = (
        f"{(*start,)}{arrow}{(*goal,) if lands else 'ejected'}"
        for start, goal, lands in zip(batch.from_sites.tolist(), batch.to_sites.tolist(), stays, strict=True)
    )
    return [f"{'; '.join(lines)}, in {plural(paths.shape[0] - 1, 'leg')}", f"atoms {', '.join(ways)}"]


class _Console(Console):
    """A console that raises on a closed pipe, where rich would end the process."""

    def on_broken_pipe(self) -> NoReturn:
        raise  # noqa: PLE0704 - rich calls this while it handles the error


def print_plan(moves: PlannedMoves, stream: TextIO, *, step: bool) -> None:
    """Print a plan, with ``step`` batch by batch, waiting for Enter after each in a terminal."""
    console = _Console(file=stream, highlight=False, soft_wrap=True)
    with writing_to(stream):
        _print_all(console, moves, step=step)


def _print_all(console: Console, moves: PlannedMoves, *, step: bool) -> None:
    width = console.width if console.is_terminal else 132  # characters per line
    shear = moves.grid.shear if moves.grid.lattice == "triangular" else 0
    canvas = ArrayPair(moves.target, shear, width, glyphs_for(console.encoding))
    _print(console, *map(Text, aligned(subject(moves))), Text())
    arrow = "→" if encodes(console.encoding, "→") else "->"
    if step:
        _print_steps(console, batch_lines(moves, canvas, arrow))
    before, after = moves.occupancy, moves.report.predicted
    end = "after" if moves.refused is None else f"before batch {moves.refused.batch}"
    _print(console, *canvas.lines(("before", end), (before, after)), Text())
    if key := canvas.key(before, after):
        _print(console, key, Text())
    _print(console, *refused_lines(moves, canvas, arrow))
    _print(console, *map(Text, aligned(PlanReport.of(moves).totals())))


def _print_steps(console: Console, steps: Iterable[list[Text]]) -> None:
    waits = console.is_terminal and sys.stdin.isatty()
    for lines in steps:
        _print(console, *lines, Text())
        if waits and not _wait_for_enter(console):
            break


def _wait_for_enter(console: Console) -> bool:
    """Wait for Enter. False for "q" or the end of the input."""
    console.print(Text("Enter: next batch, q: skip the rest ", "dim"), end="")
    answer = sys.stdin.readline()
    console.print()
    return bool(answer) and answer.strip().lower() != "q"


def _print(console: Console, *lines: Text) -> None:
    for line in lines:
        line.rstrip()
        console.print(line)


def title(moves: PlannedMoves) -> str:
    """The plan on one line."""
    plan, refused = moves.plan, moves.refused
    parts = [
        moves.target.name,
        "1 batch" if plan.n_batches == 1 else f"{plan.n_batches} batches",
        plural(plan.n_atom_moves, "atom move"),
        format_quantity(moves.report.duration_s, "time")
        if refused is None
        else f"refused in batch {refused.batch}",
    ]
    return f"{moves.planner}, degree of parallelism {moves.degree_of_parallelism}: {', '.join(parts)}"


def subject(moves: PlannedMoves) -> Facts:
    """Occupancy, target and planner."""
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
        *(("or" if n else "chosen", text) for n, text in enumerate(moves.choice)),
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanReport:
    """A plan in SI units as :mod:`labseq.plans.plan_file` reads it, with occupancies as rows of 0 and 1.

    Attributes:
        planner: Name of the planner.
        degree_of_parallelism: Maximum number of tweezers on at once in the check of the plan.
        seed: Seed of all random numbers, or None.
        grid: Size, spacing and lattice of the grid.
        occupancy: Before the plan.
        target: "fill", sites to hold an atom, and "clear", sites to be empty.
        n_batches: Number of batches.
        n_atom_moves: Number of atom moves.
        duration_s: From the start of the cycle, overheads included.
        max_tweezers: Maximum number of mobile tweezers on at once.
        n_ejected: Atoms that leave the grid.
        n_filled: Sites of the target that hold an atom after the plan.
        n_surplus: Atoms that are left on sites to be empty.
        survival: Predicted cost of the plan, from the losses of the profile.
        choice: The planner's choice for the target, then the alternatives.
        batches: The batches. The sites of ejected atoms are off the grid.
        predicted: The occupancy after the plan, or before the refused batch.
        refused: The rule that the plan breaks, if it does.
    """

    planner: str
    degree_of_parallelism: int
    seed: int | None
    grid: Mapping[str, Any]
    occupancy: NDArray[np.integer[Any]]
    target: Mapping[str, NDArray[np.integer[Any]]]
    n_batches: int
    n_atom_moves: int
    duration_s: float
    max_tweezers: int
    n_ejected: int
    n_filled: int
    n_surplus: int
    survival: Survival
    choice: Sequence[str]
    batches: Sequence[Mapping[str, Any]]
    predicted: NDArray[np.integer[Any]]
    refused: Refusal | None

    @classmethod
    def of(cls, moves: PlannedMoves) -> PlanReport:
        """The numbers of a plan, and the plan."""
        plan, report, refused = moves.plan, moves.report, moves.refused
        about_grid = ("n_rows", "n_cols", "spacing_m", "lattice", "shear")
        return cls(
            planner=moves.planner,
            degree_of_parallelism=moves.degree_of_parallelism,
            seed=moves.seed,
            grid={name: getattr(moves.grid, name) for name in about_grid},
            occupancy=moves.occupancy.astype(int),
            target={"fill": moves.target.fill.astype(int), "clear": moves.target.clear.astype(int)},
            n_batches=plan.n_batches,
            n_atom_moves=plan.n_atom_moves,
            duration_s=report.duration_s,
            max_tweezers=moves.max_tweezers,
            n_ejected=moves.n_ejected,
            n_filled=moves.n_filled,
            n_surplus=report.n_surplus,
            survival=moves.survival,
            choice=moves.choice,
            batches=[_batch(batch) for batch in plan.batches],
            predicted=report.predicted.astype(int),
            refused=None if refused is None else Refusal(refused.batch, refused.move, str(refused)),
        )

    def totals(self) -> Facts:
        """The plan in numbers."""
        if self.refused is not None:
            valid = f"{self.n_batches}, {self.refused.batch} before the refused batch"
            return [("batches", valid), ("atom moves", str(self.n_atom_moves))]
        lost = f"{self.survival.n_lost:.2g} atoms expected until the next image"
        defect_free = percent(self.survival.p_defect_free, 1)
        surplus = f"{plural(self.n_surplus, 'atom')} on sites that must be empty"
        return [
            ("batches", str(self.n_batches)),
            ("atom moves", str(self.n_atom_moves)),
            ("duration", format_quantity(self.duration_s, "time")),
            ("tweezers", f"at most {self.max_tweezers} on at once"),
            ("ejected", plural(self.n_ejected, "atom")),
            *(
                [("lost", f"{lost}, then defect-free with probability {defect_free}")]
                if self.n_batches
                else []
            ),
            ("filled", f"{count_of(self.n_filled, int(self.target['fill'].sum()))} target sites"),
            *([("surplus", surplus)] if self.n_surplus else []),
        ]


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a plan is refused, with the batch and the atom move, or -1 for none in particular."""

    batch: int
    move: int
    why: str


def _batch(batch: Batch) -> Mapping[str, Any]:
    tones = {} if batch.tones is None else {"tones": batch.tones}
    return {"from": batch.from_sites, "to": batch.to_sites, "linked": batch.linked, **tones}
