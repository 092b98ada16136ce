"""The scanner that chooses the points of an adaptive scan, and the allowed ranges."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final, cast

from labseq.assembly.plugin_choice import ChosenPlugin, construct_one, resolve
from labseq.assembly.quantities import check_quantity
from labseq.config.scan import AdaptiveScan
from labseq.errors import ConfigError, DeviceError, ProblemCollector
from labseq.guard import Guard, StopFlag
from labseq.messages import clean, format_plugin_error
from labseq.model import ScanRange, ScanSpace, TargetPattern, VisitedPoint
from labseq.recording.run_file import SCANNER, WRITTEN_UNITS
from labseq.units import written

if TYPE_CHECKING:
    from labseq.assembly.point import Point
    from labseq.assembly.points import ScanPoints
    from labseq.config.scan import RangeAxis
    from labseq.roles import Scanner, Step

TO_OPTIMISE: Final = "to optimise"
"""Purpose of the scan's quantity, in messages."""


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """The scanner of an adaptive scan, and the range of values of each scanned address.

    Attributes:
        scan: The scan.
        corners: Validates its settings at the corners of the ranges.
        chosen: The scanner.
        ranges: The range of each address.
    """

    scan: AdaptiveScan
    corners: ScanPoints
    chosen: ChosenPlugin
    ranges: tuple[ScanRange, ...]

    @property
    def name(self) -> str:
        """Name of the scanner in messages."""
        return f"scanner '{self.chosen.entry.name}'"

    @property
    def units(self) -> list[str]:
        """Unit in which the sequence writes the values of each address."""
        return [axis.unit for axis in self.scan.ranges]

    def make_scanner(self, seed: int) -> Scanner:
        """Construct the scanner.

        Raises:
            ConfigError: The scanner refuses its settings. The error has their place.
            PluginLoadError: The constructor raised.
        """
        return construct_one(self.chosen, ScanSpace(self.ranges, self.scan.n_points, self.scan.repeats, seed))

    def at(self, values: Mapping[str, float]) -> Point:
        """The settings of a point, from address -> value, SI.

        Raises:
            ConfigError: A plugin refuses these values.
        """
        alone = self.scan.at([values[range_.address] for range_ in self.ranges])
        try:
            return self.corners.with_values([*alone.values(0)])
        except ConfigError as error:
            raise alone.explained(error) from None

    def values_in(self, parameters: Mapping[str, Any]) -> dict[str, float]:
        """The values of the point among the parameters of a shot: address -> value, SI."""
        return {range_.address: parameters[range_.address] for range_ in self.ranges}

    def written(self, values: Mapping[str, Any]) -> dict[str, str]:
        """The values of a point as text in the units of the sequence: address -> text."""
        pairs = zip(self.ranges, self.units, strict=True)
        return {range_.address: written(values[range_.address], unit) for range_, unit in pairs}

    def record(self) -> dict[str, Any]:
        """The scan for the run's record, JSON-ready. The points are in the index."""
        return {
            "addresses": [range_.address for range_ in self.ranges],
            WRITTEN_UNITS: self.units,
            "ranges": [asdict(range_) for range_ in self.ranges],
            SCANNER: self.chosen.dump(),
            "figure": self.scan.choice.quantity,
            "maximise": self.scan.choice.maximise is not None,
            "n_points": self.scan.n_points,
            "repeats": self.scan.repeats,
        }

    def choose(
        self, scanner: Scanner, visited: Sequence[VisitedPoint], stop: StopFlag
    ) -> dict[str, float] | None:
        """The scanner's next point as address -> value, SI, after checks. None if it has finished.

        Raises:
            DeviceError: The scanner raised, or returned a point outside of its ranges.
            DeviceTimeoutError: The scanner did not answer in time.
            StopRequested: The operator asked to stop.
        """
        guard, timeout_s = Guard(stop), self.corners.hardware.profile.timeouts.call_s

        def next_point() -> dict[str, float] | None:  # the guard's messages have its name
            try:
                answer: Any = scanner.next_point(tuple(visited))
                values = dict(cast("Mapping[Any, Any]", answer)) if isinstance(answer, Mapping) else None
            except Exception as error:
                raise self._error(f"next_point() raised {format_plugin_error(error)}") from error
            if answer is None:
                return None
            expected = [range_.address for range_ in self.ranges]
            if values is None or {*values} != {*expected}:
                came = f"a {type(answer).__name__}" if values is None else f"values for {_names(values)}"
                text = f"next_point() gave {came}; expected a value for each of {_names(expected)}"
                raise self._error(text)
            units = zip(self.ranges, self.units, strict=True)
            return {
                range_.address: self._snapped(range_, values[range_.address], unit) for range_, unit in units
            }

        try:
            return guard.call(self.name, timeout_s, next_point)
        finally:
            guard.end()

    def _snapped(self, range_: ScanRange, value: object, unit: str) -> float:
        """A value of a range, without rounding errors.

        Raises:
            DeviceError: The value is not in the range.
        """
        near = range_.allowed(value)
        if near is not None:
            return near
        what = "a whole number" if range_.is_whole else "a number"
        expected = f"{what} from {written(range_.low, unit)} to {written(range_.high, unit)}"
        expected += f" on one of its {range_.n_steps} steps" if range_.n_steps else ""
        came = f"{value:.12g} (SI)" if isinstance(value, float) and unit else clean(repr(value))
        raise self._error(f"next_point() gave {came} for '{range_.address}'; expected {expected}")

    def _error(self, text: str) -> DeviceError:
        return DeviceError(self.name, text)


