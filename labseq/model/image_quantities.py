"""Quantities that the images of a shot have: survival, filling, loading; of all sites or of some.

The name of such a quantity says all: "survival:before,after@target" is the survival of the target's atoms
from the image `before` to the image `after`. It is the same in a sequence, on the command line and in Python.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from labseq.model.grid import Occupancy, TargetPattern
from labseq.model.records import CycleRecord, ImageRecord, follow_atoms

Events = tuple[float, float]
"""A value and 1, or a number of events and the number of trials; 0 trials without a value."""

NO_VALUE: Final[Events] = (math.nan, 0.0)
SITES: Final = "target, reservoir, ROWS,COLUMNS such as 2:8,3, or a name under 'regions' in the sequence"
"""What may follow the "@" of a name."""


class ImagesOfShot(Protocol):
    """A shot with its images and what moved its atoms: one that was just taken, or a recorded one."""

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
        sites: The sites that count: see :data:`SITES`; "" for all.
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
        ValueError: They cannot be read, or there are none; says what was expected.
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
        raise ValueError(f"'{sites}' names no sites")
    if not mask.any():
        n_rows, n_cols = target.shape
        why = "the run has no target" if target.is_none and sites == "target" else f"of {n_rows} x {n_cols}"
        raise ValueError(f"there are no sites '{sites}' ({why})")
    return mask


def _span(first: str, colon: str, end: str) -> slice:
    """Rows or columns counted from 0: "3" is one, "2:8" are six, as in numpy."""
    start = int(first or 0)
    if not colon:
        return slice(start, start + 1) if first else slice(0, 0)
    return slice(start, int(end) if end else None)


def events_of(name: str, shot: ImagesOfShot, target: TargetPattern) -> Events:
    """A quantity of a shot's images.

    Args:
        name: Its name, which has been checked.
        shot: The shot.
        target: The target of the run.
    """
    kind, images, sites = parse_name(name)
    return OF_IMAGES[kind].events_of(shot, target, mask_of(sites, target), *images)


def find_image(shot: ImagesOfShot, name: str, default: int) -> ImageRecord | None:
    """The image of a name, or of an index counted from 0; without a name, the default."""
    images = shot.images
    if not name:
        return images[default] if images else None
    if name.isdecimal():
        return images[int(name)] if int(name) < len(images) else None
    return next((image for image in images if image.name == name), None)


def _survival(
    shot: ImagesOfShot, _: TargetPattern, mask: Occupancy, before: str = "", after: str = ""
) -> Events:
    first, last = find_image(shot, before, 0), find_image(shot, after, -1)
    if first is None or last is None or first.t_start_s >= last.t_start_s:
        return NO_VALUE
    # an image is taken at the end of its cycle, so that the cycle of the first image does not count
    start, end = (first.step, first.cycle), (last.step, last.cycle)
    cycles = (cycle for cycle in shot.cycles if start < (cycle.step, cycle.cycle) <= end)
    expected = np.logical_or(*follow_atoms(first.occupancy, cycles)) & mask
    return int(np.sum(expected & last.occupancy)), int(np.sum(expected))


def _loading(shot: ImagesOfShot, _: TargetPattern, mask: Occupancy, name: str = "") -> Events:
    image = find_image(shot, name, 0)
    return NO_VALUE if image is None else (float(image.occupancy[mask].mean()), 1)


def _filling(shot: ImagesOfShot, target: TargetPattern, mask: Occupancy, name: str = "") -> Events:
    image, fill = find_image(shot, name, -1), target.fill & mask
    if image is None or not fill.any():
        return NO_VALUE
    return 1 - np.count_nonzero(fill & ~image.occupancy) / np.count_nonzero(fill), 1


def _defect_free(shot: ImagesOfShot, target: TargetPattern, mask: Occupancy, name: str = "") -> Events:
    image = find_image(shot, name, -1)
    if image is None or target.is_none:
        return NO_VALUE
    wrong = (target.fill & ~image.occupancy) | (target.clear & image.occupancy)
    return float(not np.any(wrong & mask)), 1


@dataclass(frozen=True, slots=True)
class ImageQuantity:
    """A kind of quantity of one or two images.

    Attributes:
        about: Its description.
        n_images: Number of images that its name may give.
        is_rate: Whether it counts events in trials: shots are then added up.
        events_of: Its value: takes a shot, the target, the sites that count and the names of the images.
    """

    about: str
    n_images: int
    is_rate: bool
    events_of: Callable[..., Events]


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
"""The kinds, by the beginning of their names."""


def measured_in(resolved: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of the quantities that a run measures, the most important first.

    Args:
        resolved: The settings of the run, as its record has them; none in runs of earlier versions.
    """
    return tuple(one["value"] for one in resolved.get("measure", ()))
