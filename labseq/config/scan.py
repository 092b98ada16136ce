"""Scans in a sequence: values, ranges and adaptive searches.

Whether there is such a scanner, and such a figure, is checked where the plugins are known,
in ``labseq.session.adaptive``.

What is checked here is the scan's own form. Whether a plugin accepts a value is
checked where the plugins are known, in ``labseq.session.scan``.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Final, Literal, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, WithJsonSchema, model_validator

from labseq.config.addresses import MAY_ADD, PROFILE, ROLES, VARIABLES, Override, find
from labseq.config.document import Document
from labseq.config.yaml_nodes import Mark, Node
from labseq.errors import ConfigError, Loc, Problem, ProblemCollector
from labseq.messages import clean, did_you_mean, listing, shown
from labseq.settings import Choice, Settings, Text, setting_error
from labseq.units import UNITS, factor_of, scaled, written

ScanOrder = Literal["sequential", "shuffled"]


_ORDER_KEY: Final = 0x5CA4  # apart from every shot's own random numbers, whose keys have two parts


@dataclass(frozen=True, slots=True)
class Axis:
    """One scanned address.

    Attributes:
        address: As written: "planner.degree_of_parallelism", "profile.mobile_tweezers.speed".
        loc: Where its value is, in the sequence or in the profile.
        values: One per position of its group.
        key: Where the address stands.
    """

    address: str
    loc: Loc
    values: tuple[Node, ...]
    key: Mark

    @property
    def of_profile(self) -> bool:
        """Whether the value is the profile's."""
        return self.address.startswith(PROFILE)


Group = tuple[Axis, ...]
"""Axes that go together: all have as many values."""


