"""What a run measures: as its sequence says, or chosen by the steps of its shots."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

from labseq.config.document import Document
from labseq.config.sequence import SequenceSpec
from labseq.errors import Loc, ProblemCollector
from labseq.model import TargetPattern
from labseq.model.image_quantities import StepSummary, measured_by_default
from labseq.plugins.host import PluginHost
from labseq.roles import Step

if TYPE_CHECKING:
    from labseq.config.scan import Scan

Steps = Sequence[tuple[str, Step]]


def make_measures(
    document: Document,
    sequence: SequenceSpec,
    steps: Steps,
    target: TargetPattern | None,
    results: Collection[str],
    scan: Scan | None,
    host: PluginHost,
    problems: ProblemCollector,
) -> list[dict[str, Any]]:
    """The quantities that a run measures, JSON-ready.

    Args:
        document: The sequence's file.
        sequence: Its content.
        steps: The steps of a shot; fewer than in the sequence if some have errors.
        target: The target; None if it has errors.
        results: Names of the results of the analyses.
        scan: The scan; None without one, or if it has errors.
        host: The plugins, which may offer models to fit.
        problems: Receives those of names, fits and parameters.
    """
    checked = steps if len(steps) == len(sequence.shot) else None
    if sequence.measure is None:
        summaries = [
            StepSummary(name, step.takes_image, spec.kind == "load")
            for spec, (name, step) in zip(sequence.shot, checked or (), strict=False)
        ]
        has_target = target is not None and not target.is_none
        return [{"value": name} for name in measured_by_default(summaries, has_target=has_target)]
    from labseq.assembly.quantities import check_quantity  # loads what other runs do not need

    for number, measure in enumerate(sequence.measure):
        place: Loc = ("measure", number, "value")
        with problems:
            check_quantity(document, place, measure.value, "to measure", checked, results, target)
            if measure.fit is not None:
                from labseq.assembly.fits import check_fit  # most runs fit nothing

                check_fit(document, sequence, scan, number, target, host)
    return [measure.model_dump(mode="json", exclude_defaults=True) for measure in sequence.measure]
