"""What a run measures: as its sequence says, or chosen by the steps of its shots."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

from labseq.config.document import Document
from labseq.config.sequence import MeasureSettings, SequenceSpec, StepSpec
from labseq.errors import ConfigError, Loc, ProblemCollector, one_of
from labseq.messages import clean, did_you_mean
from labseq.model import TargetPattern
from labseq.model.records import unique_names
from labseq.roles import Step

Steps = Sequence[tuple[str, Step]]


def make_measures(
    document: Document,
    sequence: SequenceSpec,
    steps: Steps,
    target: TargetPattern | None,
    results: Collection[str],
    problems: ProblemCollector,
) -> list[dict[str, Any]]:
    """The quantities that a run measures, JSON-ready.

    Args:
        document: The sequence's file.
        sequence: Its content.
        steps: The steps of a shot; fewer than in the sequence if some have errors.
        target: The target; None if it has errors.
        results: Names of the results of the analyses.
        problems: Receives those of names, fits and parameters.
    """
    checked = steps if len(steps) == len(sequence.shot) else None
    if sequence.measure is None:
        return [{"value": name} for name in default_measures(sequence.shot, checked or (), target)]
    from labseq.assembly.quantities import check_quantity  # loads what other runs do not need

    for number, measure in enumerate(sequence.measure):
        place: Loc = ("measure", number)
        with problems:
            check_quantity(document, (*place, "value"), measure.value, "to measure", checked, results, target)
        if measure.fit is not None:
            with problems:
                _check_fit(document, sequence, place, measure)
    return [measure.model_dump(mode="json", exclude_defaults=True) for measure in sequence.measure]


def default_measures(shot: Sequence[StepSpec], steps: Steps, target: TargetPattern | None) -> tuple[str, ...]:
    """What a run without ``measure`` is about: its array, or without a target the survival of its atoms."""
    if target is not None and not target.is_none:
        return "filling", "defect_free"
    names = unique_names([name for name, _ in steps])
    images = [i for i, (_, step) in enumerate(steps) if step.takes_image]
    if len(images) < 2:
        return ("loading",) if images else ()
    first, last = images[-2:]
    if any(spec.kind == "load" for spec in shot[first:last]):
        return (f"loading:{names[last]}",)
    return (f"survival:{names[first]},{names[last]}",)


def _check_fit(document: Document, sequence: SequenceSpec, place: Loc, measure: MeasureSettings) -> None:
    """Check that a quantity can be fitted as its sequence says.

    Raises:
        ConfigError: There is no such model or parameter, or no scan.
    """
    from labseq.data.fit_models import MODELS  # most runs fit nothing

    def error(key: str, what: str, expected: str, hint: str = "") -> ConfigError:
        return document.error((*place, key), what, expected, hint)

    name = measure.fit or ""
    model = MODELS.get(name)
    if model is None:
        hint = did_you_mean(name, MODELS)
        raise error("fit", f"there is no model '{clean(name)}'", one_of([*MODELS]), hint)
    if sequence.scan is None:
        raise error("fit", "there is no scan along which to fit", "'scan' in the sequence")
    named = [("report", measure.report)] if measure.report else []
    for key, parameter in [*named, *(("parameters", name) for name in measure.parameters)]:
        if parameter not in model.units:
            hint = did_you_mean(parameter, model.units)
            what = f"the model '{name}' has no parameter '{clean(parameter)}'"
            raise error(key, what, one_of([*model.units]), hint)
