"""Whether the shots of a sequence have the quantities that its checks and its adaptive scan need."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Final

from labseq.config.document import Document
from labseq.config.sequence import SequenceSpec
from labseq.data.columns import QUANTITIES
from labseq.data.quantities import quantity_problem
from labseq.errors import Loc, ProblemCollector
from labseq.messages import clean, did_you_mean, listing
from labseq.model import TargetPattern
from labseq.model.image_quantities import OF_IMAGES, parse_name
from labseq.model.records import unique_names
from labseq.recording.folders import RESULT_PREFIX
from labseq.roles import Step

_JUDGED: Final = frozenset(
    {"success", "filling_fraction", "n_defects", "n_surplus", "seen_defect_free_cycle"}
)
"""Quantities (results of a shot) that only shots with an image have."""
_UNFORESEEN: Final = ("reading.", "stage.")
"""Prefixes of quantities that depend on the shot."""


def check_quantity(
    document: Document,
    place: Loc,
    name: str,
    purpose: str,
    steps: Sequence[tuple[str, Step]] | None,
    results: Collection[str],
    target: TargetPattern | None,
) -> None:
    """Check that the shots of a sequence can have a quantity.

    Args:
        place: Place of its name in the file.
        purpose: Its use: "to optimise".
        steps: The steps of a shot, or None if some have errors.
        results: Names of the results of its analyses, "analysis.NAME.KEY"; "analysis.NAME." if its keys are
            not known.
        target: The target; None if it has errors.

    Raises:
        ConfigError: No shot can have it.
    """
    names = unique_names([step_name for step_name, _ in steps or ()])
    images = [image for image, (_, step) in zip(names, steps or (), strict=True) if step.takes_image]
    unforeseen = [result for result in results if result.endswith(".")]
    known = [*QUANTITIES, *(result for result in results if result not in unforeseen)]
    problem = quantity_problem(name, known, images, target, (*_UNFORESEEN, *unforeseen))
    if problem is not None:
        what, expected, hint = problem
        raise document.error(place, f"{what} {purpose}", expected, _analysis_hint(name, results) or hint)
    needs_image = name in _JUDGED or parse_name(name).kind in OF_IMAGES
    if needs_image and steps is not None and not images:
        what = f"no shot has a {name}: it takes no image"
        raise document.error(place, what, "an 'image' step in the shot, or another quantity")


def _analysis_hint(name: str, results: Iterable[str]) -> str:
    """How to get the result of an analysis that the sequence does not list; "" for other names."""
    analysis = name.removeprefix(RESULT_PREFIX).split(".")[0]
    if not name.startswith(RESULT_PREFIX) or any(
        result.startswith(f"{RESULT_PREFIX}{analysis}.") for result in results
    ):
        return ""
    return f"the sequence must list the analysis: 'analysis: [{{use: {clean(analysis)}}}]'"


def missing_quantity(shot: int, name: str, purpose: str, quantities: Iterable[str]) -> str:
    """The warning that a shot lacks a quantity.

    Args:
        name: Name of the quantity.
        purpose: Its use: "to optimise".
        quantities: Names of the quantities that it has.
    """
    known = list(quantities)
    hint = did_you_mean(name, known) or f"it has {listing(known)}"
    return f"shot {shot} has no '{clean(name)}' {purpose} ({hint})"


def check_checks(
    document: Document,
    sequence: SequenceSpec,
    steps: Sequence[tuple[str, Step]] | None,
    results: Collection[str],
    target: TargetPattern | None,
    problems: ProblemCollector,
) -> None:
    """Check the checks of a sequence; arguments as for :func:`check_quantity`."""
    for number, check in enumerate(sequence.policy.checks):
        place = "policy", "checks", number
        with problems:
            check_quantity(document, (*place, "value"), check.value, "to check", steps, results, target)
        if check.then == "skip_point" and sequence.scan is None:
            what = "there is no scan whose points could be skipped"
            problems.add(document.error((*place, "then"), what, "'warn' or 'stop'"))
