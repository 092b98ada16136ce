"""The settings of a run at each point of its scan, validated like the files themselves.

A scan has many points but few different settings, so each different content of a plugin's settings is
validated once. Devices are constructed later, when the run opens or by ``labseq check``. Between two points
only devices whose settings differ are constructed again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

from labseq.assembly.lab import construct, parallelism_of
from labseq.assembly.plugin_choice import Configured, make_step, resolve
from labseq.assembly.point import Point
from labseq.assembly.profile import ResolvedProfile, choose
from labseq.config.addresses import PROFILE, PROFILE_ROLES, VARIABLES
from labseq.config.profile import MobileTweezersChoice
from labseq.config.scan import Axis, Scan, put
from labseq.errors import ConfigError, Loc, ProblemCollector
from labseq.messages import clean
from labseq.model import MotionSpec, RandomStream
from labseq.settings import Choice
from labseq.units import parse_any

if TYPE_CHECKING:
    from labseq.config.document import Document
    from labseq.config.sequence import SequenceSpec
    from labseq.config.yaml_nodes import Node
    from labseq.sequencer.lab import Lab

MAX_PROBLEMS: Final = 20
"""The check of a scan stops after this number of problems."""
_PLANNER: Final[Loc] = ("planner",)

T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class ScanPoints:
    """The points of a run.

    Attributes:
        scan: The scan, its axes bound to the profile.
        document: The sequence's file.
        sequence: Its content.
        hardware: The profile.
    """

    scan: Scan
    document: Document
    sequence: SequenceSpec
    hardware: ResolvedProfile
    _known: dict[Any, Any] = field(default_factory=dict[Any, Any], repr=False)

    def check(self, problems: ProblemCollector) -> None:
        """Validate the settings at every point, or for an adaptive scan at the corners of its ranges.

        Args:
            problems: Receives the problems. After :data:`MAX_PROBLEMS` no further point is tried.
        """
        try:
            self._check_dependents()
        except ConfigError as error:
            problems.add(error)
            return
        # the errors that are already known would occur again at each point
        known = set(self.scan.explained(ConfigError(problems.problems)).problems)
        n_before = len(problems.problems)
        # for an adaptive scan, the points are the corners of its ranges
        for number in range(math.prod(self.scan.shape)):
            try:
                self.at(number)
            except ConfigError as error:
                new = [one for one in self.scan.explained(error).problems if one not in known]
                known.update(new)
                problems.problems += new
            if len(problems.problems) >= n_before + MAX_PROBLEMS:
                return

    def at(self, number: int) -> Point:
        """The settings of a point, by its number, or of a corner of the ranges of an adaptive scan.

        Raises:
            ConfigError: All values that plugins refuse.
        """
        return self._once(number, lambda: self.with_values([*self.scan.values(number)]))

    def with_values(self, values: Sequence[tuple[Axis, Node]]) -> Point:
        """The settings with a value for each axis.

        Raises:
            ConfigError: All values that plugins refuse.
        """
        problems, hardware, plugins = ProblemCollector(), self.hardware, dict[Loc, Configured[Any]]()
        document = put(values, self.document, profile=False)
        with problems:
            hardware = self._profile_with(values)
        with problems:
            plugins = self._planner_and_steps(document)
        problems.raise_any()
        parameters: dict[str, Any] = {}
        for axis, node in values:
            value = _setting(plugins, hardware, axis.of_profile, axis.loc)
            if axis.loc[0] == VARIABLES:
                value = _si(node.plain())
            elif value is None or isinstance(node.value, dict):
                value = node.plain()  # a mapping as it is written
            parameters[axis.address] = value
        for axis, _ in values:
            for loc in self._dependents(axis):
                address = _address(axis.of_profile, loc)
                parameters[address] = _setting(plugins, hardware, axis.of_profile, loc)
        steps = tuple((spec.name or spec.kind, plugins[spec.loc].plugin) for spec in self.sequence.shot)
        return Point(plugins[_PLANNER].plugin, steps, hardware, parameters, document)

    def record(self, point_of_shot: Sequence[int]) -> dict[str, Any]:
        """The scan for the run's record, JSON-ready.

        ``addresses`` are the scanned addresses, ``points`` the values of each point in SI, ``written`` the
        same in the units of the sequence, and ``point_of_shot`` the point of each shot, counted from 0.
        """
        numbers, addresses = range(self.scan.n_points), [axis.address for axis in self.scan.axes]
        at = [self.at(number).parameters for number in numbers]
        return {
            "addresses": addresses,
            "points": [[parameters[address] for address in addresses] for parameters in at],
            "written": [[str(node.raw or node.plain()) for _, node in self.scan.values(n)] for n in numbers],
            "repeats": self.scan.repeats,
            "order": self.scan.order,
            "point_of_shot": point_of_shot,
        }

    def present(self, axis: Axis) -> Any:
        """The value of an axis in the files, SI. None if it is missing."""
        if axis.loc[0] == VARIABLES:
            return _si((self.hardware.document if axis.of_profile else self.document).get(axis.loc))
        return _setting(self._planner_and_steps(self.document), self.hardware, axis.of_profile, axis.loc)

    def _planner_and_steps(self, document: Document) -> dict[Loc, Configured[Any]]:
        """Planner and steps by the place of their settings.

        Raises:
            ConfigError: All values that they refuse.
        """
        problems, plugins = ProblemCollector(), dict[Loc, Configured[Any]]()
        for loc in (_PLANNER, *(spec.loc for spec in self.sequence.shot)):
            with problems:
                key = loc, json.dumps(document.get(loc))  # as text, because mappings cannot be keys
                plugins[loc] = self._once(key, partial(self._make, document, loc))
        problems.raise_any()
        return plugins

    def _profile_with(self, values: Sequence[tuple[Axis, Node]]) -> ResolvedProfile:
        """The profile with the values of a point. Points with the same values share one object."""
        own = [node.plain() for axis, node in values if axis.of_profile]
        if not own:
            return self.hardware

        def change() -> ResolvedProfile:
            return _changed(self.hardware, put(values, self.hardware.document, profile=True))

        return self._once(json.dumps(own), change)

    def _make(self, document: Document, loc: Loc) -> Configured[Any]:
        if loc == _PLANNER:
            choice = document.validate(Choice, loc).placed(*loc)
            chosen = resolve(self.hardware.host, document, "planner", choice)
            return Configured(chosen, chosen.dump())
        return make_step(self.hardware, document, self.sequence.shot[int(loc[1])])

    def _once(self, key: object, make: Callable[[], T]) -> T:
        """The result of a function, or the error that it raises. It is called once for each key."""
        if key not in self._known:
            try:
                self._known[key] = make()
            except ConfigError as error:  # kept too, as many points may share a wrong value
                self._known[key] = error
        if isinstance(self._known[key], ConfigError):
            raise self._known[key]
        return self._known[key]

    def _dependents(self, axis: Axis) -> list[Loc]:
        """The settings with an expression that depends on an axis."""
        expressions = (self.hardware.document if axis.of_profile else self.document).expressions
        locs = [] if expressions is None else expressions.following(axis.loc)
        return [loc for loc in locs if loc[0] != VARIABLES]

    def _may_change(self, of_profile: bool, loc: Loc) -> bool:
        """Whether a setting may differ between points."""
        if of_profile:
            return loc[0] in PROFILE_ROLES or (loc[0] == "devices" and len(loc) > 2)
        return loc[0] == "planner" or (loc[0] == "shot" and len(loc) > 3)

    def _check_dependents(self) -> None:
        """Raise for an axis that changes no setting, or that changes a setting which a scan cannot change."""
        for axis in self.scan.axes:
            dependents, own = self._dependents(axis), clean(axis.address)
            if axis.loc[0] == VARIABLES and not dependents:
                hint = f"write '= {own.removeprefix(PROFILE)}' in a setting"
                what = f"no setting uses '{own}'"
                raise axis.key.error(what, "an expression with it", hint)
            for loc in dependents:
                if not self._may_change(axis.of_profile, loc):
                    other = clean(_address(axis.of_profile, loc))
                    what = f"a scan cannot change '{other}', which depends on '{own}'"
                    raise axis.key.error(what, "one value for the whole run")


def _changed(hardware: ResolvedProfile, document: Document) -> ResolvedProfile:
    """A profile with other settings of its plugins, but the same drivers, grid and calibrations.

    Args:
        document: The profile's file with the other settings.

    Raises:
        ConfigError: All errors in the settings.
    """
    problems, chosen, profile = ProblemCollector(), dict(hardware.chosen), hardware.profile
    for role, choice in {**profile.choices, **profile.devices}.items():
        loc = choice.loc
        if document.get(loc) == hardware.document.get(loc):
            continue
        with problems:
            new_choice = document.validate(type(choice), loc).placed(*loc)
            is_hardware = role in hardware.drivers
            if is_hardware and new_choice.use != choice.use:
                what = f"a scan cannot change the driver of {role}"
                raise document.error((*loc, "use"), what, "one driver for the whole run")
            plugin, _ = choose(hardware.host, document, profile, role, new_choice, hardware.dry_run)
            if is_hardware and plugin.virtual_time != chosen[role].virtual_time:
                what = f"the scan would change whether {role} is simulated"
                raise document.error(loc, what, "all points simulated, or none")
            chosen[role] = plugin
            if isinstance(new_choice, MobileTweezersChoice):
                profile = profile.model_copy(update={"mobile_tweezers": new_choice})
    problems.raise_any()
    return replace(hardware, document=document, profile=profile, chosen=chosen)


def _address(of_profile: bool, loc: Loc) -> str:
    return (PROFILE if of_profile else "") + ".".join(map(str, loc))


def _setting(
    plugins: Mapping[Loc, Configured[Any]], hardware: ResolvedProfile, of_profile: bool, loc: Loc
) -> Any:
    """The value at a location after the plugin's validation, SI, or None if it is missing."""
    if loc[0] == VARIABLES:
        return None
    n = 2 if loc[0] == "devices" else 3 if loc[0] == "shot" else 1
    value: Any = hardware.dump(str(loc[n - 1])) if of_profile else plugins[loc[:n]].dump
    for step in loc[n:]:
        try:
            value = value[step]
        except (KeyError, IndexError, TypeError):
            return None
    return value


