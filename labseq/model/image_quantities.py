"""Quantities from the images of a shot, such as survival, filling and loading, for all sites or some.

Their names include images and sites: "survival:before,after@target" is the survival of the target's atoms
from the image `before` to the image `after`. Sequences, the command line and Python use the same names.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, Protocol, TypeAlias

import numpy as np

from labseq.model.grid import Occupancy, TargetPattern
from labseq.model.records import CycleRecord, ImageRecord, follow_atoms, unique_names

Events = tuple[float, float]
"""A value and 1, or a number of events and the number of trials. Without a value there are 0 trials."""

AtSites: TypeAlias = tuple[Occupancy, Occupancy]
"""Sites with an event and sites with a trial, such as survivors and atoms, each bool (n_rows, n_cols)."""

NO_VALUE: Final[Events] = (math.nan, 0.0)
SITES: Final = "target, reservoir, ROWS,COLUMNS such as 2:8,3, or a name under 'regions' in the sequence"
"""The sites that may follow the "@" of a name."""


class ImagesOfShot(Protocol):
    """A new or recorded shot, with its images and rearrangement cycles."""

    @property
    def images(self) -> Sequence[ImageRecord]:
        """The images, in the order they were taken."""
        ...

    @property
    def cycles(self) -> Sequence[CycleRecord]:
        """The rearrangement cycles."""
        ...


class QuantityName(NamedTuple):
    """The parts of a quantity's name.

    Attributes:
        kind: "survival", "filling", ..., or the whole name of a quantity without images.
        images: Names of images, or their indices.
        sites: The sites that count (see :data:`SITES`). "" for all.
    """

    kind: str
    images: tuple[str, ...] = ()
    sites: str = ""


def parse_name(name: str) -> QuantityName:
    """Split the name of a quantity.

    Example:
        >>> parse_name("survival:before,after@target")
        QuantityName(kind='survival', images=('before', 'after'), sites='target')
        >>> parse_name("filling@2:8,3").sites, parse_name("stage.plan_s").kind
        ('2:8,3', 'stage.plan_s')
    """
    body, _, sites = name.partition("@")
    kind, colon, images = body.partition(":")
    if kind not in OF_IMAGES and not colon:
        return QuantityName(name)
    named = tuple(image.strip() for image in images.split(",")) if colon else ()
    return QuantityName(kind, named, sites.strip())


def mask_of(sites: str, target: TargetPattern) -> Occupancy:
    """The sites of a name, bool (n_rows, n_cols).

    Raises:
        ValueError: ``sites`` cannot be read, or the grid has no such sites.
    """
    mask = np.zeros(target.shape, np.bool_)
    if sites == "":
        mask[:] = True
    elif sites == "target":
        mask = target.fill.copy()
    elif sites == "reservoir":
        mask = ~(target.fill | target.clear)
    elif sites in target.regions:
        mask = target.regions[sites].copy()
    elif match := re.fullmatch(r"(\d*)(:?)(\d*)\s*,\s*(\d*)(:?)(\d*)", sites):
        mask[_span(*match.groups()[:3]), _span(*match.groups()[3:])] = True
    else:
        raise ValueError(f"'{sites}' is not a set of sites")
    if not mask.any():
        n_rows, n_cols = target.shape
        why = "the run has no target" if target.is_none and sites == "target" else f"of {n_rows} x {n_cols}"
        raise ValueError(f"there are no sites '{sites}' ({why})")
    return mask


def _span(first: str, colon: str, end: str) -> slice:
    """Rows or columns, counted from 0 as in numpy, so "2:8" are the six from 2 to 7."""
    start = int(first or 0)
    if not colon:
        return slice(start, start + 1) if first else slice(0, 0)
    return slice(start, int(end) if end else None)


def events_of(name: str, shot: ImagesOfShot, target: TargetPattern) -> Events:
    """A quantity of a shot's images.

    Args:
        name: Name of the quantity, already checked.
        shot: The shot.
        target: The target of the run.
    """
    happened, tried = (int(np.count_nonzero(sites)) for sites in at_sites(name, shot, target))
    return OF_IMAGES[parse_name(name).kind].sum_up(happened, tried) if tried else NO_VALUE


def at_sites(name: str, shot: ImagesOfShot, target: TargetPattern) -> AtSites:
    """A quantity of a shot's images at each site that counts, with the arguments of :func:`events_of`."""
    kind, images, sites = parse_name(name)
    mask = mask_of(sites, target)
    happened, tried = OF_IMAGES[kind].at_sites(shot, target, *images)
    return happened & mask, tried & mask


def find_image(shot: ImagesOfShot, name: str, default: int) -> ImageRecord | None:
    """The image with a name or an index (counted from 0). Without a name, the default."""
    images = shot.images
    if not name:
        return images[default] if images else None
    if name.isdecimal():
        return images[int(name)] if int(name) < len(images) else None
    return next((image for image in images if image.name == name), None)