@dataclass(frozen=True, slots=True)
class Scan:
    """The points of a scan: the outer product of its groups, the first slowest.

    Attributes:
        name: The sequence's name in messages.
        groups: The groups, in the order written; without any there is one point.
        repeats: Shots of each point.
        order: "sequential" or "shuffled".
        notes: What the user should know, for example that ``--set`` replaced an axis.
        adaptive: What chooses the points, if they are not known beforehand: then the groups are of one
            axis each, whose two values are the ends of its range.
    """

    name: str
    groups: tuple[Group, ...]
    repeats: int
    order: ScanOrder
    notes: tuple[str, ...] = ()
    adaptive: Adaptive | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of positions of each group."""
        return tuple(len(group[0].values) for group in self.groups)

    @property
    def n_points(self) -> int:
        """Number of points; of an adaptive scan, the most that there may be."""
        return math.prod(self.shape) if self.adaptive is None else self.adaptive.n_points

    @property
    def axes(self) -> tuple[Axis, ...]:
        """All axes, in the order written."""
        return tuple(axis for group in self.groups for axis in group)

    def groups_in(self, in_profile: bool) -> list[int]:
        """Indices of the groups that change values of the profile, or of the sequence."""
        groups = enumerate(self.groups)
        return [i for i, group in groups if any(axis.of_profile == in_profile for axis in group)]

    def positions(self, point: int) -> tuple[int, ...]:
        """The position in each group that makes a point, counted from 0."""
        return tuple(int(i) for i in np.unravel_index(point, self.shape)) if self.groups else ()

    def values(self, point: int) -> Iterator[tuple[Axis, Node]]:
        """Each axis with its value at a point."""
        for group, position in zip(self.groups, self.positions(point), strict=True):
            for axis in group:
                yield axis, axis.values[position]

    def points_of_shots(self, seed: int) -> NDArray[np.int32]:
        """The point of each shot, int32 (n_points * repeats,).

        Sequential: all shots of a point, then the next. Shuffled: round by round; each round
        takes every point once, in an order drawn from the run's seed, so that a drift of the
        machine meets all points alike, also in a run that is stopped early.
        """
        points = np.arange(self.n_points, dtype=np.int32)
        if self.order == "sequential":
            return np.repeat(points, self.repeats)
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_ORDER_KEY,)))
        return np.concatenate([rng.permutation(points) for _ in range(self.repeats)])

    def at(self, values: Sequence[float]) -> Scan:
        """A point of an adaptive scan, as a scan of that point alone.

        Args:
            values: A value for each axis, SI.
        """
        assert self.adaptive is not None
        pairs = zip(self.axes, self.adaptive.ends, values, strict=True)
        groups = tuple((replace(axis, values=(ends.node(value),)),) for axis, ends, value in pairs)
        return replace(self, groups=groups)

    def begun(self, document: Document, *, profile: bool) -> Document:
        """A copy of the sequence or of the profile with the values that a run begins with.

        Those of the first point; of an adaptive scan, which has none yet, those of the file.
        """
        return document if self.adaptive is not None else self.put(document, 0, profile=profile)

    def put(self, document: Document, point: int, *, profile: bool) -> Document:
        """A copy of the sequence or of the profile with the values of a point."""
        pairs = self.values(point)
        return document.with_values((axis.loc, node) for axis, node in pairs if axis.of_profile == profile)

    def explained(self, error: ConfigError) -> ConfigError:
        """An error that says of each wrong value which address the scan puts it into."""
        places = {
            (mark.line, mark.column): axis.address
            for axis in self.axes
            for node in axis.values
            for mark in _marks(node)
        }

        def with_address(problem: Problem) -> Problem:
            address = places.get((problem.line, problem.column)) if problem.source == self.name else None
            note = f"the scan puts it into '{clean(address or '')}'"
            is_told = address is None or note in problem.notes
            return problem if is_told else replace(problem, notes=(*problem.notes, note))

        return ConfigError([with_address(problem) for problem in error.problems])


def _marks(node: Node) -> Iterator[Mark]:
    yield node.mark
    yield from node.keys.values()
    if isinstance(node.value, dict | list):
        for child in node.value.values() if isinstance(node.value, dict) else node.value:
            yield from _marks(child)


MAX_POINTS: Final = 10_000
"""Most points of a scan."""

_EXPECTED: Final = "a list such as [3, 5, 7], {linspace: [50 um/ms, 200 um/ms, 4]} or {range: [0, 20, 5]}"
_FORMS: Final = {
    "linspace": "[first, last, number of values]",
    "range": "[start, stop, step]",
}
_NUMBER: Final = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(\S.*)?\Z")
_FITS: Final = 1e-9  # of a step: what rounding may take from the last value of a range


class Number(NamedTuple):
    """A number as written: 50, "um/ms" and the dimension that the unit belongs to ("" without unit)."""

    amount: float
    unit: str
    dimension: str
    is_whole: bool


def values_of(node: Node, address: str, name: str) -> list[Node]:
    """The values that an address takes, each with its place.

    Args:
        node: What the scan says of the address.
        address: The address, for messages.
        name: The sequence's name in messages.

    Raises:
        ConfigError: It is no list, ``linspace`` or ``range``, is empty, or has more than
            :data:`MAX_POINTS` values.
    """
    if isinstance(node.value, list):
        if not node.value:
            raise _error(node.mark, name, f"the scan of '{clean(address)}' has no values", _EXPECTED)
        return node.value
    if not isinstance(node.value, dict) or len(node.value) != 1:
        what = f"the scan of '{clean(address)}' is {shown(node.plain(), node.raw)}"
        raise _error(node.mark, name, what, _EXPECTED)
    kind, given = next(iter(node.value.items()))
    if kind not in _FORMS:
        what = f"'{clean(kind)}' is no way to give values"
        raise _error(node.keys[kind], name, what, listing(_FORMS), did_you_mean(kind, _FORMS))
    if not isinstance(given.value, list) or len(given.value) != 3:
        raise _error(given.mark, name, f"{kind} is {shown(given.plain(), given.raw)}", _FORMS[kind])
    return _linspace(given, name) if kind == "linspace" else _range(given, name)


def _linspace(given: Node, name: str) -> list[Node]:
    assert isinstance(given.value, list)
    first, last = alike(given.value[:2], name)
    count = given.value[2]
    if type(count.value) is not int or not 2 <= count.value <= MAX_POINTS:
        what = f"the number of values is {shown(count.plain(), count.raw)}"
        raise _error(count.mark, name, what, f"a whole number from 2 to {MAX_POINTS}")
    amounts = np.linspace(first.amount, last.amount, count.value)
    return _nodes(amounts.tolist(), first, given.mark, whole=first.is_whole and last.is_whole)


def _range(given: Node, name: str) -> list[Node]:
    assert isinstance(given.value, list)
    start, stop, step = alike(given.value, name)
    way = stop.amount - start.amount
    n_steps = way / step.amount if step.amount else math.nan
    if not n_steps >= 0:
        what = (
            f"the step {shown(given.value[2].plain(), given.value[2].raw)} does not lead from start to stop"
        )
        raise _error(given.value[2].mark, name, what, "a step towards the stop")
    if n_steps >= MAX_POINTS:
        raise _error(given.mark, name, f"the range has {n_steps:.3g} values", f"at most {MAX_POINTS}")
    amounts = [start.amount + i * step.amount for i in range(math.floor(n_steps + _FITS) + 1)]
    return _nodes(amounts, start, given.mark, whole=start.is_whole and step.is_whole)


def alike(nodes: list[Node], name: str) -> list[Number]:
    """Numbers of one dimension, all in the unit of the first.

    Args:
        nodes: The numbers, with or without units.
        name: The sequence's name in messages.

    Raises:
        ConfigError: One is no number, or is of another dimension than the first.
    """
    numbers = [_number(node, name) for node in nodes]
    first = numbers[0]
    alike = [first]
    for node, number in zip(nodes[1:], numbers[1:], strict=True):
        if number.dimension != first.dimension:
            what = f"{shown(node.plain(), node.raw)} does not go with {shown(nodes[0].plain(), nodes[0].raw)}"
            dimension = first.dimension
            expected = f"a {dimension} with its unit" if dimension else "a number without a unit"
            raise _error(node.mark, name, what, expected)
        alike.append(_in_unit(number, first))
    return alike


def _number(node: Node, name: str) -> Number:
    if type(node.value) in (int, float) and math.isfinite(amount := float(node.value)):  # pyright: ignore[reportArgumentType]
        return Number(amount, "", "", isinstance(node.value, int))
    match = _NUMBER.match(node.value.strip()) if isinstance(node.value, str) else None
    unit = (match[2] or "") if match else ""
    dimension = next((known for known, units in UNITS.items() if unit and unit in units), "")
    if match is None or not dimension or not math.isfinite(float(match[1])):
        what = f"{shown(node.plain(), node.raw)} stands among the limits of a scan"
        raise _error(node.mark, name, what, "a number, or a number with a unit such as '50 um/ms'")
    return Number(float(match[1]), unit, dimension, is_whole=False)


def _in_unit(number: Number, of: Number) -> Number:
    if number.unit == of.unit:
        return number
    units = UNITS[of.dimension]
    amount = scaled(number.amount, units[number.unit]) / units[of.unit]
    return number._replace(amount=amount, unit=of.unit)


def _nodes(amounts: list[float], like: Number, mark: Mark, *, whole: bool) -> list[Node]:
    """The values as somebody would have written them: with the unit, without the dust of rounding."""
    nodes: list[Node] = []
    for amount in amounts:
        tidy = float(f"{amount:.12g}")
        if like.unit:
            text = f"{tidy:.12g} {like.unit}"
            nodes.append(Node(text, mark, raw=text))
        elif whole and tidy.is_integer():
            nodes.append(Node(int(tidy), mark, raw=str(int(tidy))))
        else:
            nodes.append(Node(tidy, mark, raw=repr(tidy)))
    return nodes


def _error(mark: Mark, name: str, what: str, expected: str, hint: str = "") -> ConfigError:
    return ConfigError(mark.problem(name, what, expected, hint))


MAX_RANGES: Final = 6
"""Most addresses of an adaptive scan: both ends of all of them are checked in every combination."""

_DIGITS: Final = 4  # of a range: finer than any setting of a machine is worth

End: TypeAlias = Annotated[Any, WithJsonSchema({"type": ["number", "string"]})]
"""A number or quantity; which one, the address decides."""
Points: TypeAlias = Annotated[int, Field(ge=1, le=MAX_POINTS)]


class EndsSettings(Settings):
    """The range of an address."""

    low: End = Field(alias="from", description="least value")
    high: End = Field(alias="to", description="greatest value")
    steps: Points | None = Field(
        default=None, description="number of equal steps between the values; without it any value will do"
    )


class AdaptiveChoice(Choice):
    """A scanner chosen by name; its settings stand beside the name."""

    over: dict[str, EndsSettings] = Field(
        min_length=1, max_length=MAX_RANGES, description="addresses and their ranges"
    )
    maximise: Text | None = Field(default=None, description="figure of the run's index to climb on")
    minimise: Text | None = Field(default=None, description="the same, where less is better")
    points: Points | None = Field(default=None, description="the most points")

    @model_validator(mode="after")
    def _has_one_aim(self) -> Self:
        if self.maximise is None and self.minimise is None:
            raise setting_error("the scan has no aim", "'maximise' or 'minimise' with the name of a figure")
        if self.maximise is not None and self.minimise is not None:
            raise setting_error(
                "'maximise' and 'minimise' stand together", "one of them", at=("minimise",), key=True
            )
        return self


SCANNER_KEYS: Final = frozenset({"over", "maximise", "minimise", "points"})
"""Keys that stand beside the settings of a scanner, and belong to the core."""


@dataclass(frozen=True, slots=True)
class Ends:
    """The range of an address as it is written.

    Attributes:
        low: The least value.
        high: The greatest value, in the unit of the least.
        n_steps: Number of equal steps; 0 where any value will do.
        mark: Where it stands.
    """

    low: Number
    high: Number
    n_steps: int
    mark: Mark

    @property
    def unit(self) -> str:
        """The unit that values are written in; "" for plain numbers."""
        return self.low.unit

    def si(self, number: Number) -> float:
        """One of the ends in SI."""
        return scaled(number.amount, factor_of(self.unit))

    def node(self, value: float) -> Node:
        """A value, SI, as somebody would have written it: where any value will do, with few digits."""
        if not isinstance(value, int) and not self.n_steps:
            low, high = self.low.amount, self.high.amount
            n_decimals = _DIGITS - math.floor(math.log10(high - low))
            amount = min(max(round(value / factor_of(self.unit), n_decimals), low), high)
            value = scaled(amount, factor_of(self.unit))
        text = written(value, self.unit)
        return Node(text if self.unit else value, self.mark, raw=text)


@dataclass(frozen=True, slots=True)
class Adaptive:
    """What chooses the points of a scan, and what for.

    Attributes:
        choice: The scanner's name and place.
        ends: The range of each axis.
        n_points: The most points.
        figure: What the scan climbs on.
        maximise: Whether more of it is better.
    """

    choice: Choice
    ends: tuple[Ends, ...]
    n_points: int
    figure: str
    maximise: bool

    @property
    def aim(self) -> Loc:
        """Where the figure is named."""
        return (*self.choice.loc, "maximise" if self.maximise else "minimise")


_SCANNABLE: Final = "an address in 'planner', 'shot.N.<step>', 'variables' or 'profile.<role or device>'"


def placed_axis(address: str, key: Mark, values: Sequence[Node], document: Document) -> Axis:
    """An axis that knows its place in the sequence; one of the profile is bound to it later.

    Args:
        address: The address.
        key: Where it stands.
        values: Its values.
        document: The sequence.

    Raises:
        ConfigError: The address leads nowhere, or to what a scan cannot change.
    """
    placed = _placed(key, document.name)
    axis = Axis(address, (), tuple(_placed_node(value, document.name) for value in values), placed)
    if not axis.of_profile:
        axis = replace(axis, loc=find_axis(document, axis, document.name))
        _check_place(axis, document)
    return axis


def _check_place(axis: Axis, document: Document) -> None:
    """Refuse what a run has only one of."""
    loc = axis.loc
    if loc[0] == "planner":
        return
    if loc[0] == VARIABLES:
        check_variable(axis, document, document.name)
        return
    if loc[0] == "shot" and len(loc) > 2 and loc[2] not in ("name", "policy") and document.root.at(loc[:3]):
        return
    raise unscannable(axis.address, axis.key, document.name)


def check_variable(axis: Axis, document: Document, name: str) -> None:
    """Refuse what is no variable of a file.

    Args:
        axis: The axis.
        document: The file.
        name: The sequence's name in messages.

    Raises:
        ConfigError: It is none.
    """
    if len(axis.loc) != 2 or document.root.at(axis.loc) is None:
        known = list(document.data.get(VARIABLES) or {})
        what = f"there is no variable '{clean(axis.address)}'"
        hint = did_you_mean(str(axis.loc[-1]), known)
        raise ConfigError(axis.key.problem(name, what, listing(known) if known else "'variables'", hint))


def unscannable(address: str, key: Mark, name: str) -> ConfigError:
    """Say that a scan cannot change what an address leads to."""
    return ConfigError(key.problem(name, f"a scan cannot change '{clean(address)}'", _SCANNABLE))


def find_axis(document: Document, axis: Axis, name: str) -> Loc:
    """Where an address leads; errors are placed at the scan's key."""
    try:
        return find(document.root, axis.address.removeprefix(PROFILE), document.name, "", MAY_ADD)
    except ConfigError as error:
        problems = [axis.key.problem(name, p.what, p.expected, p.hint) for p in error.problems]
        raise ConfigError(problems) from None