def _si(value: Any) -> Any:
    """The value of a variable in SI."""
    return parse_any(value)[0] if isinstance(value, str) else value


DRIVERS_MOTION: Final = frozenset({"rf", "max_row_tones", "max_column_tones", "eject_slots"})
"""Keys of the motion that mobile tweezers need when they are opened. Only the core uses the others."""


def rebuild_lab(lab: Lab, before: Point, after: Point, seed: int) -> tuple[Lab, frozenset[str]]:
    """Construct the objects whose settings differ between two points. All others stay open.

    A device whose settings change must be closed first and reopened afterwards. The mobile tweezers stay open
    if only the contents of their programs differ. A simulated lab stays open only if none of its devices and
    nothing in the motion differs, because its devices refer to the simulation, which refers to the motion.

    Args:
        lab: The lab at the previous point.
        before: The point that the lab is at.
        after: The next point.

    Returns:
        The lab, and the names of the devices that must be reopened, including "simulation".
    """
    reopened = _reopened(lab, before.hardware, after.hardware)
    motion = after.hardware.motion
    names = {*reopened, "planner"}
    if _differs(before.hardware, after.hardware, "detector"):
        names.add("detector")
    chosen = {**after.hardware.chosen, "planner": after.planner}
    objects, streams = construct(
        {name: chosen[name] for name in chosen if name in names},
        replace(after.hardware.context(lab.clock), simulation=lab.simulation),
        seed,
        truth=(after.hardware.profile.grid_model(), after.hardware.profile.motion),
    )
    roles = ("camera", "static_tweezers", "mobile_tweezers", "detector", "planner", "lines", "simulation")
    return replace(
        lab,
        **{role: objects[role] for role in roles if role in objects},
        devices={name: objects.get(name, device) for name, device in lab.devices.items()},
        motion=motion,
        target=after.target or lab.target,
        planner_name=after.planner.entry.name,
        degree_of_parallelism=parallelism_of(after.planner, objects["planner"], motion),
        random_streams=_streams(lab.random_streams, streams),
    ), reopened


def _reopened(lab: Lab, before: ResolvedProfile, after: ResolvedProfile) -> frozenset[str]:
    names = {name for name, _ in lab.hardware()} | ({"simulation"} if lab.simulation is not None else set())
    changed = {name for name in names if _differs(before, after, name)}
    old, new = before.profile.motion, after.profile.motion
    moved = {
        field.name for field in fields(MotionSpec) if getattr(old, field.name) != getattr(new, field.name)
    }
    if lab.simulation is not None:
        return frozenset(names if changed or moved else ())
    if moved & DRIVERS_MOTION:
        changed.add("mobile_tweezers")
    return frozenset(changed)


def _differs(before: ResolvedProfile, after: ResolvedProfile, name: str) -> bool:
    old, new = before.chosen[name], after.chosen[name]
    return (old.entry, old.settings) != (new.entry, new.settings)


def _streams(old: tuple[RandomStream, ...], new: tuple[RandomStream, ...]) -> tuple[RandomStream, ...]:
    """Random streams of a lab, from its new objects and from objects that stay."""
    names = {stream.name for stream in new}
    return (*(stream for stream in old if stream.name not in names), *new)
