"""The quantities of a run: every number that its shots have, by name, with unit and error.

Tables, plots, fits, exports, adaptive scans and checks all take their values from here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from labseq.data.columns import DESCRIPTIONS, FRACTIONS, GROUPS, RESULT, quantities_in
from labseq.data.shot import Shot
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.messages import clean, closest, did_you_mean, visible
from labseq.model import TargetPattern
from labseq.model.estimate import Estimated, Rate, mean
from labseq.model.image_quantities import (
    NO_VALUE,
    OF_IMAGES,
    SITES,
    Events,
    StepSummary,
    events_of,
    find_image,
    mask_of,
    measured_by_default,
    measured_in,
    parse_name,
)
from labseq.recording.folders import RESULT_PREFIX, split_result
from labseq.recording.index import IndexRow
from labseq.recording.results import (
    ERROR,
    SHOT,
    read_results,
    result_columns,
    results_file,
    shots_with_result,
)
from labseq.recording.schema import unit_of

if TYPE_CHECKING:
    from labseq.data.reader import Run

MAX_SHOTS_READ: Final = 20
"""Maximum number of shots in which to look up the names of images."""


@dataclass(frozen=True, slots=True, eq=False)
class Quantity:
    """A number that each shot has, or a count of events in a number of trials.

    Attributes:
        name: Its name, such as "survival:before,after" or "stage.plan_s".
        unit: Its SI unit. "" for none.
        is_rate: True if it counts events. Then shots are added up, and the error is the Jeffreys interval.
            Otherwise the error is the standard error of the mean over shots.
        is_fraction: Whether it is shown in per cent.
        events_of: A shot -> its value and 1, or its numbers of events and trials. nan or 0 trials without.
    """

    name: str
    unit: str
    is_rate: bool
    is_fraction: bool
    events_of: Callable[[Shot], Events]

    def of_shot(self, shot: Shot) -> float:
        """The value of a shot. nan if it has none, or its file cannot be read."""
        n, n_trials = self.events(shot)
        return n / n_trials if n_trials else math.nan

    def over(self, shots: Iterable[Shot]) -> Estimated:
        """The mean over the shots that have a value, with its error."""
        events = [(n, n_trials) for n, n_trials in map(self.events, shots) if n_trials and not math.isnan(n)]
        if self.is_rate:
            return Rate(round(sum(n for n, _ in events)), round(sum(n for _, n in events)))
        return mean([n / n_trials for n, n_trials in events])

    def events(self, shot: Shot) -> Events:
        """The value of a shot and 1, or its events and trials. 0 trials without a value."""
        try:
            return self.events_of(shot)
        except RecordingError:
            return NO_VALUE


def make_quantity(
    name: str, target: TargetPattern, results: Mapping[str, Mapping[int, Any]] | None = None
) -> Quantity:
    """Make the quantity for a name that has been checked.

    Args:
        results: The results of analyses: name -> shot -> value.
    """
    kind = parse_name(name).kind
    if kind in OF_IMAGES:

        def of_images(shot: Shot) -> Events:
            known = _in_index(name, shot.row, target)
            return events_of(name, shot, target) if known is None else known

        return Quantity(name, "", OF_IMAGES[kind].is_rate, True, of_images)
    values = (results or {}).get(name)
    # results that are true or false are counted as events
    is_rate = name == "success" or (values is not None and {*map(type, values.values())} == {bool})

    def of_columns(shot: Shot) -> Events:
        value = quantities_in(shot.row).get(name) if values is None else values.get(shot.index)
        return NO_VALUE if value is None else (float(value), 1)

    return Quantity(name, unit_of(name), is_rate, is_rate or name in FRACTIONS, of_columns)


def _in_index(name: str, row: IndexRow, target: TargetPattern) -> Events | None:
    """A quantity of images, if the index has it. The shot's file is then not read."""
    if name in row.measured:
        return row.measured[name]
    if name not in WITH_TARGET or target.is_none:
        return None
    if not math.isnan(row.filling_fraction):
        return (row.filling_fraction if name == "filling" else float(bool(row.success))), 1
    # no image step has judged the shot, so its last image, which belongs to a cycle, counts
    if not len(row.images):
        return None
    n_defects, n_surplus = row.images.n_defects[-1], row.images.n_surplus[-1]
    if name == "filling":
        return (1 - n_defects / target.n_atoms, 1) if target.n_atoms else None
    return float(not n_defects and not n_surplus), 1


