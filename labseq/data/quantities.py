"""The quantities of a run: every number that its shots have, by name, with its unit and its error.

Tables, plots, fits, exports, adaptive scans and checks all take their values from here.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from labseq.data.columns import DESCRIPTIONS, FRACTIONS, GROUPS, RESULT, columns_of, quantities_in
from labseq.data.shot import Shot
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.messages import clean, closest
from labseq.model import ImageRecord, TargetPattern, follow_atoms
from labseq.model.estimate import Estimated, Rate, mean
from labseq.recording.results import PREFIX, result_columns
from labseq.recording.schema import unit_of
from labseq.units import parse_any

if TYPE_CHECKING:
    from labseq.data.reader import Run

NO_VALUE: Final = (math.nan, 0.0)
"""Events and trials of a shot without a value."""
MAX_SHOTS_READ: Final = 20
"""Maximum number of shots in which the names of images are looked up."""


@dataclass(frozen=True, slots=True, eq=False)
class Quantity:
    """A number that each shot has, or a count of events in a number of trials.

    Attributes:
        name: Its name: "survival:before,after", "stage.plan_s".
        unit: Its SI unit; "" for none.
        is_rate: Whether it counts events: shots are then added up, and the error is the Jeffreys interval;
            otherwise it is the standard error of the mean over shots.
        is_fraction: Whether it is shown in per cent.
        events_of: A shot -> its value and 1, or its number of events and of trials; nan or 0 trials without.
    """

    name: str
    unit: str
    is_rate: bool
    is_fraction: bool
    events_of: Callable[[Shot], tuple[float, float]]

    def of_shot(self, shot: Shot) -> float:
        """The value of a shot; nan if it has none, or its file cannot be read."""
        n, n_trials = self._events(shot)
        return n / n_trials if n_trials else math.nan

    def over(self, shots: Iterable[Shot]) -> Estimated:
        """The mean over those shots that have a value, with its error."""
        events = [(n, n_trials) for n, n_trials in map(self._events, shots) if n_trials and not math.isnan(n)]
        if self.is_rate:
            return Rate(round(sum(n for n, _ in events)), round(sum(n for _, n in events)))
        return mean([n / n_trials for n, n_trials in events])

    def _events(self, shot: Shot) -> tuple[float, float]:
        try:
            return self.events_of(shot)
        except RecordingError:
            return NO_VALUE


def _image(shot: Shot, name: str, default: int) -> ImageRecord | None:
    """The image of a name, or of an index counted from 0."""
    images = shot.images
    if not name:
        return images[default] if images else None
    if name.isdecimal():
        return images[int(name)] if int(name) < len(images) else None
    return next((image for image in images if image.name == name), None)


def _survival(shot: Shot, _: TargetPattern, before: str = "", after: str = "") -> tuple[float, float]:
    first, last = _image(shot, before, 0), _image(shot, after, -1)
    if first is None or last is None or first.t_start_s >= last.t_start_s:
        return NO_VALUE
    # an image is taken at the end of its cycle, so that the cycle of the first image does not count
    start, end = (first.step, first.cycle), (last.step, last.cycle)
    cycles = (cycle for cycle in shot.cycles if start < (cycle.step, cycle.cycle) <= end)
    expected = np.logical_or(*follow_atoms(first.occupancy, cycles))
    return int(np.sum(expected & last.occupancy)), int(np.sum(expected))


def _loading(shot: Shot, _: TargetPattern, name: str = "") -> tuple[float, float]:
    image = _image(shot, name, 0)
    return NO_VALUE if image is None else (float(image.occupancy.mean()), 1)


def _defects(shot: Shot, target: TargetPattern, name: str) -> tuple[int, int] | None:
    """Defects and surplus atoms on an image; without a name on the last one, from the index."""
    if name:
        image = _image(shot, name, -1)
        return image and (target.n_defects(image.occupancy), target.n_surplus(image.occupancy))
    images = shot.row.images
    return (images.n_defects[-1], images.n_surplus[-1]) if len(images) else None


def _filling(shot: Shot, target: TargetPattern, name: str = "") -> tuple[float, float]:
    if not name and not math.isnan(shot.filling_fraction):  # in the index: the shot's file is not read
        return shot.filling_fraction, 1
    defects = _defects(shot, target, name) if target.n_atoms else None
    return NO_VALUE if defects is None else (1 - defects[0] / target.n_atoms, 1)


def _defect_free(shot: Shot, target: TargetPattern, name: str = "") -> tuple[float, float]:
    if not name and not math.isnan(shot.filling_fraction):
        return shot.success, 1
    defects = None if target.is_none else _defects(shot, target, name)
    return NO_VALUE if defects is None else (not any(defects), 1)


@dataclass(frozen=True, slots=True)
class ImageQuantity:
    """A quantity of one or two images.

    Attributes:
        about: Its description.
        n_images: Number of images that its name may give.
        is_rate: See :class:`Quantity`.
        events_of: Its value, see :class:`Quantity`; takes a shot, the target and the names of the images.
    """

    about: str
    n_images: int
    is_rate: bool
    events_of: Callable[..., tuple[float, float]]


OF_IMAGES: Final[Mapping[str, ImageQuantity]] = {
    "survival": ImageQuantity(
        "atoms of an image that a later one still shows, at the sites to which they were moved; "
        "by default from the first image to the last",
        2,
        True,
        _survival,
    ),
    "filling": ImageQuantity("share of the target's sites with an atom; last image", 1, False, _filling),
    "defect_free": ImageQuantity("whether the target is met; last image", 1, True, _defect_free),
    "loading": ImageQuantity("share of all sites with an atom; first image", 1, False, _loading),
}
"""Quantities that follow from images; a name may give the images: "filling:before"."""


def split_name(name: str) -> tuple[str, tuple[str, ...]]:
    """Split the name of a quantity into its kind and its images.

    Example:
        >>> split_name("survival:before,after"), split_name("stage.plan_s")
        (('survival', ('before', 'after')), ('stage.plan_s', ()))
    """
    kind, colon, images = name.partition(":")
    return (kind, tuple(image.strip() for image in images.split(","))) if colon else (name, ())


def make_quantity(
    name: str, target: TargetPattern, results: Mapping[str, Mapping[int, Any]] | None = None
) -> Quantity:
    """A quantity of a name that has been checked.

    Args:
        name: Its name.
        target: The target of the run.
        results: The results of analyses: name -> shot -> value.
    """
    kind, images = split_name(name)
    if kind in OF_IMAGES:
        quantity = OF_IMAGES[kind]
        return Quantity(
            name, "", quantity.is_rate, True, lambda shot: quantity.events_of(shot, target, *images)
        )
    values = (results or {}).get(name)
    # results that are true or false are counted as events
    is_rate = name == "success" or (values is not None and {*map(type, values.values())} == {bool})

    def events_of(shot: Shot) -> tuple[float, float]:
        value = quantities_in(shot.row).get(name) if values is None else values.get(shot.index)
        return NO_VALUE if value is None else (float(value), 1)

    return Quantity(name, unit_of(name), is_rate, is_rate or name in FRACTIONS, events_of)


def quantity_problem(
    name: str, columns: Collection[str], images: Collection[str], open_prefixes: tuple[str, ...] = ()
) -> tuple[str, str, str] | None:
    """The problem with the name of a quantity, what was expected and a hint; None if it is right.

    Args:
        name: The name.
        columns: The known names of quantities without images.
        images: The known names of images; none to accept any.
        open_prefixes: Prefixes of names that are not known beforehand.
    """
    kind, named = split_name(name)
    if kind not in OF_IMAGES:
        if not named and (name in columns or name.startswith(open_prefixes or ("\0",))):
            return None
        near = closest(kind, [*OF_IMAGES, *columns])
        hint = f"did you mean '{near}'?" if near else ""
        forms = ("survival:IMAGE,IMAGE", *(f"{kind}[:IMAGE]" for kind in OF_IMAGES if kind != "survival"))
        names = ", ".join([*forms, *columns, *(f"{prefix}<name>" for prefix in open_prefixes)])
        return f"there is no quantity '{clean(name)}'", f"one of {names}", hint
    if named and len(named) != OF_IMAGES[kind].n_images:
        expected = "two images: survival:IMAGE,IMAGE" if kind == "survival" else f"one image: {kind}:IMAGE"
        return f"'{clean(name)}' names {len(named)}", expected, ""
    for image in named:
        is_known = image in images or image.isdecimal() or any(image.startswith(f"{i}_") for i in images)
        if images and not is_known:
            near = closest(image, images)
            problem = f"there is no image '{clean(image)}' for '{clean(name)}'"
            return problem, f"one of {', '.join(images)}", f"did you mean '{near}'?" if near else ""
    return None


def description_of(name: str) -> str:
    """The description of a quantity whose name has been checked."""
    kind = split_name(name)[0]
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
    """The names of the quantities of a run that need no image."""
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
    """A quantity of a run.

    Raises:
        ConfigError: The run has no such quantity; lists those that it has.
    """
    images = image_names(run) if split_name(name)[1] else []
    problem = quantity_problem(name, column_names(run), images)
    if problem is not None:
        message, expected, hint = problem
        raise ConfigError(Problem(message, clean(run.path.name), expected=expected, hint=hint))
    _check_no_load(run, name)
    return quantity_of(run, name)


def quantity_of(run: Run, name: str) -> Quantity:
    """A quantity of a run whose name has been checked."""
    return make_quantity(name, run.target, _numbers(run) if name.startswith(PREFIX) else None)


def steps_that_load(run: Run) -> frozenset[int]:
    """Indices of the steps of a run's shots that load atoms."""
    resolved: Mapping[str, Any] = run.record.get("resolved") or {}
    steps: Sequence[Mapping[str, Any]] = resolved.get("shot", ())
    return frozenset(i for i, step in enumerate(steps) if "load" in step)