def is_free(axis: Axis, fixed: Sequence[Override], document: Document, notes: list[str]) -> bool:
    """Whether no option sets the value that the axis would change."""
    for override in fixed:
        other = _loc_of(override.address, document)
        own: Loc = tuple(axis.address.split(".")) if axis.of_profile else axis.loc
        if other and other == own[: len(other)]:
            notes.append(f"{override.source} replaces the scan of '{clean(axis.address)}'")
            return False
        if own and own == other[: len(own)]:
            what = f"the scan changes the whole of '{clean(axis.address)}'"
            raise ConfigError(Problem(what, override.source, expected=f"--set {clean(axis.address)}=..."))
    return True


def _loc_of(address: str, document: Document) -> Loc:
    if address.startswith(PROFILE):
        return tuple(address.split("."))
    try:
        return find(document.root, address, document.name, "")
    except ConfigError:  # told already, where it was applied
        return ()


def refuse_twice(axes: Sequence[Axis], name: str) -> None:
    """Refuse two addresses of which one holds the other."""
    for i, axis in enumerate(axes):
        for other in axes[:i]:
            n = min(len(axis.loc), len(other.loc))
            if n and axis.of_profile == other.of_profile and axis.loc[:n] == other.loc[:n]:
                own, others = clean(axis.address), clean(other.address)
                what = f"'{own}' is scanned, and so is '{others}', which holds the same value"
                raise ConfigError(axis.key.problem(name, what, "each value in one place of the scan"))


