"""An adaptive scan: the scanner that chooses its points, and the ranges that it may choose from."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, cast

from labseq.assembly.plugin_choice import ChosenPlugin, construct_one, resolve
from labseq.assembly.points import Point, ScanPoints
from labseq.assembly.policies import check_quantity
from labseq.config.scan import Adaptive, Axis, Ends
from labseq.data.points import SCANNER
from labseq.errors import ConfigError, DeviceError, ProblemCollector
from labseq.guard import Guard, StopFlag
from labseq.messages import clean
from labseq.model import ScanRange, ScanSpace, VisitedPoint
from labseq.roles import Scanner, Step
from labseq.units import written

CLIMBED: Final = "to optimise"
"""What the scan needs its quantity for, in messages."""


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """The scanner of an adaptive scan, and the range of values of each scanned address.

    Attributes:
        scanned: The scan; its points are the corners of the ranges.
        adaptive: The settings in the sequence.
        chosen: The scanner.
        ranges: The range of each address.
    """

    scanned: ScanPoints
    adaptive: Adaptive
    chosen: ChosenPlugin
    ranges: tuple[ScanRange, ...]

    @property
    def name(self) -> str:
        """Name of the scanner in messages."""
        return f"scanner '{self.chosen.entry.name}'"

    @property
    def units(self) -> list[str]:
        """Unit in which the sequence writes the values of each address."""
        return [ends.unit for ends in self.adaptive.ends]

    def space(self, seed: int) -> ScanSpace:
        """The argument of the scanner's constructor."""
        return ScanSpace(self.ranges, self.adaptive.n_points, self.scanned.scan.repeats, seed)

    def at(self, values: Mapping[str, float]) -> Point:
        """The settings of a point, from address -> value, SI.

        Raises:
            ConfigError: A plugin refuses these values.
        """
        chosen = [values[one.address] for one in self.ranges]
        alone = self.scanned.scan.at(chosen)
        try:
            return self.scanned.with_values([*alone.values(0)])
        except ConfigError as error:
            raise alone.explained(error) from None

    def written(self, values: Mapping[str, Any]) -> dict[str, str]:
        """The values of a point as text in the units of the sequence: address -> text."""
        pairs = zip(self.ranges, self.units, strict=True)
        return {one.address: written(values[one.address], unit) for one, unit in pairs}

    def record(self) -> dict[str, Any]:
        """The scan for the run's record, JSON-ready; the points are in the index."""
        return {
            "addresses": [one.address for one in self.ranges],
            "written_units": self.units,
            "ranges": [asdict(one) for one in self.ranges],
            SCANNER: self.chosen.dump(),
            "figure": self.adaptive.quantity,
            "maximise": self.adaptive.maximise,
            "n_points": self.adaptive.n_points,
            "repeats": self.scanned.scan.repeats,
        }


def make_search(
    scanned: ScanPoints,
    steps: Sequence[tuple[str, Step]],
    results: Collection[str],
    found: ProblemCollector,
) -> Search | None:
    """Make and check the scanner of a scan; None if the scan is not adaptive, or if there is a problem.

    The scanner is constructed once, to check that its constructor accepts the settings.

    Args:
        scanned: The scan, its ends checked.
        results: Names of the results of the analyses, see :func:`labseq.assembly.policies.check_quantity`.
    """
    adaptive = scanned.scan.adaptive
    if adaptive is None:
        return None
    n_before, document = len(found.problems), scanned.document
    with found:
        check_quantity(document, adaptive.aim, adaptive.quantity, CLIMBED, steps, results)
    chosen: ChosenPlugin | None = None
    with found:
        chosen = resolve(scanned.hardware.host, document, "scanner", adaptive.choice)
    low = scanned.at(0).parameters
    high = scanned.at(math.prod(scanned.scan.shape) - 1).parameters
    ranges: list[ScanRange] = []
    for axis, ends in zip(scanned.scan.axes, adaptive.ends, strict=True):
        with found:
            present = scanned.present(axis)
            ranges.append(_range(axis, ends, (low[axis.address], high[axis.address]), present))
    if chosen is None or len(found.problems) > n_before:
        return None
    search = Search(scanned, adaptive, chosen, tuple(ranges))
    with found:
        construct_one(chosen, search.space(0))
    return search


