"""A scan: what each point changes, checked and put together before anything is opened; running it point by point.

The points of a scan are many, what they are made of is little: a *part* is the settings
of one plugin (the planner, a step, a role or device of the profile). A part is validated for
every combination of the values that go into it, and for no others: what goes into different
parts cannot contradict each other in a file. Not checked here, but before the run opens
anything (and by ``labseq check``): whether the constructors accept their settings.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from labseq.config import ROLES, Axis, Document, ProblemCollector, Scan, SequenceSpec
from labseq.config.fields import VARIABLES
from labseq.config.profile import MobileTweezersChoice
from labseq.config.scan import PROFILE
from labseq.config.yaml_nodes import Node
from labseq.errors import ConfigError, Loc
from labseq.messages import clean
from labseq.roles import Step
from labseq.session.construct import make_step
from labseq.session.profile import HARDWARE_KINDS, ChosenPlugin, DryRun, ResolvedProfile, choose, resolve
from labseq.settings import Choice
from labseq.units import parse_any

MAX_PROBLEMS: Final = 20
"""Wrong values after which no more are looked for."""

Part = tuple[bool, Loc]
"""Whether it is the profile's, and where its settings are."""


@dataclass(frozen=True, slots=True)
class PartSettings:
    """A part with the settings of some of the points.

    Attributes:
        chosen: The plugin; None for a step.
        step: The step; None for everything else.
        choice: What the profile says of a role.
        dump: The settings after defaults, SI, JSON-ready.
    """

    chosen: ChosenPlugin | None
    step: Step | None
    choice: Choice | None
    dump: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Point:
    """A run's settings at one point.

    Attributes:
        planner: What plans the moves.
        steps: Name and step, in order.
        bench: The profile.
        parameters: Scanned address -> value, SI, JSON-ready.
    """

    planner: ChosenPlugin
    steps: tuple[tuple[str, Step], ...]
    bench: ResolvedProfile
    parameters: Mapping[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class Scanned:
    """The points of a run.

    Attributes:
        scan: The scan, its axes bound to the profile.
        document: The sequence's file.
        sequence: What it says.
        bench: The profile.
        dry_run: "off", "full" or "fast".
    """

    scan: Scan
    document: Document
    sequence: SequenceSpec
    bench: ResolvedProfile
    dry_run: DryRun
    _made: dict[tuple[Part, tuple[int, ...]], PartSettings] = field(
        default_factory=dict[Any, PartSettings], repr=False
    )
    _benches: dict[tuple[int, ...], ResolvedProfile] = field(
        default_factory=dict[Any, ResolvedProfile], repr=False
    )

    def check(self, found: ProblemCollector) -> None:
        """Validate every part with every combination of the values that go into it.

        Args:
            found: Where the problems go, those of the first :data:`MAX_PROBLEMS` wrong values.
        """
        try:
            self._check_following()
        except ConfigError as error:
            found.add(error)
            return
        known, n_wrong = {*self.scan.explained(ConfigError(found.problems)).problems}, 0
        for part in self._parts():
            for point in self._points_of(part):
                try:
                    self._part(part, point)
                except ConfigError as error:
                    new = [problem for problem in self.scan.explained(error).problems if problem not in known]
                    known.update(new)
                    n_wrong += bool(new)
                    if new:
                        found.add(ConfigError(new))
                if n_wrong == MAX_PROBLEMS:
                    return

    def at(self, point: int, planner: ChosenPlugin, steps: tuple[tuple[str, Step], ...]) -> Point:
        """The settings of a point.

        Args:
            point: Its index.
            planner: The planner where the scan does not change it.
            steps: The steps where it does not change them.
        """
        parts = {part: self._part(part, point) for part in self._parts()}
        changed = list(steps)
        for (of_profile, loc), made in parts.items():
            if not of_profile and loc == ("planner",):
                assert made.chosen is not None
                planner = made.chosen
            elif not of_profile:
                assert made.step is not None
                number = int(loc[1])
                changed[number] = (steps[number][0], made.step)
        parameters = {axis.address: _resolved(axis, node, parts) for axis, node in self.scan.values(point)}
        for axis in self.scan.axes:
            for loc in self._following(axis):
                part = _part_of(axis.of_profile, loc)
                parameters[_address(axis.of_profile, loc)] = _value_in(parts[part], part, loc)
        return Point(planner, tuple(changed), self._bench_at(point, parts), parameters)

    def of(self, scan: Scan) -> Scanned:
        """The same with other points."""
        return Scanned(scan, self.document, self.sequence, self.bench, self.dry_run)

    def present(self, axis: Axis) -> Any:
        """What the files have in the place of an axis, SI; None if that is nothing, or wrong."""
        base, alone = self.bench.document if axis.of_profile else self.document, replace(self.scan, groups=())
        if axis.loc[0] == VARIABLES:
            return _si(base.get(axis.loc))
        part = _part_of(axis.of_profile, axis.loc)
        try:
            return _value_in(self.of(alone)._make(part, 0), part, axis.loc)
        except ConfigError:
            return None

    def _bench_at(self, point: int, parts: Mapping[Part, PartSettings]) -> ResolvedProfile:
        """The profile at a point; the same object wherever it is the same."""
        positions = self.scan.positions(point)
        touched = {g for (of_profile, loc) in parts if of_profile for g in self._groups_of((True, loc))}
        if not touched:
            return self.bench
        key = tuple(positions[g] for g in sorted(touched))
        if key not in self._benches:
            chosen, profile = dict(self.bench.chosen), self.bench.profile
            for (of_profile, loc), made in parts.items():
                if of_profile:
                    assert made.chosen is not None
                    chosen[str(loc[-1])] = made.chosen
                    if isinstance(made.choice, MobileTweezersChoice):
                        profile = profile.model_copy(update={"mobile_tweezers": made.choice})
            self._benches[key] = replace(self.bench, profile=profile, chosen=chosen)
        return self._benches[key]

    def _parts(self) -> list[Part]:
        return list(dict.fromkeys(part for axis in self.scan.axes for part in self._parts_of(axis)))

    def _parts_of(self, axis: Axis) -> list[Part]:
        """What a value goes into: its own part, and those with an expression that follows from it."""
        own = [] if axis.loc[0] == VARIABLES else [_part_of(axis.of_profile, axis.loc)]
        following = (_part_of(axis.of_profile, loc) for loc in self._following(axis))
        return list(dict.fromkeys([*own, *following]))

    def _following(self, axis: Axis) -> list[Loc]:
        """The settings whose values follow from that of an axis."""
        expressions = (self.bench.document if axis.of_profile else self.document).expressions
        found = [] if expressions is None else expressions.following(axis.loc)
        return [loc for loc in found if loc[0] != VARIABLES]

    def _check_following(self) -> None:
        """Refuse an axis from which nothing follows, or something of which a run has only one."""
        for axis in self.scan.axes:
            following, own, name = self._following(axis), clean(axis.address), self.scan.name
            if axis.loc[0] == VARIABLES and not following:
                hint = f"write '= {own.removeprefix(PROFILE)}' where it shall count"
                what = f"nothing follows from '{own}'"
                raise ConfigError(axis.key.problem(name, what, "an expression with it", hint))
            for loc in following:
                if not _is_part(axis.of_profile, loc):
                    other = clean(_address(axis.of_profile, loc))
                    what = f"'{other}' follows from '{own}', and a scan cannot change it"
                    raise ConfigError(axis.key.problem(name, what, "one value of it for the whole run"))

    def _groups_of(self, part: Part) -> list[int]:
        """The groups whose values go into a part."""
        return [
            g
            for g, group in enumerate(self.scan.groups)
            if any(part in self._parts_of(axis) for axis in group)
        ]

    def _points_of(self, part: Part) -> Iterator[int]:
        """A point for each combination of what goes into a part; all else as at the first point."""
        shape, groups = self.scan.shape, self._groups_of(part)
        for positions in itertools.product(*(range(shape[g]) for g in groups)):
            whole = [0] * len(shape)
            for g, position in zip(groups, positions, strict=True):
                whole[g] = position
            yield int(np.ravel_multi_index(whole, shape))

    def _part(self, part: Part, point: int) -> PartSettings:
        positions = self.scan.positions(point)
        key = (part, tuple(positions[g] for g in self._groups_of(part)))
        if key not in self._made:
            self._made[key] = self._make(part, point)
        return self._made[key]

    def _make(self, part: Part, point: int) -> PartSettings:
        of_profile, loc = part
        base = self.bench.document if of_profile else self.document
        document = self.scan.put(base, point, profile=of_profile)
        if of_profile:
            return self._make_role(document, loc)
        if loc == ("planner",):
            choice = document.validate(Choice, loc).placed("planner")
            chosen = resolve(self.bench.host, document, "planner", choice)
            return PartSettings(chosen, None, choice, chosen.dump())
        step, dumped = make_step(self.bench, document, self.sequence.shot[int(loc[1])])
        return PartSettings(None, step, None, dumped)

    def _make_role(self, document: Document, loc: Loc) -> PartSettings:
        role = str(loc[-1])
        kind = role if loc[0] in ROLES else "device"
        model = MobileTweezersChoice if role == "mobile_tweezers" else Choice
        choice = document.validate(model, loc).placed(*map(str, loc))
        if kind in HARDWARE_KINDS and choice.use != self.bench.document.get((*loc, "use")):
            what = f"a scan cannot change the driver of {role}"
            raise document.error((*loc, "use"), what, "one driver for the whole run")
        chosen, _ = choose(self.bench.host, document, kind, choice, self.dry_run)
        if kind in HARDWARE_KINDS and chosen.virtual_time != self.bench.chosen[role].virtual_time:
            what = f"the scan would change whether {role} is simulated"
            raise document.error(loc, what, "all points simulated, or none")
        dumped = chosen.dump()
        if isinstance(choice, MobileTweezersChoice):
            dumped |= choice.model_dump(mode="json", exclude={"use"})
        return PartSettings(chosen, None, choice, dumped)


def _part_of(of_profile: bool, loc: Loc) -> Part:
    if not of_profile:
        return False, loc[:1] if loc[0] == "planner" else loc[:3]
    return True, loc[:2] if loc[0] == "devices" else loc[:1]


def _is_part(of_profile: bool, loc: Loc) -> bool:
    """Whether a scan may change a setting."""
    if of_profile:
        return loc[0] in ROLES or (loc[0] == "devices" and len(loc) > 2)
    return loc[0] == "planner" or (loc[0] == "shot" and len(loc) > 3)


def _address(of_profile: bool, loc: Loc) -> str:
    return ".".join([*((PROFILE.rstrip("."),) if of_profile else ()), *map(str, loc)])


def _resolved(axis: Axis, node: Node, parts: Mapping[Part, PartSettings]) -> Any:
    """A scanned value as the plugin understood it, in SI; a mapping as it is written."""
    if axis.loc[0] == VARIABLES:
        return _si(node.plain())
    part = _part_of(axis.of_profile, axis.loc)
    value = _value_in(parts[part], part, axis.loc)
    return node.plain() if value is None or isinstance(node.value, dict) else value


def _value_in(made: PartSettings, part: Part, loc: Loc) -> Any:
    """A value among the settings of its part; None if there is none."""
    value: Any = made.dump
    for step in loc[len(part[1]) :]:
        if isinstance(value, list):
            value = value[step] if isinstance(step, int) and step < len(value) else None  # pyright: ignore[reportUnknownVariableType]
        else:
            value = value.get(step) if isinstance(value, dict) else None
    return value


def _si(value: Any) -> Any:
    """A variable in SI."""
    return parse_any(value)[0] if isinstance(value, str) else value
