"""What is looked at in a plan, whoever made it."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from labseq.errors import LabseqError
from labseq.model import Occupancy, Plan, TargetPattern
from labseq.roles import Planner
from labseq.testing.contracts.promises import ContractViolation, format_error
from labseq.testing.strategies import drawn

RETURNS_A_PLAN: Final = "plan() returns a Plan, whatever the grid, the loading and the target"
NO_ATOM_CREATED: Final = "no atom is created: every move starts with an atom of its own"


def plan_of(planner: Planner, target: TargetPattern, atoms: Occupancy) -> Plan:
    """What a planner plans.

    Raises:
        ContractViolation: It is no Plan, or the planner raises what is no LabseqError.
    """
    try:
        plan: Any = planner.plan(atoms, target)
    except LabseqError:
        raise
    except Exception as error:
        detail = f"it {format_error(error)} for\n{drawn(target, atoms)}"
        raise ContractViolation(RETURNS_A_PLAN, detail) from error
    if not isinstance(plan, Plan):
        raise ContractViolation(RETURNS_A_PLAN, f"it returned a {type(plan).__name__}")
    return plan


def replay(plan: Plan, atoms: Occupancy) -> Occupancy:
    """Follow every atom, however illegal its way may be.

    Returns:
        Where the atoms end, bool (n_rows, n_cols).

    Raises:
        ContractViolation: A move starts where no atom is.
    """
    held = {(int(row), int(col)) for row, col in np.argwhere(atoms)}
    for index, batch in enumerate(plan.batches):
        for row, col in batch.from_sites.tolist():
            if (row, col) not in held:
                detail = f"batch {index} takes an atom from ({row}, {col}); there is none"
                raise ContractViolation(NO_ATOM_CREATED, detail)
            held.remove((row, col))
        held.update((row, col) for row, col in batch.to_sites.tolist())
    end = np.zeros_like(atoms, order="C")
    for row, col in held:
        if 0 <= row < end.shape[0] and 0 <= col < end.shape[1]:
            end[row, col] = True
    return end


def equal(plan: Plan, other: Plan) -> bool:
    """Whether two plans are the same, batch for batch."""
    fields = ("moves", "batch_offsets", "linked")
    return all(np.array_equal(getattr(plan, name), getattr(other, name)) for name in fields)


def same(target: TargetPattern) -> TargetPattern:
    """A copy, for a planner that may write into what it is given."""
    return TargetPattern(target.fill.copy(), target.clear.copy(), target.name)
