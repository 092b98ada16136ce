"""What a sequence asks for: its target and its steps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

from labseq.config import ProblemCollector, Document, SequenceSpec, StepSpec
from labseq.config.analyses import ANALYSIS_KEYS
from labseq.config.settings import Settings
from labseq.errors import ConfigError, LabseqError, PluginLoadError, one_of
from labseq.model import TargetPattern
from labseq.roles import Context, Step
from labseq.session.choosing import ResolvedProfile, dump, named, resolve, validate
from labseq.session.constructing import construct_one, construct_role, construct_target

DEVICE_KEYS: Final = {"device": "name", "equalise": "device", "wait": "device"}
"""Steps that need a device of the profile -> the setting that names it; a wait need not name one."""


def make_target(
    bench: ResolvedProfile, document: Document, sequence: SequenceSpec
) -> tuple[TargetPattern, dict[str, Any]]:
    """The target of a sequence, and its settings for the record.

    Raises:
        ConfigError: The pattern is unknown, its settings are wrong, or it does not fit on the grid.
        PluginLoadError: The pattern's plugin is at fault; names it.
    """
    choice, grid = sequence.target, bench.grid
    chosen = resolve(bench.host, document, "pattern", choice)
    try:
        target = construct_target(chosen, grid)
    except PluginLoadError:
        raise
    except LabseqError as error:
        problem = document.problem(choice.loc, str(error))
        raise ConfigError(replace(problem, notes=(_grid_note(bench),))) from error
    return target, {"pattern": chosen.entry.name, **dump(chosen.entry, chosen.settings)}


def make_steps(
    bench: ResolvedProfile, document: Document, sequence: SequenceSpec, found: ProblemCollector
) -> tuple[list[tuple[str, Step]], list[dict[str, Any]]]:
    """Name and step, in order, and the settings of each for the record.

    Args:
        bench: The profile.
        document: The sequence's file.
        sequence: What it says.
        found: Where the problems go.
    """
    steps: list[tuple[str, Step]] = []
    dumps: list[dict[str, Any]] = []
    image_seen = False
    for spec in sequence.shot:
        step: Step | None = None
        with found:
            step, dumped = make_step(bench, document, spec)
            steps.append((spec.name or spec.kind, step))
            dumps.append({spec.kind: dumped, **({"name": spec.name} if spec.name else {})})
            if step.needs_image and not image_seen:
                what = f"'{spec.kind}' needs an image before it in the shot"
                raise document.error(spec.loc, what, "an 'image' step before it", key=True)
        # Whether a step that is wrong would take an image, nobody knows.
        image_seen = image_seen or step is None or step.takes_image
    return steps, dumps


def make_step(bench: ResolvedProfile, document: Document, spec: StepSpec) -> tuple[Step, dict[str, Any]]:
    """A step of a sequence, and its settings for the record.

    Raises:
        ConfigError: The step is unknown, or its settings are wrong; with their place.
    """
    entry = named(bench.host, document, "step", spec.kind, spec.loc, key=True)
    settings = validate(document, entry, spec.loc)
    if spec.kind in DEVICE_KEYS:
        _check_device_name(bench, document, settings, spec)
    try:
        return construct_role(entry, settings), dump(entry, settings)
    except (ConfigError, PluginLoadError) as error:
        raise document.error(spec.loc, str(error)) from error


def make_analyses(
    bench: ResolvedProfile, document: Document, sequence: SequenceSpec, found: ProblemCollector
) -> list[dict[str, Any]]:
    """What is worked out from each shot: the settings of each analysis for the record.

    Each is constructed once, to see whether it can be: those of the run live in processes of their own.

    Args:
        bench: The profile.
        document: The sequence's file.
        sequence: What it says.
        found: Where the problems go.
    """
    dumps: list[dict[str, Any]] = []
    for choice in sequence.analysis:
        with found:
            chosen = resolve(bench.host, document, "analysis", choice, ANALYSIS_KEYS)
            context = Context(choice.use, bench.grid, bench.profile.motion, calibrations=bench.calibrations)
            construct_one(chosen, context)
            dumps.append({**chosen.dump(), "finish_within": choice.finish_within})
    return dumps


def _check_device_name(bench: ResolvedProfile, document: Document, settings: Settings | None, spec: StepSpec) -> None:
    key = DEVICE_KEYS[spec.kind]
    name = getattr(settings, key, None)
    if name is not None and name not in bench.profile.devices:
        what = f"the profile '{bench.profile.name}' has no device '{name}'"
        problem = document.problem((*spec.loc, key), what, one_of(sorted(bench.profile.devices)))
        raise ConfigError(replace(problem, notes=(_place(bench.document, "devices"),)))


def _grid_note(bench: ResolvedProfile) -> str:
    grid = bench.grid
    return f"the grid has {grid.n_rows} x {grid.n_cols} sites: {_place(bench.document, 'grid')}"


def _place(document: Document, key: str) -> str:
    line, column = document.locate((key,), key=True)
    return f"see '{key}' at {document.path}:{line}:{column}"
