"""What a plan is made from, read from the words of the command line."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from labseq.config import (
    MOTION_KEYS,
    Choice,
    Document,
    MotionSettings,
    Override,
    load_profile,
    load_sequence,
    plugin_paths,
    validate_values,
)
from labseq.config.fields import PatternChoice
from labseq.config.profile import GridSettings
from labseq.config.reading import YAML_SUFFIXES
from labseq.config.sequence import DEFAULT_PLANNER
from labseq.config.wording import clean, visible
from labseq.errors import ConfigError, Problem
from labseq.model import MotionSpec, SiteGrid, TargetPattern
from labseq.plugins import PluginHost
from labseq.session.assembly import load_plugins
from labseq.session.choosing import Chosen, make_target, resolve
from labseq.session.occupancies import Source

_TARGET: Final = re.compile(r"([^\W\d][\w-]*)(?::(.*))?", re.DOTALL)
_SIZE: Final = re.compile(r"\s*(\d{1,6})\s*[xX]\s*(\d{1,6})\s*")
_ORIGIN: Final = re.compile(r"\s*(-?\d{1,6})\s*,\s*(-?\d{1,6})\s*")
_NEXT_SETTING: Final = re.compile(r",(?=\s*[^\W\d]\w*\s*=)")
_TARGET_FORMS: Final = (
    "a pattern such as kagome:15x15 or ring:radius=4, or a sequence file, whose target is taken"
)


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """What is to be planned, in the words of the command line.

    Attributes:
        occupancy: See :func:`labseq.session.occupancies.read_source`.
        target: "kagome:15x15", "kagome:rows=15,cols=15" or a sequence file; None
            for the target that a shot was taken with.
        planner: Its name.
        degree_of_parallelism: The planner's setting of that name; None for its default.
        overrides: Further settings of the planner, ``"key=value"`` each.
        seed: Seed of a drawn occupancy; None for a fresh one.
        origin: "R,C", the top left site of the target; None for the pattern's own.
        profile: Name or path of a profile for grid, motion and plugin folders.
    """

    occupancy: str
    target: str | None = None
    planner: str = DEFAULT_PLANNER
    degree_of_parallelism: int | None = None
    overrides: Sequence[str] = ()
    seed: int | None = None
    origin: str | None = None
    profile: str | None = None


@dataclass(frozen=True, slots=True)
class Machine:
    """What a plan has to fit: the sites, and how atoms move between them."""

    grid: SiteGrid
    motion: MotionSpec


@dataclass(frozen=True, slots=True)
class PlanInputs:
    """What a plan is made from, the occupancy aside."""

    machine: Machine
    target: TargetPattern
    planner: Chosen


def read_inputs(request: PlanRequest, source: Source) -> PlanInputs:
    """Read and validate all that a request names.

    Args:
        request: The request.
        source: Its occupancy.

    Raises:
        ConfigError: Something is wrong; says what was expected.
        PluginLoadError: A plugin that is named failed to load.
    """
    folders: list[Path] = []
    machine = _machine(request, source, folders)
    document = Document.parse("{}", "the command line").override_all(
        [*_planner_settings(request), *_target_settings(request)], may_add=("planner", "target")
    )
    choice = PatternChoice(pattern=document.get(("target", "pattern"), "-")).placed("target")
    if _is_sequence(request.target):
        assert request.target is not None
        target_document, sequence = load_sequence(Path(request.target), _origin(request))
        folders += plugin_paths(target_document, sequence.plugin_folders)
        choice = sequence.target
    else:
        target_document = document
    host = load_plugins(folders)
    planner = resolve(host, document, "planner", Choice(use=request.planner).placed("planner"))
    if request.target is not None:
        target, _ = make_target(host, target_document, choice, machine.grid)
    else:
        target = _targets_own(request, source)
    return PlanInputs(machine, target, planner)


def _targets_own(request: PlanRequest, source: Source) -> TargetPattern:
    """The target that a shot was taken with."""
    if source.target is None:
        raise ConfigError(Problem("--target is missing", expected=_TARGET_FORMS))
    if request.origin is not None:
        problem = Problem("there is no target to move", f"--origin {clean(request.origin)}")
        raise ConfigError(problem)
    return source.target
