"""A plan that was written to a file, checked as if it had just been made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

from labseq.config import split_overrides
from labseq.config.plan_file import PlanFile, parse_plan
from labseq.errors import ConfigError, PlanError, Problem
from labseq.model import MotionSpec
from labseq.motion import check_plan
from labseq.session.occupancies import Source
from labseq.session.plan_inputs import Machine, PlanRequest, read_machine
from labseq.session.planning import PlannedMoves

_OPTIONS = {"target": "--target", "planner": "--planner", "degree_of_parallelism": "--dop"} | {
    "seed": "--seed",
    "origin": "--origin",
}
"""Field of a request -> the option that only planning takes."""


def read_plan(
    data: bytes, name: str, request: PlanRequest, *, announce: Callable[[str], None] = lambda _: None
) -> PlannedMoves:
    """Read the JSON of a plan, and check the plan as a run does.

    Args:
        data: UTF-8, what ``labseq plan --json`` writes.
        name: What messages call it.
        request: Names the profile with grid and motion; without one the grid is that of
            the file, and the motion the paper's. Nothing is planned.
        announce: Called with the name of a module before its kernels are compiled.

    Raises:
        ConfigError: It is no plan, it does not fit the grid or breaks a rule, or the request
            asks for something to be planned.
    """
    from labseq.kernels.compile import announcing

    file = parse_plan(data, name)
    machine = _machine(file, name, request)
    with announcing(announce):
        try:
            report = check_plan(
                file.plan,
                file.occupancy,
                file.target,
                file.degree_of_parallelism,
                machine.grid,
                machine.motion,
            )
        except PlanError as error:
            raise ConfigError(Problem(str(error), name)) from error
    return PlannedMoves(
        source=name,
        occupancy=file.occupancy,
        target=file.target,
        grid=machine.grid,
        motion=machine.motion,
        planner=file.planner,
        settings={},
        degree_of_parallelism=file.degree_of_parallelism,
        seed=file.seed,
        plan=file.plan,
        report=report,
    )


def _machine(file: PlanFile, name: str, request: PlanRequest) -> Machine:
    for_planner, for_profile = split_overrides(request.overrides)
    given = [field.name for field in fields(request) if getattr(request, field.name) != field.default]
    options = [option for key, option in _OPTIONS.items() if key in given]
    if options or for_planner:
        option = for_planner[0].source if for_planner else options[0]
        what = f"{name} is a plan already: there is nothing to plan"
        raise ConfigError(Problem(what, option, hint="leave the option out, or give an occupancy"))
    if request.profile is None and not for_profile:
        return Machine(file.grid, MotionSpec())
    return read_machine(request, for_profile, Source(file.occupancy, name))[0]
