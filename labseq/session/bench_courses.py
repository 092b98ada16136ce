"""From a comparison in words to grids, targets and planners."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from labseq.config import Choice, ProblemCollector, Document, MotionSettings, Override
from labseq.config.fields import PatternChoice
from labseq.errors import ConfigError, LimitError, PlanError, Problem
from labseq.model import MotionSpec, SiteGrid, TargetPattern
from labseq.plugins import PluginHost
from labseq.roles import NeverStopped, Planner, NeedsWarmUp
from labseq.session.bench_spec import Comparison, Condition, PlannerEntry
from labseq.session.choosing import ChosenPlugin, dump, resolve
from labseq.session.constructing import construct, construct_target
from labseq.session.plan_inputs import parse_target
from labseq.session.setting_up import load_plugins

_DOP: Final = "degree_of_parallelism"
_MOTION_ADDRESS: Final = "profile.mobile_tweezers"


@dataclass(frozen=True, slots=True, eq=False)
class Runner:
    """A planner, ready to plan.

    Attributes:
        planner: The planner.
        name: Its name.
        settings: All its settings, JSON-ready.
        degree_of_parallelism: Most tweezers on at once that its plans are checked for.
    """

    planner: Planner
    name: str
    settings: Mapping[str, Any]
    degree_of_parallelism: int


@dataclass(frozen=True, slots=True, eq=False)
class PreparedCondition:
    """A condition, ready for planning.

    Attributes:
        grid: The grid of sites.
        motion: How the mobile tweezers move.
        target: What the array shall look like.
        loading: Probability that a site is loaded.
        runners: A planner per entrant.
    """

    grid: SiteGrid
    motion: MotionSpec
    target: TargetPattern
    loading: float
    runners: tuple[Runner, ...]


def set_up(comparison: Comparison) -> list[PreparedCondition]:
    """Read and validate a comparison, one course per condition.

    Raises:
        ConfigError: Something in it is wrong; says what was expected.
        PluginLoadError: A plugin that is named failed to load.
    """
    host = load_plugins()
    return [_course(host, comparison, condition) for condition in comparison.conditions]


def warm(courses: list[PreparedCondition]) -> None:
    """Compile all kernels that will be needed, or load them from the cache.

    Raises:
        PlanError: A planner failed in it; names the planner.
    """
    importlib.import_module("labseq.kernels.plan_check")
    for runner in [runner for course in courses for runner in course.runners]:
        if isinstance(runner.planner, NeedsWarmUp):
            try:
                runner.planner.warm()
            except Exception as error:
                raise PlanError(f"warm() raised {type(error).__name__}: {error}", runner.name) from error


def _course(host: PluginHost, comparison: Comparison, condition: Condition) -> PreparedCondition:
    found = ProblemCollector()
    grid, motion, target = SiteGrid(*condition.shape), _motion(condition), None
    with found:
        target = _target(host, condition, grid)
    runners: list[Runner] = []
    for planner_entry in comparison.planner_entries:
        with found:
            chosen = _planner(host, comparison, condition, planner_entry)
            runners.append(_runner(chosen, grid, motion, comparison.seed))
    found.raise_any()
    assert target is not None
    return PreparedCondition(grid, motion, target, condition.loading, tuple(runners))


def _motion(condition: Condition) -> MotionSpec:
    overrides = [
        Override(f"motion.{key}", value, f"--set {_MOTION_ADDRESS}.{key}={value}")
        for key, value in condition.motion
    ]
    document = _document(overrides, "motion")
    motion = document.validate(MotionSettings, ("motion",), called=_MOTION_ADDRESS).spec()
    n, limit = condition.degree_of_parallelism, motion.max_tweezers
    if n is not None and not 1 <= n <= limit:
        hint = f"or raise the limit: --set {_MOTION_ADDRESS}.max_tweezers={n}" if n > limit else ""
        what = f"the degree of parallelism is {n}"
        expected = f"1 to {limit}, the most tweezers that can be on at once"
        raise ConfigError(Problem(what, f"--dop {n}", expected=expected, hint=hint))
    tones = max(motion.max_row_tones, motion.max_column_tones)
    if n is not None and n > tones:
        expected = f"at most {tones}, the most tones of an axis"
        raise ConfigError(Problem(f"the degree of parallelism is {n}", f"--dop {n}", expected=expected))
    return motion


def _target(host: PluginHost, condition: Condition, grid: SiteGrid) -> TargetPattern:
    option = f"--target {condition.target}"
    name, settings = parse_target(condition.target)
    overrides = [Override(f"pattern.{key}", value, option) for key, value in settings.items()]
    try:
        return construct_target(_choose(host, PatternChoice(pattern=name), overrides, option), grid)
    except LimitError as error:
        raise ConfigError(Problem(str(error), option)) from error


def _planner(host: PluginHost, comparison: Comparison, condition: Condition, planner_entry: PlannerEntry) -> ChosenPlugin:
    name, dop = planner_entry.planner, condition.degree_of_parallelism
    overrides: list[Override] = []
    entry = host.registry.find("planner", name)
    if entry is not None and dop is not None and _DOP in getattr(entry.settings_model, "model_fields", {}):
        overrides.append(Override(f"planner.{_DOP}", str(dop), f"--dop {dop}"))
    for key, value in comparison.settings:
        overrides.append(Override(f"planner.{key}", value, f"--set planner.{key}={value}"))
    for key, value in planner_entry.settings:
        overrides.append(Override(f"planner.{key}", value, comparison.called))
    return _choose(host, Choice(use=name), overrides, comparison.called)


def _choose(host: PluginHost, choice: Choice, overrides: list[Override], option: str) -> ChosenPlugin:
    """Resolve a plugin that was named in an option."""
    kind = "pattern" if choice.key == "pattern" else "planner"
    named = Override(f"{kind}.{choice.key}", choice.use, option)
    return resolve(host, _document([named, *overrides], kind), kind, choice.placed(kind))


def _document(overrides: list[Override], top: str) -> Document:
    return Document.parse("{}", "the command line").override_all(overrides, may_add=(top,))


def _runner(chosen: ChosenPlugin, grid: SiteGrid, motion: MotionSpec, seed: int) -> Runner:
    planner: Planner = construct({"planner": chosen}, grid, motion, NeverStopped(), seed)[0]["planner"]
    dop = getattr(planner, _DOP, None)
    dop = dop if isinstance(dop, int) else motion.max_tweezers
    return Runner(planner, chosen.entry.name, dump(chosen.entry, chosen.settings), dop)
