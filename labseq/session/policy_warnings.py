"""What ``labseq check`` says of the policies of a sequence."""

from __future__ import annotations

from collections.abc import Sequence

from labseq.errors import Problem
from labseq.model import TimelineEntry
from labseq.session.assembly import Assembly
from labseq.units import format_quantity


def timeout_warnings(
    assembly: Assembly, timeline: Sequence[tuple[str, Sequence[TimelineEntry]]]
) -> list[Problem]:
    """Steps that may need longer than the timeout of their policy.

    Args:
        assembly: The run.
        timeline: Name of each step and its bars.
    """
    problems: list[Problem] = []
    for spec, policy, (_, bars) in zip(assembly.sequence.shot, assembly.policy.steps, timeline, strict=True):
        longest_s = sum(bar.duration_s for bar in bars)
        if longest_s > policy.timeout_s:
            longest = format_quantity(longest_s, "time")
            what = f"the step takes up to {longest}, longer than its timeout of "
            what += format_quantity(policy.timeout_s, "time")
            place = (*spec.policy_loc, "timeout")
            problems.append(assembly.document.problem(place, what, f"more than {longest}"))
    return problems