def quantity_problem(
    name: str,
    columns: Collection[str],
    images: Sequence[str],
    target: TargetPattern | None,
    open_prefixes: tuple[str, ...] = (),
) -> tuple[str, str, str] | None:
    """The problem with the name of a quantity, what was expected, and a hint. None if it is valid.

    Args:
        columns: The known names of quantities without images.
        images: The known names of images. Empty to accept any.
        target: The target of the run. None if it is not known.
        open_prefixes: Prefixes of names that are not known in advance.
    """
    kind, named, sites = parse_name(name)
    if kind not in OF_IMAGES:
        if not named and (name in columns or name.startswith(open_prefixes)):
            return None
        near = closest(kind, [*OF_IMAGES, *columns])
        hint = f"did you mean '{near}'?" if near else ""
        forms = (f"{kind}[:{quantity.images}]" for kind, quantity in OF_IMAGES.items())
        names = ", ".join([*forms, *columns, *(f"{prefix}<name>" for prefix in open_prefixes)])
        return f"there is no quantity '{clean(name)}'", f"one of {names}", hint
    of_images = OF_IMAGES[kind]
    if named and len(named) != of_images.n_images:
        what = f"'{clean(name)}' names {len(named)} image{'s' * (len(named) != 1)}"
        return what, f"{kind}:{of_images.images}", ""
    for image in named:
        is_known = image in images or image.isdecimal() or any(image.startswith(f"{i}_") for i in images)
        if images and not is_known:
            near = closest(image, images)
            problem = f"there is no image '{clean(image)}' for '{clean(name)}'"
            return problem, f"one of {', '.join(images)}", f"did you mean '{near}'?" if near else ""
    places = [images.index(image) for image in named if image in images]
    if len(places) == 2 and places[0] >= places[1]:
        return f"'{clean(name)}' must name an earlier and a later image", "the earlier image first", ""
    if of_images.needs_target and target is not None and target.is_none:
        return f"there is no '{clean(name)}': the run has no target", "loading or survival, or a target", ""
    return None if target is None else _sites_problem(name, sites, target)


def _sites_problem(name: str, sites: str, target: TargetPattern) -> tuple[str, str, str] | None:
    if "@" in name and not sites:
        return f"'{clean(name)}' names no sites after the '@'", SITES, ""
    try:
        mask = mask_of(sites, target)
    except ValueError as error:
        return clean(str(error)), SITES, did_you_mean(sites, ["target", "reservoir", *target.regions])
    if parse_name(name).kind == "filling" and not target.is_none and not (mask & target.fill).any():
        return f"the target fills no site of '{clean(name)}'", SITES, ""
    return None


def description_of(name: str) -> str:
    """The description of a quantity whose name has been checked."""
    kind = parse_name(name).kind
    if kind in OF_IMAGES:
        return OF_IMAGES[kind].about
    of_group = next((about for prefix, about in GROUPS.items() if name.startswith(prefix)), RESULT)
    return DESCRIPTIONS.get(name, of_group)


def image_names(run: Run) -> list[str]:
    """The names of the images of a run's first shots, in order."""
    names = dict[str, None]()
    for shot in run.shots[:MAX_SHOTS_READ]:
        try:
            names |= dict.fromkeys(image.name for image in shot.images)
        except RecordingError:
            continue
    return [*names]


def column_names(run: Run) -> list[str]:
    """The names of the quantities of a run that do not name an image."""
    names = dict.fromkeys(name for shot in run.shots[:MAX_SHOTS_READ] for name in quantities_in(shot.row))
    return [*names, *_numbers(run)]


def _numbers(run: Run) -> dict[str, dict[int, Any]]:
    """The results of analyses that are numbers."""
    return {
        name: values
        for name, values in result_columns(run.path).items()
        if all(isinstance(value, bool | int | float) for value in values.values())
    }


