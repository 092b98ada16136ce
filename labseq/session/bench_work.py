"""Planning, checking and counting: what the processes of a comparison do."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from labseq.errors import PlanError
from labseq.model import MotionSpec, Occupancy, Plan, SiteGrid, TargetPattern
from labseq.motion import check_plan
from labseq.session.bench_courses import PreparedCondition, Runner, set_up, warm
from labseq.session.bench_spec import Comparison

RESULT: Final = np.dtype(
    [
        ("n_batches", np.int32),
        ("n_atoms_moved", np.int32),
        ("distance_m", np.float64),
        ("motion_s", np.float64),
        ("n_scans", np.float64),
        ("scan_s", np.float64),
        ("planning_s", np.float64),
        ("n_defects", np.int32),
        ("n_surplus", np.int32),
        ("failed", np.bool_),
    ]
)
"""What is counted of one plan; linked batches, the way of one pick-up, count as one. NaN for no scans."""

LOADING: Final = np.dtype([("n_atoms", np.int32), ("n_lines", np.int32)])
"""What is counted of one loading; ``n_lines`` as in :func:`lines_to_cover`."""

_NO_SCANS: Final = (math.nan, math.nan)
_FAILED: Final = (0, 0, 0.0, 0.0, *_NO_SCANS, 0.0, 0, 0, True)


class Scanned(Protocol):
    """A plan that was made of scans: tweezers that pick up and drop atoms in passing."""

    @property
    def plan(self) -> Plan:
        """The batches that do the same."""
        ...

    @property
    def n_scans(self) -> int:
        """Number of scans: what the algorithm's source counts as moves."""
        ...

    def duration_s(self, grid: SiteGrid, motion: MotionSpec) -> float:
        """Time that the scans would take, in seconds."""
        ...


@runtime_checkable
class ScanningPlanner(Protocol):
    """A planner whose source counts scans, not batches; an optional capability."""

    def scan(self, occupancy: Occupancy, target: TargetPattern) -> Scanned:
        """Plan as ``plan()`` does, and tell the scans."""
        ...


@dataclass(frozen=True, slots=True)
class Job:
    """Loadings ``start`` to ``stop`` (exclusive) of a condition."""

    condition: int
    start: int
    stop: int


@dataclass(frozen=True, slots=True)
class Failure:
    """A planner raised, or its plan breaks a rule.

    Attributes:
        entrant: Index of the planner.
        condition: Index of the condition.
        loading: Index of the loading.
        message: What went wrong.
    """

    planner_entry: int
    condition: int
    loading: int
    message: str


@dataclass(frozen=True, slots=True, eq=False)
class Done:
    """What came of a job.

    Attributes:
        job: The job.
        results: :data:`RESULT` (n_entrants, n_loadings).
        loadings: :data:`LOADING` (n_loadings,).
        failures: The first failure of each planner.
    """

    job: Job
    results: NDArray[Any]
    loadings: NDArray[Any]
    failures: tuple[Failure, ...]


Scan = Callable[[Occupancy, TargetPattern], Scanned]


def loading_seed(seed: int, index: int) -> int:
    """The seed that loading ``index`` is drawn with: the first word of what the seed's index-th child gives.

    A loading is ``numpy.random.default_rng(loading_seed).random((rows, cols)) <
    loading``, as for ``labseq plan random:ROWSxCOLS@LOADING --seed LOADING_SEED``.

    Example:
        >>> child = np.random.SeedSequence(5).spawn(3)[2]
        >>> loading_seed(5, 2) == int(child.generate_state(1)[0])
        True
    """
    return int(np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(1)[0])


def draw(shape: tuple[int, int], loading: float, seed: int, index: int) -> Occupancy:
    """Draw a loading, bool ``shape``; see :func:`loading_seed`."""
    return np.random.default_rng(loading_seed(seed, index)).random(shape) < loading


