"""Asking a scanner for the next point: it neither hangs the run nor leads it out of the ranges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

from labseq.config.wording import clean
from labseq.errors import DeviceError
from labseq.model import ScanRange, VisitedPoint
from labseq.roles import Scanner
from labseq.sequencer import Guard, StopFlag
from labseq.session.adaptive import Search
from labseq.session.constructing import construct_one
from labseq.units import written


class ScannerCall:
    """A scanner, with a deadline, and a check of each answer.

    Args:
        search: What chooses, and from what.
        seed: The run's seed.
        stop: The request to stop.

    Raises:
        ConfigError: The scanner refuses its settings; with their place.
        PluginLoadError: Its constructor raised.
    """

    def __init__(self, search: Search, seed: int, stop: StopFlag) -> None:
        self._search = search
        self._stop = stop
        self._timeout_s = search.scanned.bench.profile.timeouts.call
        self._scanner: Scanner = construct_one(search.chosen, search.space(seed))

    def ask(self, visited: Sequence[VisitedPoint]) -> dict[str, float] | None:
        """The next point, address -> value; None if the scanner wants no more.

        Raises:
            DeviceError: It raised, or gave something else than a point of its ranges; names it.
            DeviceTimeoutError: It did not answer in time.
            StopRequested: The run is to stop.
        """
        guard = Guard(self._stop)
        try:
            return guard.call(self._search.name, self._timeout_s, self.next_point, tuple(visited))
        finally:
            guard.end()

    def next_point(self, visited: Sequence[VisitedPoint]) -> dict[str, float] | None:
        """The scanner's answer, checked; for a guarded call, which names this function."""
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
        """A value that its range allows, without the dust of rounding."""
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