def _check_no_load(run: Run, name: str) -> None:
    """Refuse survival between images with a loading between them, as far as the run's record tells."""
    kind, images = split_name(name)
    loads = steps_that_load(run)
    if kind != "survival" or not loads or not run.shots:
        return
    try:
        first, last = (
            _image(run.shots[0], image, at) for image, at in zip(images or ("", ""), (0, -1), strict=True)
        )
    except RecordingError:
        return
    if first is not None and last is not None and any(first.step < i < last.step for i in loads):
        message = f"atoms are loaded between the images of '{clean(name)}'"
        raise ConfigError(
            Problem(message, clean(run.path.name), expected="two images without a 'load' between them")
        )


_COMPARISONS: Final[Mapping[str, Callable[[float, float], bool]]] = {
    # a computed value and a typed one differ in their last digits
    "==": lambda a, b: math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-12),
    "!=": lambda a, b: not math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-12),
    ">=": operator.ge,
    "<=": operator.le,
    ">": operator.gt,
    "<": operator.lt,
}


def select_shots(run: Run, conditions: Iterable[str]) -> tuple[Shot, ...]:
    """The shots of a run that meet every condition, such as "filling:before == 1".

    Raises:
        ConfigError: A condition cannot be read, or names neither a quantity nor a column of the run.
    """
    shots = tuple(run.shots)
    for condition in conditions:
        match = re.match(r"\s*(\S+?)\s*(==|!=|>=|<=|>|<)\s*(\S.*?)\s*\Z", condition)
        if match is None:
            message = f"this is not a condition: '{clean(condition)}'"
            raise ConfigError(Problem(message, "--where", expected="for example 'filling:before == 1'"))
        name, comparison, limit = match.groups()
        value_of, is_text = _values_for_conditions(run, name)
        meets = _text_condition(comparison, limit) if is_text else _number_condition(comparison, limit)
        shots = tuple(shot for shot in shots if meets(value_of(shot)))
    return shots