def lines_to_cover(vacancies: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Count the rows and columns that it takes to cover all vacancies.

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
    shape = (n_loadings * n_rows, n_loadings * n_cols)  # one graph of parts that do not touch: one call
    graph = csr_array((ones, (loading * n_rows + row, loading * n_cols + col)), shape=shape)
    matched = maximum_bipartite_matching(graph, perm_type="column")
    return np.count_nonzero(matched.reshape(n_loadings, n_rows) >= 0, axis=1).astype(np.int32)


def work(courses: list[PreparedCondition], seed: int, job: Job) -> Done:
    """Let every planner plan the loadings of a job, and check and count its plans.

    Args:
        courses: One per condition.
        seed: What all loadings are drawn from.
        job: Which loadings.
    """
    course = courses[job.condition]
    indices = range(job.start, job.stop)
    occupancies = [draw(course.grid.shape, course.loading, seed, index) for index in indices]
    loadings = np.empty(len(occupancies), LOADING)
    stack = np.array(occupancies)
    loadings["n_atoms"] = np.count_nonzero(stack, axis=(1, 2))
    loadings["n_lines"] = lines_to_cover(course.target.fill & ~stack)
    results = np.empty((len(course.runners), len(occupancies)), RESULT)
    failures: list[Failure] = []
    for i, runner in enumerate(course.runners):
        rows: list[tuple[Any, ...]] = []
        scan = runner.planner.scan if isinstance(runner.planner, ScanningPlanner) else None
        for index, occupancy in zip(indices, occupancies, strict=True):
            try:
                rows.append(_run(course, runner, scan, occupancy))
            except Exception as error:  # noqa: BLE001 - a planner may raise anything; it is counted
                if not any(failure.planner_entry == i for failure in failures):
                    failures.append(Failure(i, job.condition, index, _format_error(error)))
                rows.append(_FAILED)
        results[i] = rows
    return Done(job, results, loadings, tuple(failures))


def prepare(comparison: Comparison) -> Callable[[Job], Done]:
    """Make ready for jobs; every planner is called once, so that no time that counts is a first time's."""
    courses = set_up(comparison)
    warm(courses)
    for i in range(len(courses)):
        work(courses, comparison.seed, Job(i, 0, 1))
    return lambda job: work(courses, comparison.seed, job)


def _run(course: PreparedCondition, runner: Runner, scan: Scan | None, occupancy: Occupancy) -> tuple[Any, ...]:
    own = occupancy.copy()  # so that a planner that writes into its input harms only itself
    scanned: Scanned | None = None
    start_s = perf_counter()
    if scan is None:
        plan = runner.planner.plan(own, course.target)
    else:
        scanned = scan(own, course.target)
        plan = scanned.plan
    planning_s = perf_counter() - start_s
    dop = runner.degree_of_parallelism
    report = check_plan(plan, occupancy, course.target, dop, course.grid, course.motion)
    scans = _NO_SCANS
    if scanned is not None:
        scans = float(scanned.n_scans), scanned.duration_s(course.grid, course.motion)
    return (
        *_batches_and_atoms(plan),
        _n_sites(plan) * course.grid.spacing_m,
        report.duration_s,
        *scans,
        planning_s,
        report.n_defects,
        report.n_surplus,
        False,
    )


def _batches_and_atoms(plan: Plan) -> tuple[int, int]:
    """Number of batches, and atoms that they move, with linked ones counted as one."""
    if not plan.linked.any():
        return plan.n_batches, plan.n_atom_moves
    starts = ~plan.linked
    return int(np.count_nonzero(starts)), int(np.diff(plan.batch_offsets)[starts].sum())


def _n_sites(plan: Plan) -> int:
    """How far all atoms move together, in sites."""
    return int(np.abs(plan.moves[:, 2:] - plan.moves[:, :2]).sum())


def _format_error(error: Exception) -> str:
    if isinstance(error, PlanError):
        return str(error)
    text = str(error)
    return f"plan() raised {type(error).__name__}" + (f": {text}" if text else "")
