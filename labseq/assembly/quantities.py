"""Checks that shots of a sequence have the quantities that its checks and its adaptive scan need."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Final

from labseq.assembly.profile import ResolvedProfile
from labseq.builtin.steps import ImageStep
from labseq.config.document import Document
from labseq.config.sequence import SequenceSpec
from labseq.data.columns import QUANTITIES
from labseq.data.quantities import quantity_problem
from labseq.errors import Loc, ProblemCollector, one_of
from labseq.messages import clean, did_you_mean, listing
from labseq.model import TargetPattern
from labseq.model.image_quantities import OF_IMAGES, parse_name
from labseq.model.records import unique_names
from labseq.recording.folders import split_result
from labseq.recording.index import SIMULATION
from labseq.roles import Hardware, Step
from labseq.sequencer.clock import CLOCK_SET, SLEPT

_JUDGED: Final = frozenset(
    {"success", "filling_fraction", "n_defects", "n_surplus", "seen_defect_free_cycle"}
)
"""Results that only shots with an image have."""
_READING: Final = "reading."


def readings_of(
    hardware: ResolvedProfile, steps: Sequence[tuple[str, Step]], *, is_whole: bool
) -> Iterator[str]:
    """The names of readings that shots on a profile may have. A name ends in "." if the rest is not known.

    Args:
        steps: The steps of a shot.
        is_whole: Whether the steps are complete, so that no error in a file hides steps or devices.
    """
    if not is_whole or hardware.dry_run != "off":  # in a dry run others replace the devices
        yield _READING
    for name, plugin in hardware.drivers.items():
        factory = plugin.entry.factory
        polled: Collection[str] | None = getattr(plugin.settings, "polled", None)
        if polled is not None:
            yield from (f"{_READING}{name}.{value}" for value in polled)
        # a factory function does not reveal whether its driver has its own poll()
        elif not isinstance(factory, type) or getattr(factory, "poll", None) is not Hardware.poll:
            yield f"{_READING}{name}."
    if "simulation" in hardware.chosen:
        yield f"{_READING}{SIMULATION}"
    yield from (f"{_READING}{name}" for name in (SLEPT, CLOCK_SET))
    for _, step in steps:
        yield from (_READING + note for note in ("",) if step.notes is None)
        yield from (_READING + note for note in step.notes or ())


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
        purpose: Its use, such as "to optimise".
        steps: The steps of a shot, or None if some have errors.
        results: Names of its readings, and of the results of its analyses as "analysis.NAME.KEY", or
            "analysis.NAME." if the keys are not known.
        target: The target. None if it has errors.

    Raises:
        ConfigError: No shot can have the quantity.
    """
    names = unique_names([step_name for step_name, _ in steps or ()])
    images = [image for image, (_, step) in zip(names, steps or (), strict=True) if step.takes_image]
    unforeseen = [result for result in results if result.endswith(".")]
    known = [*QUANTITIES, *(result for result in results if result not in unforeseen)]
    problem = quantity_problem(name, known, images, target, ("stage.", *dict.fromkeys(unforeseen)))
    if problem is not None:
        what, expected, hint = problem
        if name.startswith(_READING):
            readings = dict.fromkeys(one for one in results if one.startswith(_READING))
            what = f"no device of the profile and no step gives '{clean(name)}'"
            expected = one_of([f"{one}<name>" if one.endswith(".") else one for one in readings])
        raise document.error(place, f"{what} {purpose}", expected, _analysis_hint(name, results) or hint)
    needs_image = name in _JUDGED or parse_name(name).kind in OF_IMAGES
    if needs_image and steps is not None and not images:
        what = f"no shot has a {name}, because a shot takes no image"
        raise document.error(place, what, "an 'image' step in the shot, or another quantity")
    taken = [step for _, step in steps or () if step.takes_image]
    # a step of a plugin may take several images
    if parse_name(name).kind == "survival" and len(taken) == 1 and isinstance(taken[0], ImageStep):
        what = f"there is no '{clean(name)}' {purpose} because the shot has one image, '{clean(images[0])}'"
        raise document.error(place, what, "two images, for survival from one to the other")


def _analysis_hint(name: str, results: Iterable[str]) -> str:
    """How to get the result of an analysis that the sequence does not list, or "" for other names."""
    split = split_result(name)
    if split is None or split[0] in {one[0] for one in map(split_result, results) if one}:
        return ""
    return f"the sequence must list the analysis: 'analysis: [{{use: {clean(split[0])}}}]'"


def missing_quantity(shot: int, name: str, purpose: str, quantities: Iterable[str]) -> str:
    """The warning that a shot lacks a quantity.

    Args:
        name: Name of the quantity.
        purpose: Its use, such as "to optimise".
        quantities: Names of the quantities that the shot has.
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
    """Validate the checks of a sequence, with the arguments of :func:`check_quantity`."""
    for number, check in enumerate(sequence.policy.checks):
        place = "policy", "checks", number
        with problems:
            check_quantity(document, (*place, "value"), check.value, "to check", steps, results, target)
        if check.then == "skip_point" and sequence.scan is None:
            what = "without a scan there are no points to skip"
            problems.add(document.error((*place, "then"), what, "'warn' or 'stop'"))