def _placed(mark: Mark, name: str) -> Mark:
    """A mark that keeps its file when its value goes into another one."""
    return mark if mark.origin else mark._replace(origin=name)


def _placed_node(node: Node, name: str) -> Node:
    value = node.value
    if isinstance(value, list):
        value = [_placed_node(child, name) for child in value]
    elif isinstance(value, dict):
        value = {key: _placed_node(child, name) for key, child in value.items()}
    keys = {key: _placed(mark, name) for key, mark in node.keys.items()}
    return replace(node, value=value, mark=_placed(node.mark, name), keys=keys)


def is_adaptive(node: Node) -> bool:
    """Whether the points of a scan are chosen while the run goes on: ``use`` names by what."""
    return isinstance(node.value, dict) and "use" in node.value


def read_adaptive(
    document: Document, repeats: int, fixed: Sequence[Override], found: ProblemCollector
) -> Scan:
    """Read an adaptive scan.

    Args:
        document: The sequence, overrides included.
        repeats: Shots of each point.
        fixed: The overrides; an axis that one of them sets is left out.
        found: Where the problems go.

    Returns:
        The scan; each axis has two values, the ends of its range.

    Raises:
        ConfigError: Everything that is wrong with its form.
    """
    choice = document.validate(AdaptiveChoice, ("scan",), called="an adaptive scan").placed("scan")
    if document.data.get("order") is not None:
        what = "'order' is given, but the points are chosen one after another"
        found.add(document.error(("order",), what, "no 'order' beside 'use'", key=True))
    notes: list[str] = []
    groups: list[Group] = []
    ends: list[Ends] = []
    n_points = 1
    for address, range_ in choice.over.items():
        with found:
            own = _ends(document, address, range_.steps or 0)
            axis = _axis(document, address)
            if is_free(axis, fixed, document, notes):
                groups.append((axis,))
                ends.append(own)
    with found:
        refuse_twice([axis for group in groups for axis in group], document.name)
    with found:
        n_points = choice.points or _points_of(document, repeats)
    found.raise_any()
    if not groups:
        raise document.error(("scan", "over"), "nothing is left to choose: options set every address")
    figure = choice.maximise or choice.minimise or ""
    adaptive = Adaptive(choice, tuple(ends), n_points, figure, choice.maximise is not None)
    return Scan(document.name, tuple(groups), repeats, "sequential", tuple(notes), adaptive)


