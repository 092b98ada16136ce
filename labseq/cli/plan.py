"""``labseq plan``: one plan, to look at."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from labseq.cli.files import STDOUT, check_different, json_writer
from labseq.cli.output import say, report_compiling
from labseq.cli.words import plural
from labseq.kernels.compile import interpret
from labseq.session import PlannedMoves, PlanRequest, plan_moves, read_source

INTERPRETED_SITES: Final = 64 * 64
"""Up to this size a plan in plain Python takes less time than numba to load."""


@dataclass(frozen=True, slots=True)
class PlanOutput:
    """What is printed and written.

    Attributes:
        step: Whether to print the plan batch by batch.
        json: Name of the file for the plan as JSON; "-" for stdout, which then holds nothing else.
        png: The file for the plan as a picture.
    """

    step: bool = False
    json: str | None = None
    png: Path | None = None


def plan_once(request: PlanRequest, output: PlanOutput) -> None:
    """Plan the moves for one occupancy, and print or write them.

    Args:
        request: What is to be planned.
        output: What is printed and written.

    Raises:
        ConfigError: Something in the request is wrong, or a file cannot be written.
        PluginLoadError: A plugin that is named failed to load.
        PlanError: The planner failed, or its plan breaks a rule.
    """
    check_different(request.occupancy, output.json, output.png)
    write = json_writer(output.json)
    source = read_source(request.occupancy, request.seed)
    if output.png is not None:
        from labseq.drawing import check_picture

        check_picture(output.png, source.occupancy.shape)
    if source.occupancy.size <= INTERPRETED_SITES:
        interpret()
    moves = plan_moves(request, source, announce=report_compiling)
    if output.png is not None:
        _draw(moves, output.png)
    if output.json != STDOUT:
        write(moves.as_dict())
    if output.step or output.json != STDOUT:
        from labseq.cli.plan_report import print_plan

        print_plan(moves, sys.stdout, step=output.step)
    say(*(f"warning: {text}" for text in warnings(moves, request)), stream=sys.stderr)
    if output.json == STDOUT:
        write(moves.as_dict())


def warnings(moves: PlannedMoves, request: PlanRequest) -> list[str]:
    """What the user should know of a plan although nothing is wrong with it."""
    texts: list[str] = []
    asked, used = request.degree_of_parallelism, moves.degree_of_parallelism
    if asked is not None and asked != used:
        texts.append(f"--dop {asked}: planned with {used}, the most that the planner and the machine allow")
    n_defects, n_surplus = moves.report.n_defects, moves.report.n_surplus
    n_atoms, n_sites = int(moves.occupancy.sum()), moves.target.n_atoms
    if moves.n_missing_atoms:
        too_few = (
            f"{plural(n_atoms, 'atom')} for {plural(n_sites, 'target site')}, {moves.n_missing_atoms} too few"
        )
        texts.append(f"{too_few}; the plan fills {moves.n_filled}")
    elif n_defects:
        texts.append(f"the plan leaves {plural(n_defects, 'target site')} empty, with atoms enough")
    if n_surplus:
        texts.append(f"the plan leaves {plural(n_surplus, 'atom')} on sites that must be empty")
    return texts


def _draw(moves: PlannedMoves, path: Path) -> None:
    from labseq.cli.plan_report import title
    from labseq.drawing import PlanDrawing, save_plan

    drawing = PlanDrawing(
        title(moves), moves.source, moves.grid, moves.occupancy, moves.target, moves.plan, moves.report
    )
    save_plan(path, drawing)