def _names(addresses: Iterable[Any]) -> str:
    return ", ".join(f"'{clean(str(address))}'" for address in addresses) or "no address"


def make_search(
    corners: ScanPoints,
    steps: Sequence[tuple[str, Step]],
    results: Collection[str],
    target: TargetPattern | None,
    problems: ProblemCollector,
) -> Search | None:
    """Choose and check the scanner of a scan. None if its points are listed, or if there is a problem.

    The scanner is constructed once, to check that its constructor accepts the settings.

    Args:
        corners: The checked points of the scan, or for an adaptive scan the corners of its ranges.
        results: Names of the results of the analyses, see :func:`labseq.assembly.quantities.check_quantity`.
        target: The target of the sequence. None if it has errors.
    """
    scan = corners.scan
    if not isinstance(scan, AdaptiveScan) or problems.problems:
        return None
    document, choice = corners.document, scan.choice
    with problems:
        check_quantity(document, choice.aim, choice.quantity, TO_OPTIMISE, steps, results, target)
    chosen: ChosenPlugin | None = None
    with problems:
        chosen = resolve(corners.hardware.host, document, "scanner", choice)
    # the first corner has the lower end of every range, the last corner the upper end
    low = corners.at(0).parameters
    high = corners.at(math.prod(scan.shape) - 1).parameters
    ranges: list[ScanRange] = []
    for axis in scan.ranges:
        with problems:
            resolved = low[axis.address], high[axis.address]
            ranges.append(_range(axis, resolved, corners.present(axis)))
    if chosen is None or problems.problems:
        return None
    search = Search(scan, corners, chosen, tuple(ranges))
    with problems:
        search.make_scanner(0)
    return search


def _range(axis: RangeAxis, resolved: tuple[Any, Any], present: Any) -> ScanRange:
    """The range of an axis. Its ends must be numbers that the settings model accepts unchanged."""
    low, high = axis.low.si, axis.high.si
    if not all(map(_is_number, resolved)) or not all(map(math.isclose, resolved, (low, high))):
        what = f"the setting '{clean(axis.address)}' is not a number, or changes the given number"
        raise axis.key.error(what, "an address of a number or quantity")
    is_whole = all(type(value) is int for value in resolved)
    if is_whole and axis.n_steps and (high - low) % axis.n_steps:
        what = f"{axis.n_steps} equal steps from {low:g} to {high:g} are not whole numbers"
        raise axis.key.error(what, f"a number of steps that divides {high - low:g}")
    low, high = resolved if is_whole else (float(resolved[0]), float(resolved[1]))
    start = float(present) if _is_number(present) and low <= present <= high else math.nan
    return ScanRange(axis.address, low, high, is_whole, axis.n_steps, start)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
