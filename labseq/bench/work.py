"""The work of a comparison, which plans for random loadings, checks the plans and counts."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.assembly.lab import choice_of
from labseq.assembly.planning import TargetChoice, construct_planner, read_target
from labseq.assembly.plugin_choice import ChosenPlugin, dump, load_plugins, resolve
from labseq.bench.comparison import Comparison, Condition, PlannerEntry
from labseq.config.addresses import Override
from labseq.config.document import Document
from labseq.errors import ConfigError, PlanError, Problem, ProblemCollector
from labseq.kernels.kernel import load_kernels
from labseq.messages import format_plugin_error
from labseq.model import MotionSpec, Occupancy, SiteGrid, TargetPattern
from labseq.motion import check_plan, predict_survival
from labseq.plugins.host import PluginHost
from labseq.roles import Context, NeedsWarmUp, Planner
from labseq.settings import Choice, settings_at

_MOTION_ADDRESS: Final = "profile.mobile_tweezers"


@dataclass(frozen=True, slots=True, eq=False)
class Runner:
    """A constructed planner, with all its settings, JSON-ready.

    Attributes:
        degree_of_parallelism: Maximum number of tweezers on at once, for the check of its plans.
    """

    planner: Planner
    name: str
    settings: Mapping[str, Any]
    degree_of_parallelism: int


@dataclass(frozen=True, slots=True, eq=False)
class PreparedCondition:
    """A condition, ready for planning, with one runner for each planner of the comparison."""

    grid: SiteGrid
    motion: MotionSpec
    target: TargetPattern
    loading: float
    runners: tuple[Runner, ...]


def set_up(comparison: Comparison) -> list[PreparedCondition]:
    """Load the plugins, and validate and prepare every condition."""
    targets = [read_target(condition.target) for condition in comparison.conditions]
    host = load_plugins([folder for target in targets for folder in target.plugin_folders])
    return [
        _prepare(host, comparison, condition, target)
        for condition, target in zip(comparison.conditions, targets, strict=True)
    ]


def warm(prepared: list[PreparedCondition]) -> None:
    """Compile or load all necessary kernels, and let planners choose how they plan."""
    importlib.import_module("labseq.motion.check_kernels")  # otherwise the first plan would wait for them
    for runner in [runner for condition in prepared for runner in condition.runners]:
        if isinstance(runner.planner, NeedsWarmUp):
            with _naming(runner, "warm"):
                runner.planner.warm()
    load_kernels()
    for condition in prepared:
        for runner in condition.runners:
            with _naming(runner, "choose"):
                choice_of(runner.planner, condition.target)


@contextmanager
def _naming(runner: Runner, call: str) -> Generator[None]:
    """Add the planner's name to an error that its call raises."""
    try:
        yield
    except Exception as error:
        raise PlanError(f"{call}() raised {format_plugin_error(error)}", runner.name) from error


def _prepare(
    host: PluginHost, comparison: Comparison, condition: Condition, target_choice: TargetChoice
) -> PreparedCondition:
    problems = ProblemCollector()
    grid, motion, target = SiteGrid(*condition.shape), _motion(condition), None
    with problems:
        target = target_choice.make(host, grid)
    runners: list[Runner] = []
    for planner_entry in comparison.planner_entries:
        with problems:
            choice = _planner(host, comparison, condition, planner_entry)
            runners.append(_runner(choice, grid, motion, comparison.seed))
    problems.raise_any()
    assert target is not None
    return PreparedCondition(grid, motion, target, condition.loading, tuple(runners))


def _motion(condition: Condition) -> MotionSpec:
    overrides = [
        Override(f"motion.{key}", value, f"--set {_MOTION_ADDRESS}.{key}={value}")
        for key, value in condition.motion
    ]
    # validated as in a profile, so that mistakes are reported in the same way
    document = Document.of_options(overrides, _MOTION_ADDRESS)
    motion = document.validate(MotionSpec, ("motion",), called=_MOTION_ADDRESS)
    n = condition.degree_of_parallelism
    limit, meaning = min(
        (motion.max_tweezers, "the maximum number of tweezers on at once"),
        (max(motion.max_row_tones, motion.max_column_tones), "the maximum number of tones per axis"),
        key=lambda pair: pair[0],
    )
    if n is not None and not 1 <= n <= limit:
        hint = (
            f"or raise the limit: --set {_MOTION_ADDRESS}.max_tweezers={n}" if "tweezers" in meaning else ""
        )
        problem = f"the degree of parallelism is {n}"
        raise ConfigError(Problem(problem, f"--dop {n}", expected=f"1 to {limit}, {meaning}", hint=hint))
    return motion