def _ends(document: Document, address: str, n_steps: int) -> Ends:
    loc = ("scan", "over", address)
    nodes = [document.root.at((*loc, key)) for key in ("from", "to")]
    low, high = alike([node for node in nodes if node is not None], document.name)
    if not low.amount < high.amount:
        told = [shown(node.plain(), node.raw) for node in nodes if node is not None]
        what = f"'{clean(address)}' goes from {told[0]} to {told[1]}"
        raise document.error((*loc, "to"), what, "a greatest value above the least")
    mark = document.root.mark_at(loc)
    return Ends(low, high, n_steps, mark if mark.origin else mark._replace(origin=document.name))


def _axis(document: Document, address: str) -> Axis:
    over = document.root.at(("scan", "over"))
    assert over is not None
    values = [over.at((address, key)) for key in ("from", "to")]
    return placed_axis(
        address, over.keys[address], [value for value in values if value is not None], document
    )


def _points_of(document: Document, repeats: int) -> int:
    shots = document.data.get("shots")
    if type(shots) is int and shots >= 1:
        return math.ceil(shots / repeats)
    raise document.error(("scan",), "'points' is missing from 'scan' (the most points)", "a whole number")


_MEANT: Final = "a mapping of addresses and their values, or a list of such mappings"


def read_scan(document: Document, fixed: Sequence[Override] = ()) -> Scan | None:
    """Read ``scan``, ``repeats`` and ``order`` of a sequence.

    Args:
        document: The sequence, overrides included.
        fixed: The overrides, those of the profile with their "profile."; an axis that one of
            them sets is left out, since ``--set`` wins.

    Returns:
        The scan, its profile axes not yet bound; None if the sequence has none.

    Raises:
        ConfigError: Everything that is wrong with its form.
    """
    found = ProblemCollector()
    node = document.root.child("scan")
    repeats, order = _options(document, has_scan=node is not None and node.value is not None, found=found)
    if node is not None and is_adaptive(node):
        return read_adaptive(document, repeats, fixed, found)
    groups: list[Group] = []
    notes: list[str] = []
    if node is not None and node.value is not None:
        for items in _mappings(node, document.name, found):
            group = tuple(
                axis for axis in _axes(items, document, found) if is_free(axis, fixed, document, notes)
            )
            with found:
                _check_together(group, document.name)
            groups += [group] if group else []
    if not found.problems:
        with found:
            refuse_twice([axis for group in groups for axis in group], document.name)
    found.raise_any()
    if node is None or node.value is None:
        return None
    scan = Scan(document.name, tuple(groups), repeats, order, tuple(notes))
    if scan.n_points > MAX_POINTS:
        shape = " x ".join(map(str, scan.shape))
        what = f"the scan has {shape} = {scan.n_points} points"
        raise ConfigError(node.mark.problem(document.name, what, f"at most {MAX_POINTS}"))
    return scan