def _range(axis: Axis, ends: Ends, resolved: tuple[Any, Any], present: Any) -> ScanRange:
    """The range of an axis, if its ends are numbers that the settings model accepts unchanged."""
    low, high = ends.low.si, ends.high.si
    if not all(map(_is_number, resolved)) or not all(map(math.isclose, resolved, (low, high))):
        what = f"'{clean(axis.address)}' is not a number, or not the one that is written"
        raise axis.key.error(what, "an address of a number or quantity")
    is_whole = all(type(value) is int for value in resolved)
    if is_whole and ends.n_steps and (high - low) % ends.n_steps:
        what = f"{ends.n_steps} equal steps from {low:g} to {high:g} are not whole numbers"
        raise axis.key.error(what, f"a number of steps that {high - low:g} is a multiple of")
    low, high = resolved if is_whole else (float(resolved[0]), float(resolved[1]))
    start = float(present) if _is_number(present) and low <= present <= high else math.nan
    return ScanRange(axis.address, low, high, is_whole, ends.n_steps, start)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


class ScannerCall:
    """Calls a scanner, with a timeout, and checks its answers.

    Raises:
        ConfigError: The scanner refuses its settings; with their place.
        PluginLoadError: Its constructor raised.
    """

    def __init__(self, search: Search, seed: int, stop: StopFlag) -> None:
        self._search = search
        self._stop = stop
        self._timeout_s = search.scanned.hardware.profile.timeouts.call
        self._scanner: Scanner = construct_one(search.chosen, search.space(seed))

    def choose(self, visited: Sequence[VisitedPoint]) -> dict[str, float] | None:
        """The next point, address -> value; None if the scanner has finished.

        Raises:
            DeviceError: The scanner raised, or returned no point of its ranges; names the scanner.
            DeviceTimeoutError: It did not answer in time.
            StopRequested: The operator asked to stop.
        """
        guard = Guard(self._stop)
        try:
            return guard.call(self._search.name, self._timeout_s, self.next_point, tuple(visited))
        finally:
            guard.end()

    def next_point(self, visited: Sequence[VisitedPoint]) -> dict[str, float] | None:
        """The scanner's answer, checked. Error messages of a guarded call name this function."""
        try:
            answer: Any = self._scanner.next_point(visited)
            given = dict(cast("Mapping[Any, Any]", answer)) if isinstance(answer, Mapping) else None
        except Exception as error:
            text = f"next_point() raised {type(error).__name__}"
            raise self._error(f"{text}: {error}" if str(error) else text) from error
        if answer is None:
            return None
        ranges = {one.address: one for one in self._search.ranges}
        if given is None or {*given} != {*ranges}:
            came = f"a {type(answer).__name__}" if given is None else f"values for {_names(given)}"
            raise self._error(f"next_point() gave {came}; expected a value for each of {_names(ranges)}")
        units = dict(zip(ranges, self._search.units, strict=True))
        return {address: self._value(one, given[address], units[address]) for address, one in ranges.items()}

    def _value(self, range_: ScanRange, value: object, unit: str) -> float:
        """A value snapped to its range, without rounding errors."""
        what = "a whole number" if range_.is_whole else "a number"
        expected = f"{what} from {written(range_.low, unit)} to {written(range_.high, unit)}"
        expected += f" on one of its {range_.n_steps} steps" if range_.n_steps else ""
        near = range_.allowed(value)
        if near is not None:
            return near
        came = f"{value:.12g} (SI)" if isinstance(value, float) and unit else clean(repr(value))
        raise self._error(f"next_point() gave {came} for '{range_.address}'; expected {expected}")

    def _error(self, text: str) -> DeviceError:
        return DeviceError(self._search.name, text)


def _names(addresses: Mapping[Any, Any]) -> str:
    return ", ".join(f"'{clean(str(address))}'" for address in addresses) or "no address"