def _planner(
    host: PluginHost, comparison: Comparison, condition: Condition, planner_entry: PlannerEntry
) -> ChosenPlugin:
    name, dop = planner_entry.planner, condition.degree_of_parallelism
    overrides = [
        Override(f"planner.{key}", value, f"--set planner.{key}={value}")
        for key, value in comparison.settings
    ]
    overrides += [
        Override(f"planner.{key}", value, comparison.called) for key, value in planner_entry.settings
    ]
    of_condition = ("degree_of_parallelism", dop, "--dop"), ("loading", condition.loading, "--loading")
    entry = host.registry.find("planner", name)
    for key, value, option in of_condition:
        if entry is not None and value is not None and settings_at(entry.settings_model, (key,)):
            overrides.insert(0, Override(f"planner.{key}", str(value), f"{option} {value}"))
    overrides.insert(0, Override("planner.use", name, comparison.called))
    document = Document.of_options(overrides, comparison.called)
    return resolve(host, document, "planner", Choice(use=name).placed("planner"))


def _runner(choice: ChosenPlugin, grid: SiteGrid, motion: MotionSpec, seed: int) -> Runner:
    planner, dop = construct_planner(choice, Context(grid=grid, motion=motion), seed)
    return Runner(planner, choice.entry.name, dump(choice.entry, choice.settings), dop)


RESULT: Final = np.dtype(
    [
        ("n_batches", np.int32),
        ("n_atoms_moved", np.int32),
        ("distance_m", np.float64),
        ("motion_s", np.float64),
        ("moving_s", np.float64),
        ("n_lost", np.float64),
        ("p_defect_free", np.float64),
        ("n_scans", np.float64),
        ("scan_s", np.float64),
        ("planning_s", np.float64),
        ("n_defects", np.int32),
        ("n_surplus", np.int32),
        ("failed", np.bool_),
    ]
)
"""Results of one plan. Linked batches, which share one pick-up, count as one. Scans are NaN without any.

``moving_s`` is ``motion_s`` without the overheads of batches and cycle. ``n_lost`` and ``p_defect_free``
are the same as in :class:`labseq.motion.Survival`.
"""

LOADING: Final = np.dtype([("n_atoms", np.int32), ("n_lines", np.int32)])
"""Results of one loading. ``n_lines`` as in :func:`lines_to_cover`."""

_NO_SCANS: Final = (math.nan, math.nan)


@dataclass(frozen=True, slots=True)
class Job:
    """Loadings ``start`` to ``stop`` (exclusive) of a condition."""

    condition: int
    start: int
    stop: int


@dataclass(frozen=True, slots=True)
class Failure:
    """A planner raised, or its plan breaks a rule. Planner, condition and loading are indices."""

    planner_entry: int
    condition: int
    loading: int
    message: str


@dataclass(frozen=True, slots=True, eq=False)
class JobResults:
    """The results of a job.

    Attributes:
        results: :data:`RESULT` (n_planners, n_loadings).
        loadings: :data:`LOADING` (n_loadings,).
        failures: The first failure of each planner.
    """

    job: Job
    results: NDArray[Any]
    loadings: NDArray[Any]
    failures: tuple[Failure, ...]


def loading_seed(seed: int, index: int) -> int:
    """The seed of loading ``index``, which is the first word of the state of the seed's index-th child.

    A loading is ``numpy.random.default_rng(loading_seed).random((rows, cols)) <
    loading``, as for ``labseq plan random:ROWSxCOLS@LOADING --seed LOADING_SEED``.

    Example:
        >>> child = np.random.SeedSequence(5).spawn(3)[2]
        >>> loading_seed(5, 2) == int(child.generate_state(1)[0])
        True
    """
    return int(np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(1)[0])


def draw(shape: tuple[int, int], loading: float, seed: int, index: int) -> Occupancy:
    """Draw a loading, bool ``shape``, see :func:`loading_seed`."""
    return np.random.default_rng(loading_seed(seed, index)).random(shape) < loading