def bind_scan(scan: Scan, document: Document) -> Scan:
    """A copy whose profile axes know their places in the profile.

    Args:
        scan: The scan as it was read.
        document: The profile's file.

    Raises:
        ConfigError: Addresses that lead nowhere in it, or to what a scan cannot change.
    """
    found = ProblemCollector()

    def bound(axis: Axis) -> Axis:
        if not axis.of_profile:
            return axis
        with found:
            loc = find_axis(document, axis, scan.name)
            if loc[0] == VARIABLES:
                check_variable(replace(axis, loc=loc), document, scan.name)
            elif not (loc[0] in ROLES or (loc[0] == "devices" and len(loc) > 1)):
                raise unscannable(axis.address, axis.key, scan.name)
            return replace(axis, loc=loc)
        return axis

    groups = tuple(tuple(bound(axis) for axis in group) for group in scan.groups)
    found.raise_any()
    refuse_twice([axis for group in groups for axis in group if axis.of_profile], scan.name)
    return replace(scan, groups=groups)


def _options(document: Document, *, has_scan: bool, found: ProblemCollector) -> tuple[int, ScanOrder]:
    """``repeats`` and ``order``, which belong to a scan; 1 and "sequential" where they are wrong."""
    values: dict[str, Any] = {}
    for key in ("repeats", "order"):
        value = document.data.get(key)
        if value is None:
            continue
        if not has_scan:
            found.add(
                document.error((key,), f"'{key}' is given without a scan", "a 'scan' beside it", key=True)
            )
        values[key] = value
    repeats = values.get("repeats", 1)
    is_number = type(repeats) is int and repeats >= 1  # what else it is, the model of the file says
    shuffled = values.get("order") == "shuffled"
    return repeats if is_number else 1, "shuffled" if shuffled else "sequential"


