"""Scans in a sequence: lists of values, ranges, and adaptive scans, whose points a scanner chooses.

Only the form of a scan is checked here. ``labseq.assembly.points`` checks whether plugins accept the values,
and ``labseq.assembly.search`` checks the scanner and its quantity.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Final, NamedTuple, Self, TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, WithJsonSchema, model_validator

from labseq.config.addresses import MAY_ADD, PROFILE, PROFILE_ROLES, VARIABLES, Override, find
from labseq.config.document import Document
from labseq.config.sequence import ScanOrder
from labseq.config.yaml_nodes import Mark, Node
from labseq.errors import ConfigError, Loc, Problem, ProblemCollector
from labseq.messages import clean, did_you_mean, listing, shown
from labseq.settings import Choice, Settings, Text, setting_error
from labseq.units import UNITS, dimension_of, factor_of, scaled, split_quantity, written

MAX_POINTS: Final = 10_000
"""Maximum number of points of a scan, and of values of an address."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One scanned address.

    Attributes:
        address: As written: "planner.degree_of_parallelism", "profile.mobile_tweezers.speed".
        loc: Location of its value in the sequence or the profile.
        values: The values, one per position of the group.
        key: Place of the address in the file.
    """

    address: str
    loc: Loc
    values: tuple[Node, ...]
    key: Mark

    @property
    def of_profile(self) -> bool:
        """Whether the value is in the profile."""
        return self.address.startswith(PROFILE)


Group = tuple[Axis, ...]
"""Axes that change together and so have the same number of values."""


@dataclass(frozen=True, slots=True)
class Scan:
    """The points of a scan: the outer product of its groups. The first group changes most slowly.

    Attributes:
        groups: The groups, in the order written. Without groups there is one point.
        repeats: Number of shots at each point.
        order: "sequential" or "shuffled".
        notes: Warnings, for example that ``--set`` replaced an axis.
    """

    groups: tuple[Group, ...]
    repeats: int
    order: ScanOrder
    notes: tuple[str, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of positions of each group."""
        return tuple(len(group[0].values) for group in self.groups)

    @property
    def n_points(self) -> int:
        """Number of points."""
        return math.prod(self.shape)

    def allows(self, n_shots: int, *, as_option: bool) -> bool:
        """Whether a run may have this number of shots. An option may ask for part of a scan, or for more."""
        return as_option or n_shots == self.n_points * self.repeats

    @property
    def axes(self) -> tuple[Axis, ...]:
        """All axes, in the order written."""
        return tuple(axis for group in self.groups for axis in group)

    def values(self, number: int) -> Iterator[tuple[Axis, Node]]:
        """Each axis with its value at a point, given by its number."""
        positions = np.unravel_index(number, self.shape) if self.groups else ()
        for group, position in zip(self.groups, positions, strict=True):
            for axis in group:
                yield axis, axis.values[position]

    def points_of_shots(self, seed: int, n_shots: int) -> NDArray[np.int32]:
        """Number of the point of each shot, int32 (n_shots,).

        Shots beyond n_points * repeats begin the scan again, so that a run can have more shots. A sequential
        scan takes all shots of a point before the next point. A shuffled scan takes every point once per
        round, in an order drawn from the run's seed. A drift of the machine then affects all points equally,
        even in a run that is stopped early.
        """
        points = np.arange(self.n_points, dtype=np.int32)
        if self.order == "sequential":
            n_passes = -(-n_shots // (self.n_points * self.repeats))
            return np.tile(np.repeat(points, self.repeats), n_passes)[:n_shots]
        # A key of one part, because the random numbers of shots have keys of two parts.
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0x5CA4,)))
        n_rounds = -(-n_shots // self.n_points)
        return np.concatenate([rng.permutation(points) for _ in range(n_rounds)])[:n_shots]

    def bound(self, document: Document) -> Self:
        """A copy in which the axes of the profile have their locations in the profile.

        Raises:
            ConfigError: An address does not exist in the profile, or a scan cannot change its setting.
        """
        problems, groups = ProblemCollector(), list[Group]()
        for group in self.groups:
            axes: list[Axis] = []
            for axis in group:
                with problems:
                    axes.append(_placed_in_profile(axis, document) if axis.of_profile else axis)
            groups.append(tuple(axes))
        problems.raise_any()
        _refuse_twice(groups)
        return replace(self, groups=tuple(groups))

    def at_first_point(self, document: Document, *, profile: bool) -> Document:
        """A copy of the sequence or of the profile with the values of the first point."""
        return put(self.values(0), document, profile=profile)

    def explained(self, error: ConfigError) -> ConfigError:
        """A copy of an error that adds to each invalid value its scanned address."""
        places = {
            (mark.source, mark.line, mark.column): axis.address
            for axis in self.axes
            for node in axis.values
            for mark in _marks(node)
            if mark.line
        }

        def with_address(problem: Problem) -> Problem:
            address = places.get((problem.source, problem.line, problem.column))
            note = f"from the scan of '{clean(address or '')}'"
            if address is None or note in problem.notes:
                return problem
            return replace(problem, notes=(*problem.notes, note))

        return ConfigError([with_address(problem) for problem in error.problems])


def put(values: Iterable[tuple[Axis, Node]], document: Document, *, profile: bool) -> Document:
    """A copy of the sequence or of the profile with the values of its axes."""
    placed = [(axis.loc, node, axis.key) for axis, node in values if axis.of_profile == profile]
    return document.with_values(placed) if placed else document


def _marks(node: Node) -> Iterator[Mark]:
    yield node.mark
    yield from node.keys.values()
    if isinstance(node.value, dict | list):
        for child in node.value.values() if isinstance(node.value, dict) else node.value:
            yield from _marks(child)


End: TypeAlias = Annotated[Any, WithJsonSchema({"type": ["number", "string"]})]
"""A number or a quantity, as the address requires."""
Points: TypeAlias = Annotated[int, Field(ge=1, le=MAX_POINTS)]


class EndsSettings(Settings):
    """The range of an address."""

    low: End = Field(alias="from", description="least value")
    high: End = Field(alias="to", description="greatest value")
    steps: Points | None = Field(
        default=None, description="number of equal steps in the range. Without it any value is allowed"
    )


class AdaptiveChoice(Choice):
    """A scanner chosen by name, with the scanner's settings as further keys of the same mapping."""

    # At most 6, since all combinations of their ends are checked before the run.
    over: dict[str, EndsSettings] = Field(
        min_length=1, max_length=6, description="addresses and their ranges"
    )
    maximise: Text | None = Field(default=None, description="quantity to maximise")
    minimise: Text | None = Field(default=None, description="quantity to minimise")
    points: Points | None = Field(default=None, description="maximum number of points")

    @model_validator(mode="after")
    def _check_aim(self) -> Self:
        if self.maximise is None and self.minimise is None:
            raise setting_error(
                "the scan has neither 'maximise' nor 'minimise'",
                "'maximise' or 'minimise' with the name of a quantity",
            )
        if self.maximise is not None and self.minimise is not None:
            what = "'maximise' and 'minimise' are both given"
            raise setting_error(what, "one of them", at=("minimise",), key=True)
        return self

    @property
    def quantity(self) -> str:
        """The quantity to maximise or minimise."""
        return self.maximise or self.minimise or ""

    @property
    def aim(self) -> Loc:
        """Location of the name of the quantity."""
        return (*self.loc, "minimise" if self.maximise is None else "maximise")


@dataclass(frozen=True, slots=True)
class RangeAxis(Axis):
    """An address whose values a scanner chooses. Its two ``values`` are the ends of its range.

    Attributes:
        low: The lowest value.
        high: The highest value, in the unit of the lowest.
        n_steps: Number of equal steps. 0 if any value between the ends is allowed.
        mark: Place of the range in the file.
    """

    low: Number
    high: Number
    n_steps: int
    mark: Mark

    @property
    def unit(self) -> str:
        """The unit in which values are written. "" for plain numbers."""
        return self.low.unit

    def at(self, value: float) -> Axis:
        """The axis at one value, SI, as a user would write it, rounded if there are no steps."""
        if not isinstance(value, int) and not self.n_steps:
            low, high = self.low.amount, self.high.amount
            # A ten-thousandth of the range is finer than any setting needs.
            n_decimals = 4 - math.floor(math.log10(high - low))
            amount = min(max(round(value / factor_of(self.unit), n_decimals), low), high)
            value = scaled(amount, factor_of(self.unit))
        text = written(value, self.unit)
        node = Node(text if self.unit else value, self.mark, raw=text)
        return Axis(self.address, self.loc, (node,), self.key)


@dataclass(frozen=True, slots=True)
class AdaptiveScan(Scan):
    """A scan whose points a scanner chooses during the run.

    As a :class:`Scan`, its points are the corners of the ranges, at which the settings are validated.

    Attributes:
        choice: The scanner, and the quantity to optimise.
        max_points: Maximum number of points.
    """

    choice: AdaptiveChoice = field(kw_only=True)
    max_points: int = field(kw_only=True)

    @property
    def n_points(self) -> int:
        """The largest possible number of points."""
        return self.max_points

    def allows(self, n_shots: int, *, as_option: bool) -> bool:
        """Whether a run may have this number of shots. A scanner cannot begin again for more."""
        n_most = self.n_points * self.repeats
        return n_shots == n_most or (as_option and n_shots < n_most)

    @property
    def ranges(self) -> tuple[RangeAxis, ...]:
        """The axes, in the order written."""
        return tuple(axis for axis in self.axes if isinstance(axis, RangeAxis))

    def at(self, values: Sequence[float]) -> Scan:
        """A scan of one point, with a value for each axis, SI."""
        axes = zip(self.ranges, values, strict=True)
        return Scan(tuple((axis.at(value),) for axis, value in axes), self.repeats, self.order)

    def at_first_point(self, document: Document, *, profile: bool) -> Document:  # noqa: ARG002
        """The document unchanged, because the first point is not known yet."""
        return document


def load_scan(
    document: Document,
    overrides: Sequence[Override],
    profile_set: Sequence[Override],
    problems: ProblemCollector,
) -> tuple[Document, Scan | None]:
    """Read the scan of a sequence, and put the values of its first point into a copy of the sequence.

    Args:
        document: A sequence with a scan.
        overrides: Its overrides.
        profile_set: Overrides of the profile, with their "profile.".
        problems: Receives the problems of the scan.

    Returns:
        The copy, with ``shots`` from the scan, and the scan. If it is invalid, a copy without it and None.
    """
    try:
        scan = read_scan(document, [*overrides, *profile_set])
    except ConfigError as error:
        problems.add(error)
        return _without_scan(document), None
    n_shots, shots = scan.n_points * scan.repeats, document.data.get("shots")
    is_option = any(override.address == "shots" for override in overrides)
    if shots is None:
        document = document.override("shots", str(n_shots), "the scan")
    elif type(shots) is int and not scan.allows(shots, as_option=is_option):
        what = f"shots is {shots}, but the scan has {scan.n_points} x {scan.repeats} = {n_shots}"
        expected = f"at most {n_shots}" if is_option else ""
        hint = "set 'points' for more" if is_option else "remove 'shots', which follows from the scan"
        problems.add(document.error(("shots",), what + " (points x repeats)", expected, hint))
    return scan.at_first_point(document, profile=False), scan


def _without_scan(document: Document) -> Document:
    for key, value in (("scan", "~"), ("shots", str(document.data.get("shots") or 1))):
        document = document.override(key, value, "the scan")
    return document


def read_scan(document: Document, fixed: Sequence[Override] = ()) -> Scan:
    """Read ``scan``, ``repeats`` and ``order`` of a sequence that has a scan.

    Args:
        fixed: The overrides, with "profile." for the profile. An axis that an override sets is left out,
            since ``--set`` takes precedence.

    Returns:
        The scan. Its axes in the profile have no locations yet.

    Raises:
        ConfigError: All errors in its form.
    """
    node = cast("Node", document.root.child("scan"))
    if isinstance(node.value, dict) and "use" in node.value:
        return _read_adaptive(document, fixed)
    return _read_listed(document, node, fixed)


def _repeats(document: Document) -> int:
    """Number of shots at each point. 1 if it has an error, which the model of the file reports."""
    repeats = document.get(("repeats",), 1)
    return repeats if type(repeats) is int and repeats >= 1 else 1


def _read_listed(document: Document, node: Node, fixed: Sequence[Override]) -> Scan:
    """Read a scan that lists the values of each address.

    Raises:
        ConfigError: All errors in its form.
    """
    problems, notes, groups = ProblemCollector(), list[str](), list[Group]()
    for mapping in _mappings(node, problems):
        axes: list[Axis] = []
        for address, (key, values) in mapping.items():
            with problems:
                axis = _placed(Axis(address, (), tuple(values_of(values, address)), key), document)
                axes += [axis] if _is_free(axis, fixed, document, notes) else []
        with problems:
            _check_together(axes)
        groups += [tuple(axes)] if axes else []
    if not problems.problems:
        with problems:
            _refuse_twice(groups)
    problems.raise_any()
    order: ScanOrder = "shuffled" if document.get(("order",)) == "shuffled" else "sequential"
    scan = Scan(tuple(groups), _repeats(document), order, tuple(notes))
    if scan.n_points > MAX_POINTS:
        what = f"the scan has {' x '.join(map(str, scan.shape))} = {scan.n_points} points"
        raise node.mark.error(what, f"at most {MAX_POINTS}")
    return scan


_Written = Mapping[str, tuple[Mark, Node]]
"""A group as written: address -> its place and values."""


def _mappings(node: Node, problems: ProblemCollector) -> list[_Written]:
    """The groups: each address of a mapping, or each mapping of a list."""
    expected = "a mapping of addresses and their values, or a list of such mappings"
    items = node.value if isinstance(node.value, list) else [node]
    groups: list[_Written] = []
    if not items:
        problems.add(node.mark.error("the scan is empty", expected))
    for item in items:
        if not isinstance(item.value, dict) or not item.value:
            name = "the scan" if item is node else "a group of the scan"
            value = "empty" if item.value == {} else shown(item.plain(), item.raw)
            problems.add(item.mark.error(f"{name} is {value}", expected))
            continue
        written = {address: (item.keys[address], values) for address, values in item.value.items()}
        groups += [{address: entry} for address, entry in written.items()] if item is node else [written]
    return groups


def _check_together(group: Sequence[Axis]) -> None:
    """Raise for a group whose axes differ in length, or in which a combination of values occurs twice."""
    for axis in group[1:]:
        n, n_first = len(axis.values), len(group[0].values)
        if n != n_first:
            address, first = clean(axis.address), clean(group[0].address)
            what = (
                f"'{address}' has {n} value{'s' if n > 1 else ''}, but '{first}' in its group has {n_first}"
            )
            raise axis.key.error(what, "as many values", "for every combination, put each into its own group")
    seen: set[str] = set()
    for i, node in enumerate(group[0].values if group else ()):
        position = json.dumps([axis.values[i].plain() for axis in group])
        if position in seen:
            what = f"{shown(node.plain(), node.raw)} occurs twice in the scan of '{clean(group[0].address)}'"
            raise node.mark.error(what, "each value once", "write 'repeats' for more shots")
        seen.add(position)


def _refuse_twice(groups: Sequence[Group]) -> None:
    """Raise for two addresses with locations if one contains the other."""
    axes = [axis for group in groups for axis in group]
    for i, axis in enumerate(axes):
        for other in axes[:i]:
            n = min(len(axis.loc), len(other.loc))
            if n and axis.of_profile == other.of_profile and axis.loc[:n] == other.loc[:n]:
                address, other_address = clean(axis.address), clean(other.address)
                what = f"'{address}' and '{other_address}' are both scanned and share a value"
                raise axis.key.error(what, "each value only once in the scan")


def _is_free(axis: Axis, fixed: Sequence[Override], document: Document, notes: list[str]) -> bool:
    """Whether no option sets the value that the axis would change."""
    for override in fixed:
        other: Loc = tuple(override.address.split("."))
        if not override.address.startswith(PROFILE):
            try:
                other = find(document.root, override.address)
            except ConfigError:  # reported where it was applied
                continue
        loc: Loc = tuple(axis.address.split(".")) if axis.of_profile else axis.loc
        if other == loc[: len(other)]:
            notes.append(f"{override.source} replaces the scan of '{clean(axis.address)}'")
            return False
        if loc and loc == other[: len(loc)]:
            what = f"the scan changes the whole of '{clean(axis.address)}'"
            raise ConfigError(Problem(what, override.source, expected=f"--set {clean(axis.address)}=..."))
    return True


def _read_adaptive(document: Document, fixed: Sequence[Override]) -> AdaptiveScan:
    """Read an adaptive scan.

    Raises:
        ConfigError: All errors in its form.
    """
    choice = document.validate(AdaptiveChoice, ("scan",), called="an adaptive scan").placed("scan")
    problems, notes, groups, repeats = ProblemCollector(), list[str](), list[Group](), _repeats(document)
    if document.get(("order",)) is not None:
        what = "'order' is given, but the points are chosen one after another"
        problems.add(document.error(("order",), what, "no 'order' for an adaptive scan", key=True))
    for address, range_ in choice.over.items():
        with problems:
            axis = _range_axis(document, address, range_.steps or 0)
            groups += [(axis,)] if _is_free(axis, fixed, document, notes) else []
    with problems:
        _refuse_twice(groups)
    shots, n_points = document.get(("shots",)), choice.points or 0
    if not n_points and type(shots) is int and shots >= 1:
        n_points = math.ceil(shots / repeats)
    if not n_points:
        what = "'points' (the maximum number of points) is missing from 'scan'"
        problems.add(document.error(("scan",), what, "a whole number"))
    problems.raise_any()
    if not groups:
        raise document.error(("scan", "over"), "nothing is left to choose because options set every address")
    return AdaptiveScan(
        tuple(groups), repeats, "sequential", tuple(notes), choice=choice, max_points=n_points
    )


def _range_axis(document: Document, address: str, n_steps: int) -> RangeAxis:
    loc = ("scan", "over", address)
    key, mark = document.root.mark_at(loc, key=True), document.root.mark_at(loc)
    nodes = [document.root.at((*loc, end)) for end in ("from", "to")]
    ends = low_node, high_node = tuple(node or Node(None, mark) for node in nodes)
    low, high = numbers_of(ends)
    if not low.amount < high.amount:
        limits = [shown(node.plain(), node.raw) for node in (low_node, high_node)]
        what = f"'{clean(address)}' goes from {limits[0]} to {limits[1]}"
        raise document.error((*loc, "to"), what, "'to' above 'from'")
    return _placed(RangeAxis(address, (), ends, key, low, high, n_steps, mark), document)


_A = TypeVar("_A", bound=Axis)


def _placed(axis: _A, document: Document) -> _A:
    """An axis with its location in the sequence. An axis of the profile is located later.

    Raises:
        ConfigError: The address does not exist, or a scan cannot change its setting.
    """
    if axis.of_profile:
        return axis
    axis = _found(axis, document)
    loc, top = axis.loc, axis.loc[0]
    is_step = top == "shot" and len(loc) > 2 and loc[2] not in ("name", "policy")
    if top in ("planner", VARIABLES) or (is_step and document.root.at(loc[:3])):
        return axis
    raise _unscannable(axis)


def leader_axis(address: str, mark: Mark, document: Document) -> Axis:
    """An address that another control system may set, as an axis without values.

    Raises:
        ConfigError: The address does not exist, or can only be set for a whole run.
    """
    axis = _found(Axis(address, (), (), mark), document)
    loc, top = axis.loc, axis.loc[0]
    is_step = top == "shot" and len(loc) > 3 and document.root.at(loc[:3]) is not None
    if is_step or top in ("planner", "target", VARIABLES):
        return axis
    expected = "an address in 'planner', 'target', 'shot.N.<step>' or 'variables'"
    raise mark.error(f"a leader cannot set '{clean(address)}'", expected)


def _placed_in_profile(axis: Axis, document: Document) -> Axis:
    axis = _found(axis, document)
    if axis.loc[0] in (*PROFILE_ROLES, VARIABLES) or (axis.loc[0] == "devices" and len(axis.loc) > 1):
        return axis
    raise _unscannable(axis)


def _found(axis: _A, document: Document) -> _A:
    """An axis with the location of its address. A variable must exist."""
    try:
        loc = find(document.root, axis.address.removeprefix(PROFILE), may_add=MAY_ADD)
    except ConfigError as error:
        problems = [axis.key.problem(p.what, p.expected, p.hint) for p in error.problems]
        raise ConfigError(problems) from None
    if loc[0] == VARIABLES and (len(loc) != 2 or document.root.at(loc) is None):
        known = list(document.get((VARIABLES,)) or {})
        what, hint = f"there is no variable '{clean(axis.address)}'", did_you_mean(str(loc[-1]), known)
        raise axis.key.error(what, listing(known) if known else "'variables'", hint)
    return replace(axis, loc=loc)


def _unscannable(axis: Axis) -> ConfigError:
    expected = "an address in 'planner', 'shot.N.<step>', 'variables' or 'profile.<role or device>'"
    return axis.key.error(f"a scan cannot change '{clean(axis.address)}'", expected)


class Number(NamedTuple):
    """A number as written: 50, its unit "um/ms" ("" if it has none), and whether it is whole."""

    amount: float
    unit: str
    is_whole: bool

    @property
    def si(self) -> float:
        """The value in SI."""
        return scaled(self.amount, factor_of(self.unit))


def numbers_of(nodes: Sequence[Node]) -> list[Number]:
    """Read numbers of one dimension, all in the unit of the first.

    Raises:
        ConfigError: A value is not a number, or has another dimension than the first.
    """
    numbers: list[Number] = []
    for node in nodes:
        number, first = _number(node), numbers[0] if numbers else None
        if first is not None and dimension_of(number.unit) != dimension_of(first.unit):
            dimension = dimension_of(first.unit)
            both = f"{shown(node.plain(), node.raw)} and {shown(nodes[0].plain(), nodes[0].raw)}"
            what = f"{both} have different dimensions"
            expected = f"a {dimension} with its unit" if dimension else "a number without a unit"
            raise node.mark.error(what, expected)
        if first is not None and number.unit != first.unit:
            number = Number(number.si / factor_of(first.unit), first.unit, is_whole=False)
        numbers.append(number)
    return numbers


def _number(node: Node) -> Number:
    value = node.value
    if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        return Number(float(value), "", isinstance(value, int))
    amount, unit = split_quantity(value) if isinstance(value, str) else (math.nan, "")
    if not math.isfinite(amount) or not any(unit in units for units in UNITS.values() if unit):
        what = f"{shown(node.plain(), node.raw)} is not a valid limit of a scan"
        raise node.mark.error(what, "a number, or a number with a unit such as '50 um/ms'")
    return Number(amount, unit, is_whole=False)


_VALUES: Final = "a list such as [3, 5, 7], {linspace: [50 um/ms, 200 um/ms, 4]} or {range: [0, 20, 5]}"


def values_of(node: Node, address: str) -> list[Node]:
    """The values that an address takes, each with its place.

    Args:
        node: The values in the scan.
        address: The address, for messages.

    Raises:
        ConfigError: ``node`` is neither a list nor one of :data:`FORMS`, is empty, or has more than
            :data:`MAX_POINTS` values.
    """
    if isinstance(node.value, list):
        if not node.value:
            raise node.mark.error(f"the scan of '{clean(address)}' has no values", _VALUES)
        return node.value
    if not isinstance(node.value, dict) or len(node.value) != 1:
        what = f"the scan of '{clean(address)}' is {shown(node.plain(), node.raw)}"
        raise node.mark.error(what, _VALUES)
    kind, given = next(iter(node.value.items()))
    if kind not in FORMS:
        what = f"'{clean(kind)}' is not a way to give values"
        raise node.keys[kind].error(what, listing(FORMS), did_you_mean(kind, FORMS))
    expected, amounts_of = FORMS[kind]
    if not isinstance(given.value, list) or len(given.value) != 3:
        raise given.mark.error(f"{kind} is {shown(given.plain(), given.raw)}", expected)
    amounts, first = amounts_of(given.mark, given.value)
    return [_written_node(float(f"{amount:.12g}"), first, given.mark) for amount in amounts]


def _linspace(_: Mark, limits: list[Node]) -> tuple[list[float], Number]:
    """The values of a ``linspace``, in the unit of the first, as integers if both ends are integers."""
    first, last, n_values = _ends(limits)
    amounts = np.linspace(first.amount, last.amount, n_values).tolist()
    return amounts, first._replace(is_whole=first.is_whole and last.is_whole)


def _geomspace(mark: Mark, limits: list[Node]) -> tuple[list[float], Number]:
    """The values of a ``geomspace``, in the unit of the first. All but the ends have three digits."""
    first, last, n_values = _ends(limits)
    if not first.amount * last.amount > 0:
        raise mark.error("a geomspace cannot reach or cross 0", "both ends above 0, or both below")
    amounts = np.geomspace(first.amount, last.amount, n_values).tolist()
    amounts[1:-1] = [float(f"{amount:.3g}") for amount in amounts[1:-1]]  # 31.6 ms, as a user would write it
    if len({*amounts}) < n_values:
        amounts = np.geomspace(first.amount, last.amount, n_values).tolist()
    return amounts, first._replace(is_whole=False)


def _ends(limits: list[Node]) -> tuple[Number, Number, int]:
    """Both ends and the number of values."""
    (first, last), count = numbers_of(limits[:2]), limits[2]
    if type(count.value) is not int or not 2 <= count.value <= MAX_POINTS:
        what = f"the number of values is {shown(count.plain(), count.raw)}"
        raise count.mark.error(what, f"a whole number from 2 to {MAX_POINTS}")
    return first, last, count.value


def _range(mark: Mark, limits: list[Node]) -> tuple[list[float], Number]:
    """The values of a ``range``, in the unit of its start, as integers if start and step are integers."""
    start, stop, step = numbers_of(limits)
    n_steps = (stop.amount - start.amount) / step.amount if step.amount else math.nan
    if not n_steps >= 0:
        what = f"the step {shown(limits[2].plain(), limits[2].raw)} does not lead from start to stop"
        raise limits[2].mark.error(what, "a step towards the stop")
    if n_steps >= MAX_POINTS:
        raise mark.error(f"the range has {n_steps:.3g} values", f"at most {MAX_POINTS}")
    n_values = math.floor(n_steps + 1e-9) + 1  # rounding must not drop the last value
    amounts = [start.amount + i * step.amount for i in range(n_values)]
    return amounts, start._replace(is_whole=start.is_whole and step.is_whole)


FORMS: Final[Mapping[str, tuple[str, Callable[[Mark, list[Node]], tuple[list[float], Number]]]]] = {
    "linspace": ("[first, last, number of values]", _linspace),
    "geomspace": ("[first, last, number of values]", _geomspace),
    "range": ("[start, stop, step]", _range),
}
"""Name of a form of a scan -> the three numbers that it takes, and the function that makes its values."""


def _written_node(amount: float, like: Number, mark: Mark) -> Node:
    """A value as a user would write it: with the unit, without rounding errors."""
    if like.unit:
        text = f"{amount:.12g} {like.unit}"
        return Node(text, mark, raw=text)
    value = int(amount) if like.is_whole and amount.is_integer() else amount
    return Node(value, mark, raw=repr(value))