def lines_to_cover(vacancies: NDArray[np.bool_]) -> NDArray[np.int32]:
    """The smallest number of rows and columns that together cover all vacancies.

    Every vacancy is filled by a batch that moves along its row or its column, so
    no planner that moves one line at a time needs fewer batches. Vacancies as
    edges between rows and columns make a bipartite graph, whose smallest vertex
    cover is as large as its largest matching (D. Konig, 1931).

    Args:
        vacancies: bool (n_loadings, n_rows, n_cols), fill sites that are empty.

    Returns:
        int32 (n_loadings,).

    Example:
        >>> lines_to_cover(np.array([[[1, 1, 1], [0, 1, 0], [0, 0, 0]]], np.bool_))
        array([2], dtype=int32)
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import maximum_bipartite_matching

    n_loadings, n_rows, n_cols = vacancies.shape
    loading, row, col = np.nonzero(vacancies)
    ones = np.ones(len(loading), np.bool_)
    shape = (n_loadings * n_rows, n_loadings * n_cols)  # one graph for all loadings, and so one call
    graph = csr_array((ones, (loading * n_rows + row, loading * n_cols + col)), shape=shape)
    matched = maximum_bipartite_matching(graph, perm_type="column")
    return np.count_nonzero(matched.reshape(n_loadings, n_rows) >= 0, axis=1).astype(np.int32)


def work(prepared: list[PreparedCondition], seed: int, job: Job) -> JobResults:
    """Run every planner on the loadings of a job, and check and count its plans."""
    condition = prepared[job.condition]
    indices = range(job.start, job.stop)
    occupancies = [draw(condition.grid.shape, condition.loading, seed, index) for index in indices]
    loadings = np.empty(len(occupancies), LOADING)
    stack = np.array(occupancies)
    loadings["n_atoms"] = np.count_nonzero(stack, axis=(1, 2))
    loadings["n_lines"] = lines_to_cover(condition.target.fill & ~stack)
    results = np.empty((len(condition.runners), len(occupancies)), RESULT)
    failures: list[Failure] = []
    for i, runner in enumerate(condition.runners):
        rows: list[tuple[Any, ...]] = []
        for index, occupancy in zip(indices, occupancies, strict=True):
            try:
                rows.append(_run(condition, runner, occupancy))
            except Exception as error:  # noqa: BLE001 - a planner may raise anything; it is counted
                if not any(failure.planner_entry == i for failure in failures):
                    message = (
                        str(error)
                        if isinstance(error, PlanError)
                        else f"plan() raised {format_plugin_error(error)}"
                    )
                    failures.append(Failure(i, job.condition, index, message))
                rows.append((0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, *_NO_SCANS, 0.0, 0, 0, True))
        results[i] = rows
    return JobResults(job, results, loadings, tuple(failures))


def prepare(comparison: Comparison) -> Callable[[Job], JobResults]:
    """Prepare for jobs. Every planner is called once, so that no measured call is the first."""
    prepared = set_up(comparison)
    warm(prepared)
    for i in range(len(prepared)):
        work(prepared, comparison.seed, Job(i, 0, 1))
    return lambda job: work(prepared, comparison.seed, job)


def _run(condition: PreparedCondition, runner: Runner, occupancy: Occupancy) -> tuple[Any, ...]:
    input_occupancy = occupancy.copy()  # a planner may change its input
    # some papers count scans, during which moving tweezers pick up and drop atoms without stopping
    scan: Any = getattr(runner.planner, "scan", None)
    scanned: Any = None
    start_s = perf_counter()
    if scan is not None:
        scanned = scan(input_occupancy, condition.target)
        plan = scanned.plan
    else:
        plan = runner.planner.plan(input_occupancy, condition.target)
    planning_s = perf_counter() - start_s
    dop = runner.degree_of_parallelism
    report = check_plan(plan, occupancy, condition.target, dop, condition.grid, condition.motion)
    scans = _NO_SCANS
    if scanned is not None:
        scans = float(scanned.n_scans), scanned.duration_s(condition.grid, condition.motion)
    survival = predict_survival(plan, report, occupancy, condition.target, condition.grid, condition.motion)
    motion, starts = condition.motion, ~plan.linked
    overhead_s = plan.n_batches and (  # a plan without batches has no overheads
        motion.overhead_per_cycle_s + np.count_nonzero(starts) * motion.overhead_per_batch_s
    )
    n_atoms_moved = int(np.diff(plan.batch_offsets)[starts].sum())
    n_sites = int(np.abs(plan.moves[:, 2:] - plan.moves[:, :2]).sum())
    return (
        int(np.count_nonzero(starts)),
        n_atoms_moved,
        n_sites * condition.grid.spacing_m,
        report.duration_s,
        report.duration_s - overhead_s,
        survival.n_lost,
        survival.p_defect_free,
        *scans,
        planning_s,
        report.n_defects,
        report.n_surplus,
        False,
    )
