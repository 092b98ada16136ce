"""A run's adaptive scan: what chooses its points, from what, and what for; checked before it begins."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from labseq.config import ProblemCollector
from labseq.config.adaptive import SCANNER_KEYS, Adaptive, Ends
from labseq.config.scan import Axis
from labseq.config.wording import clean
from labseq.errors import ConfigError
from labseq.model import ScanRange, ScanSpace
from labseq.recording.chosen_points import SCANNER
from labseq.roles import Step
from labseq.session.choosing import ChosenPlugin, resolve
from labseq.session.constructing import construct_one
from labseq.session.figure_names import check_figure
from labseq.session.scan import Point, Scanned
from labseq.units import written

CLIMBED: Final = "to climb on"
"""What the figure of an adaptive scan is for."""

Steps = Sequence[tuple[str, Step]]


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """What chooses the points of an adaptive scan.

    Attributes:
        scanned: The scan; its points are the corners of what may be chosen from.
        adaptive: What the sequence says of it.
        chosen: The scanner.
        ranges: What it may choose from.
    """

    scanned: Scanned
    adaptive: Adaptive
    chosen: ChosenPlugin
    ranges: tuple[ScanRange, ...]

    @property
    def name(self) -> str:
        """The scanner as messages name it."""
        return f"scanner '{self.chosen.entry.name}'"

    @property
    def units(self) -> list[str]:
        """The unit that the values of each address are written in."""
        return [ends.unit for ends in self.adaptive.ends]

    def space(self, seed: int) -> ScanSpace:
        """What the scanner is constructed with."""
        return ScanSpace(self.ranges, self.adaptive.n_points, self.scanned.scan.repeats, seed)

    def at(self, values: Mapping[str, float], planner: ChosenPlugin, steps: tuple[tuple[str, Step], ...]) -> Point:
        """The settings of a point.

        Args:
            values: Address -> value, SI.
            planner: The planner where the scan does not change it.
            steps: The steps where it does not change them.

        Raises:
            ConfigError: What it changes does not take these values.
        """
        chosen = [values[one.address] for one in self.ranges]
        alone = self.scanned.of(self.scanned.scan.at(chosen))
        try:
            return alone.at(0, planner, steps)
        except ConfigError as error:
            raise alone.scan.explained(error) from None

    def told(self, values: Mapping[str, Any]) -> dict[str, str]:
        """The values of a point as they are written: address -> text."""
        pairs = zip(self.ranges, self.units, strict=True)
        return {one.address: written(values[one.address], unit) for one, unit in pairs}

    def record(self) -> dict[str, Any]:
        """The scan for the run's record, JSON-ready; the points are in the index."""
        return {
            "addresses": [one.address for one in self.ranges],
            "units": self.units,
            "ranges": [asdict(one) for one in self.ranges],
            SCANNER: self.chosen.dump(),
            "figure": self.adaptive.figure,
            "maximise": self.adaptive.maximise,
            "n_points": self.adaptive.n_points,
            "repeats": self.scanned.scan.repeats,
        }


def make_search(scanned: Scanned, planner: ChosenPlugin, steps: Steps, found: ProblemCollector) -> Search | None:
    """Check what chooses a scan's points; None if nothing does, or something is wrong.

    The scanner is constructed once, to see whether it can be.

    Args:
        scanned: The scan, its ends checked.
        planner: The planner where the scan does not change it.
        steps: Likewise the steps.
        found: Where the problems go.
    """
    adaptive = scanned.scan.adaptive
    if adaptive is None:
        return None
    n_before, document = len(found.problems), scanned.document
    with found:
        check_figure(document, adaptive.aim, adaptive.figure, CLIMBED, steps)
    chosen: ChosenPlugin | None = None
    with found:
        chosen = resolve(scanned.bench.host, document, "scanner", adaptive.choice, SCANNER_KEYS)
    low = scanned.at(0, planner, tuple(steps)).parameters
    high = scanned.at(math.prod(scanned.scan.shape) - 1, planner, tuple(steps)).parameters
    ranges: list[ScanRange] = []
    for axis, ends in zip(scanned.scan.axes, adaptive.ends, strict=True):
        with found:
            present = scanned.present(axis)
            ranges.append(_range(axis, ends, (low[axis.address], high[axis.address]), present, document.name))
    if chosen is None or len(found.problems) > n_before:
        return None
    search = Search(scanned, adaptive, chosen, tuple(ranges))
    with found:
        construct_one(chosen, search.space(0))
    return search


def _range(axis: Axis, ends: Ends, resolved: tuple[Any, Any], present: Any, name: str) -> ScanRange:
    """A range, if its ends are numbers that mean what is written."""
    low, high = ends.si(ends.low), ends.si(ends.high)
    if not all(map(_is_number, resolved)) or not all(map(math.isclose, resolved, (low, high))):
        what = f"'{clean(axis.address)}' is no number, or not the one that is written"
        raise ConfigError(axis.key.problem(name, what, "an address of a number or quantity"))
    is_whole = all(type(value) is int for value in resolved)
    if is_whole and ends.n_steps and (high - low) % ends.n_steps:
        what = f"{ends.n_steps} equal steps from {low:g} to {high:g} are no whole ones"
        raise ConfigError(
            axis.key.problem(name, what, f"a number of steps that {high - low:g} is a multiple of")
        )
    low, high = resolved if is_whole else (float(resolved[0]), float(resolved[1]))
    start = float(present) if _is_number(present) and low <= present <= high else math.nan
    return ScanRange(axis.address, low, high, is_whole, ends.n_steps, start)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