def _values_for_conditions(run: Run, name: str) -> tuple[Callable[[Shot], Any], bool]:
    """The values of a column of the export, or of a quantity, and whether they are text."""
    columns = {column.name: column for column in columns_of(run)}
    if name in columns:
        values = columns[name].values
        of_shot = dict(zip((shot.index for shot in run.shots), values.tolist(), strict=True))
        return lambda shot: of_shot[shot.index], values.dtype == object
    if split_name(name)[0] not in OF_IMAGES:
        near = closest(name, [*columns, *OF_IMAGES])
        raise ConfigError(
            Problem(
                f"there is no quantity or column '{clean(name)}'",
                "--where",
                expected="a quantity, such as filling:before, or a column of labseq export",
                hint=f"did you mean '{near}'?" if near else "",
            )
        )
    return find_quantity(run, name).of_shot, False


def _number_condition(comparison: str, text: str) -> Callable[[float], bool]:
    try:
        limit = float(text) if re.fullmatch(r"[-+.\deE]+", text) else parse_any(text)[0]
    except ValueError as error:
        raise ConfigError(Problem(str(error), "--where", expected="a number, or one with a unit")) from error
    return lambda value: _COMPARISONS[comparison](value, limit)


def _text_condition(comparison: str, text: str) -> Callable[[str], bool]:
    if comparison not in ("==", "!="):
        raise ConfigError(Problem(f"'{comparison}' does not compare text", "--where", expected="== or !="))
    return lambda value: (value == text) == (comparison == "==")
