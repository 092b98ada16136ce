"""Values that another control system sets for each shot, validated like the points of a scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from labseq.assembly.assemble import make_target
from labseq.assembly.plugin_choice import Configured
from labseq.assembly.point import Point
from labseq.assembly.points import ScanPoints
from labseq.assembly.profile import ResolvedProfile
from labseq.config.addresses import find
from labseq.config.document import Document
from labseq.config.scan import Axis, Scan, leader_axis
from labseq.config.sequence import SequenceSpec
from labseq.config.yaml_nodes import Mark, Node, compose
from labseq.errors import ConfigError, Loc, Problem, ProblemCollector, one_of
from labseq.messages import clean
from labseq.model import TargetPattern
from labseq.recording.run_file import WRITTEN_UNITS
from labseq.settings import PatternChoice
from labseq.units import split_quantity

_TARGET: Final[Loc] = ("target",)
_MAX_KNOWN: Final = 1000
"""Maximum number of remembered settings, because new values in every shot would fill the memory."""


@dataclass(frozen=True, slots=True, eq=False)
class LedPoints(ScanPoints):
    """The settings of shots with values that another control system has sent.

    As :class:`ScanPoints`, its axes are the addresses that may be set, without values. Its only point has the
    settings of the files.
    """

    def at(self, number: int) -> Point:  # noqa: ARG002 - there is one
        """The settings of the files, with the values of all addresses that may be set."""
        return self.with_texts({})

    def with_texts(self, texts: Mapping[str, str]) -> Point:
        """The settings with values as for ``--set``, by address. The same values give the same object.

        The parameters of the point contain every address that may be set.

        Raises:
            ConfigError: An address is unknown or may not be set, or a plugin refuses a value.
        """
        if len(self._known) > _MAX_KNOWN:
            self._known.clear()
        return self._once(frozenset(texts.items()), lambda: self._with_texts(texts))

    def _with_texts(self, texts: Mapping[str, str]) -> Point:
        problems, values = ProblemCollector(), list[tuple[Axis, Node]]()
        for address, text in texts.items():
            with problems:
                values.append(self._value(address, text))
        problems.raise_any()
        point = self.with_values(values)
        of_files = self._once("files", lambda: {axis.address: self.present(axis) for axis in self.scan.axes})
        parameters = {**of_files, **point.parameters}
        target = self._planner_and_steps(point.document)[_TARGET].plugin
        return replace(point, parameters=parameters, target=target)

    def record(self, units: Mapping[str, str]) -> dict[str, Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The scan for the run's record, JSON-ready. The points are in the index.

        Args:
            units: SI units of the addresses, for addresses without a unit in the file.
        """
        written = {axis.address: self.document.get(axis.loc) for axis in self.scan.axes}
        own = {
            address: split_quantity(value)[1] if isinstance(value, str) else ""
            for address, value in written.items()
        }
        return {
            "addresses": [*written],
            WRITTEN_UNITS: [own[address] or units.get(address, "") for address in written],
        }

    def _value(self, address: str, text: str) -> tuple[Axis, Node]:
        source = clean(f"{address}={text}"[:80])
        loc = find(self.document.root, address, source)
        axis = next((axis for axis in self.scan.axes if axis.loc == loc), None)
        if axis is None:
            what = f"the leader may not set '{clean(address)}'"
            raise ConfigError(Problem(what, expected=one_of([axis.address for axis in self.scan.axes])))
        return axis, compose(text, source, is_option=True) or Node(None, Mark(source))

    def _planner_and_steps(self, document: Document) -> dict[Loc, Configured[Any]]:
        """Planner, steps and target by the place of their settings."""
        problems, plugins = ProblemCollector(), dict[Loc, Configured[Any]]()
        with problems:
            # not super() alone, because with slots dataclass replaces the class that it would refer to
            plugins = super(LedPoints, self)._planner_and_steps(document)
        with problems:
            key = _TARGET, repr(document.get(_TARGET))
            plugins = {**plugins, _TARGET: self._once(key, lambda: self._make_target(document))}
        problems.raise_any()
        return plugins

    def _make_target(self, document: Document) -> Configured[TargetPattern]:
        sequence = self.sequence
        if document.get(_TARGET) is not None:
            choice = document.validate(PatternChoice, _TARGET).placed(*_TARGET)
            sequence = sequence.model_copy(update={"target": choice})
        target, dumped = make_target(self.hardware, document, sequence)
        return Configured(target, dumped or {})

    def _may_change(self, of_profile: bool, loc: Loc) -> bool:
        return not of_profile and (loc[0] == "target" or super(LedPoints, self)._may_change(of_profile, loc))


def led_points(
    document: Document, sequence: SequenceSpec, hardware: ResolvedProfile, problems: ProblemCollector
) -> LedPoints:
    """Check the settings that a leader may change.

    Args:
        problems: Receives addresses that do not exist or cannot be set.
    """
    if sequence.scan is not None:
        what = "a scan and a leader cannot both set values"
        problems.add(document.error(("scan",), what, "one of them", "remove 'scan' or 'leader'", key=True))
    axes: list[Axis] = []
    addresses = () if sequence.leader is None else sequence.leader.may_set
    for i, address in enumerate(addresses):
        with problems:
            mark = document.root.mark_at(("leader", "may_set", i))
            axes.append(leader_axis(address, mark, document))
    points = LedPoints(Scan(tuple((axis,) for axis in axes), 1, "sequential"), document, sequence, hardware)
    if not problems.problems:
        with problems:
            points.check(problems)
    return points