def find_quantity(run: Run, name: str) -> Quantity:
    """Find a quantity of a run by its name.

    Raises:
        ConfigError: The run has no such quantity. The message lists the quantities that it has.
    """
    if name in measured_by(run) and not name.startswith(RESULT_PREFIX):
        return quantity_of(run, name)  # already checked before the run; reading image names takes a while
    images = image_names(run) if parse_name(name).images else []
    problem = quantity_problem(name, column_names(run), images, run.target)
    if problem is not None:
        if why := why_no_results(run, name):
            raise ConfigError(Problem(why, visible(str(run.path)), expected=ANALYSE))
        message, expected, hint = problem
        raise ConfigError(Problem(message, clean(run.path.name), expected=expected, hint=hint))
    _check_no_load(run, name)
    return quantity_of(run, name)


ANALYSE: Final = "results, which 'labseq analyse' computes where they are missing"


def why_no_results(run: Run, name: str) -> str:
    """Why an analysis that the run's sequence lists has no results at all. "" for other quantities."""
    analysis, _ = split_result(name) or ("", "")
    listed = [one.get("use") for one in (run.record.get("resolved") or {}).get("analysis") or ()]
    if analysis not in listed:
        return ""
    rows, _ = read_results(results_file(run.path, analysis))
    if shots_with_result(rows):
        return ""
    failed = f": shot {rows[0][SHOT]}: {clean(str(rows[0][ERROR]))}" if rows else ""
    return f"the analysis '{clean(analysis)}' has no result of any shot{failed}"


WITH_TARGET: Final = ("filling", "defect_free")
"""What a run with a target measures if its sequence does not list quantities."""


def measures_of(run: Run) -> Sequence[Mapping[str, Any]]:
    """The entries of ``measure`` in a run's sequence: "value" and maybe "fit", "report", "parameters"."""
    return (run.record.get("resolved") or {}).get("measure") or ()


def measured_by(run: Run) -> tuple[str, ...]:
    """Names of the quantities that a run measures, the most important first."""
    return names_measured(run.record.get("resolved") or {}, run.target)


def names_measured(resolved: Mapping[str, Any], target: TargetPattern) -> tuple[str, ...]:
    """Names of the quantities measured, from the settings and the target of a run."""
    if names := measured_in(resolved):
        return names
    steps: list[StepSummary] = []
    for step in resolved.get("shot", ()):  # from an earlier version: kind -> settings, with a name
        kind = next((key for key in step if key not in ("name", "policy")), "")
        steps.append(StepSummary(step.get("name") or kind, kind == "image", kind == "load"))
    # even shots without images have a duration
    return measured_by_default(steps, has_target=not target.is_none) or ("duration_s",)


def quantity_of(run: Run, name: str) -> Quantity:
    """A quantity of a run whose name has been checked."""
    return make_quantity(name, run.target, _numbers(run) if name.startswith(RESULT_PREFIX) else None)


def steps_that_load(run: Run) -> frozenset[int]:
    """Indices of the steps of a run's shots that load atoms."""
    resolved: Mapping[str, Any] = run.record.get("resolved") or {}
    steps: Sequence[Mapping[str, Any]] = resolved.get("shot", ())
    return frozenset(i for i, step in enumerate(steps) if "load" in step)


def _check_no_load(run: Run, name: str) -> None:
    """Refuse survival between images if atoms are loaded between them, as far as the run's record tells."""
    kind, images, _ = parse_name(name)
    loads = steps_that_load(run)
    if kind != "survival" or not loads or not run.shots:
        return
    try:
        first, last = (
            find_image(run.shots[0], image, at) for image, at in zip(images or ("", ""), (0, -1), strict=True)
        )
    except RecordingError:
        return
    if first is not None and last is not None and any(first.step < i < last.step for i in loads):
        message = f"atoms are loaded between the images of '{clean(name)}'"
        raise ConfigError(
            Problem(message, clean(run.path.name), expected="two images without a 'load' between them")
        )