def _mappings(node: Node, name: str, found: ProblemCollector) -> list[dict[str, tuple[Mark, Node]]]:
    """The groups as written: address -> its place and values."""
    items = node.value if isinstance(node.value, list) else [node]
    groups: list[dict[str, tuple[Mark, Node]]] = []
    if not items:
        found.add(ConfigError(node.mark.problem(name, "scan is empty", _MEANT)))
    for item in items:
        if not isinstance(item.value, dict) or not item.value:
            called = "scan" if item is node else "a group of the scan"
            came = "empty" if item.value == {} else shown(item.plain(), item.raw)
            found.add(ConfigError(item.mark.problem(name, f"{called} is {came}", _MEANT)))
            continue
        written = {address: (item.keys[address], values) for address, values in item.value.items()}
        # In a mapping each address is a group of its own; in a list each mapping is a group.
        groups += [{address: one} for address, one in written.items()] if item is node else [written]
    return groups


def _axes(
    written: Mapping[str, tuple[Mark, Node]], document: Document, found: ProblemCollector
) -> list[Axis]:
    axes: list[Axis] = []
    for address, (key, node) in written.items():
        with found:
            values = values_of(node, address, document.name)
            axes.append(placed_axis(address, key, values, document))
    return axes


def _check_together(group: Sequence[Axis], name: str) -> None:
    """Refuse a group whose axes differ in length, and one position that stands twice in it."""
    for axis in group[1:]:
        n, n_first = len(axis.values), len(group[0].values)
        if n != n_first:
            own, first = clean(axis.address), clean(group[0].address)
            own_values = "1 value" if n == 1 else f"{n} values"
            what = f"'{own}' has {own_values}, but '{first}' in its group has {n_first}"
            hint = "for every combination, make each a group of its own"
            raise ConfigError(axis.key.problem(name, what, "as many", hint))
    seen: set[str] = set()
    for i, node in enumerate(group[0].values if group else ()):
        position = json.dumps([axis.values[i].plain() for axis in group])
        if position in seen:
            what = f"{shown(node.plain(), node.raw)} stands twice in the scan of '{clean(group[0].address)}'"
            raise ConfigError(
                node.mark.problem(name, what, "each value once", "write 'repeats' for more shots")
            )
        seen.add(position)