def _nowhere(target: TargetPattern) -> AtSites:
    none = np.zeros(target.shape, np.bool_)
    return none, none


def _survival(shot: ImagesOfShot, target: TargetPattern, before: str = "", after: str = "") -> AtSites:
    first, last = find_image(shot, before, 0), find_image(shot, after, -1)
    if first is None or last is None or first.t_start_s >= last.t_start_s:
        return _nowhere(target)
    # an image is taken at the end of its cycle, so the cycle of the first image does not count
    start, end = (first.step, first.cycle), (last.step, last.cycle)
    cycles = (cycle for cycle in shot.cycles if start < (cycle.step, cycle.cycle) <= end)
    expected = np.logical_or(*follow_atoms(first.occupancy, cycles))
    return expected & last.occupancy, expected


def _loading(shot: ImagesOfShot, target: TargetPattern, name: str = "") -> AtSites:
    image = find_image(shot, name, 0)
    return _nowhere(target) if image is None else (image.occupancy, np.ones(target.shape, np.bool_))


def _filling(shot: ImagesOfShot, target: TargetPattern, name: str = "") -> AtSites:
    image = find_image(shot, name, -1)
    return _nowhere(target) if image is None else (target.fill & image.occupancy, target.fill)


def _defect_free(shot: ImagesOfShot, target: TargetPattern, name: str = "") -> AtSites:
    image = find_image(shot, name, -1)
    if image is None:
        return _nowhere(target)
    right = (target.fill & image.occupancy) | (target.clear & ~image.occupancy)
    return right, target.fill | target.clear


@dataclass(frozen=True, slots=True)
class ImageQuantity:
    """A kind of quantity of one or two images.

    Attributes:
        about: Its description.
        n_images: Number of images that its name may give.
        is_rate: Whether it counts events in trials, so that shots are added up.
        needs_target: Whether it has no value in a run without a target.
        at_sites: Function of a shot, the target and the names of the images for the value at each site.
        sum_up: The value of a shot from its numbers of events and of trials.
    """

    about: str
    n_images: int
    is_rate: bool
    needs_target: bool
    at_sites: Callable[..., AtSites]
    sum_up: Callable[[int, int], Events]

    @property
    def images(self) -> str:
        """The images that its name may give, for messages."""
        return ",".join(["IMAGE"] * self.n_images)


OF_IMAGES: Final[Mapping[str, ImageQuantity]] = {
    "survival": ImageQuantity(
        "share of the atoms in one image that a later image shows, at the sites to which they were moved, "
        "by default from the first image to the last",
        n_images=2,
        is_rate=True,
        needs_target=False,
        at_sites=_survival,
        sum_up=lambda n, n_tried: (n, n_tried),
    ),
    "filling": ImageQuantity(
        "share of the target's sites with an atom, by default on the last image",
        n_images=1,
        is_rate=False,
        needs_target=True,
        at_sites=_filling,
        sum_up=lambda n, n_tried: (1 - (n_tried - n) / n_tried, 1),
    ),
    "defect_free": ImageQuantity(
        "whether the target is met, by default on the last image",
        n_images=1,
        is_rate=True,
        needs_target=True,
        at_sites=_defect_free,
        sum_up=lambda n, n_tried: (float(n == n_tried), 1),
    ),
    "loading": ImageQuantity(
        "share of all sites with an atom, by default on the first image",
        n_images=1,
        is_rate=False,
        needs_target=False,
        at_sites=_loading,
        sum_up=lambda n, n_tried: (n / n_tried, 1),
    ),
}
"""The kinds, by the beginning of their names."""


class StepSummary(NamedTuple):
    """Whether a step takes an image or loads atoms.

    Attributes:
        name: Name of the step.
        takes_image: Whether it takes an image.
        loads: Whether it loads atoms.
    """

    name: str
    takes_image: bool
    loads: bool


def measured_by_default(steps: Sequence[StepSummary], *, has_target: bool) -> tuple[str, ...]:
    """Quantities of a run without ``measure``: filling with a target, or else the survival of the atoms.

    Example:
        >>> steps = [("load", False, True), ("a", True, False), ("wait", False, False), ("b", True, False)]
        >>> measured_by_default([StepSummary(*step) for step in steps], has_target=False)
        ('survival:a,b',)
    """
    if has_target:
        return "filling", "defect_free"
    names = unique_names([step.name for step in steps])
    images = [i for i, step in enumerate(steps) if step.takes_image]
    if len(images) < 2:
        return ("loading",) if images else ()
    first, last = images[-2:]
    if any(step.loads for step in steps[first:last]):
        return (f"loading:{names[last]}",)
    return (f"survival:{names[first]},{names[last]}",)


def measured_in(resolved: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of the quantities that a run measures, the most important first.

    Args:
        resolved: The settings of the run from its record, which is empty in runs of earlier versions.
    """
    return tuple(one["value"] for one in resolved.get("measure", ()))
