"""Promises of target patterns and planners."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from itertools import product
from typing import Any, ClassVar, Final, TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray

from labseq.errors import InvalidPlanError, LabseqError
from labseq.kernels.kernel import load_kernels
from labseq.model import Occupancy, Plan, PlanReport, SiteGrid, TargetPattern
from labseq.motion import RULES, check_plan
from labseq.roles import ChoosesPlanner, Context, NeedsWarmUp, Planner
from labseq.testing.contracts.promises import (
    CallHungError,
    ContractViolation,
    as_this_promise,
    doing,
    format_error,
    in_time,
    no_factory,
    promise,
    quietly,
    refusal,
)
from labseq.testing.strategies import drawn

PatternFactory: TypeAlias = Callable[[SiteGrid], TargetPattern]

FITS: Final = "it makes a TargetPattern of the grid's shape"


class PatternContract:
    """Promises of a target pattern. Provide the fixture ``factory``, a function of the grid.

    Attributes:
        grids: Grids on which the pattern fits with the settings of the test.
        too_small: A grid on which it does not fit. None if it fits on any.
    """

    grids: ClassVar[Sequence[SiteGrid]] = (SiteGrid(), SiteGrid(17, 23, shear=-1))
    too_small: ClassVar[SiteGrid | None] = SiteGrid(1, 1)

    @pytest.fixture
    def factory(self) -> PatternFactory:
        """Makes the target for a grid. Provided by the plugin's test."""
        no_factory(self, "grid -> target")

    @promise(FITS)
    def test_fits_the_grid(self, factory: PatternFactory) -> None:
        """Make the target on each of ``grids``."""
        for grid in self.grids:
            _target_of(factory, grid)

    @promise("at least one site must hold an atom")
    def test_wants_atoms(self, factory: PatternFactory) -> None:
        """A pattern without atoms would be met without any move."""
        for grid in self.grids:
            assert _target_of(factory, grid).n_atoms > 0, f"on {_called(grid)} it requires none"

    @promise("the same grid gives the same target")
    def test_same_grid_same_target(self, factory: PatternFactory) -> None:
        """Repeat, also after other grids, because a resumed run fills the same target."""
        first = [_target_of(factory, grid) for grid in self.grids]
        for grid, target in zip(self.grids, first, strict=True):
            again = _target_of(factory, grid)
            for name in ("fill", "clear"):
                same = np.array_equal(getattr(target, name), getattr(again, name))
                assert same, f"on {_called(grid)} {name} differs the second time"
            assert target.name == again.name, f"it is called '{target.name}', then '{again.name}'"

    @promise("a grid that is too small for it raises LabseqError")
    def test_refuses_small_grids(self, factory: PatternFactory) -> None:
        """``labseq check`` reports it before the run. A truncated target would be a different target."""
        if self.too_small is not None:
            refusal(LabseqError, _called(self.too_small), factory, self.too_small)

    @promise("it is pure: no I/O, no change of shared state")
    def test_is_pure(self, factory: PatternFactory) -> None:
        """``labseq check`` also makes the target, and other plugins draw from the global random numbers."""
        with doing("the first target"):
            factory(self.grids[0])  # the first call may compile
        with quietly():
            factory(self.grids[0])


def _target_of(factory: PatternFactory, grid: SiteGrid) -> TargetPattern:
    try:
        target: Any = factory(grid)
    except Exception as error:
        raise ContractViolation(FITS, f"on {_called(grid)} it {format_error(error)}") from error
    if not isinstance(target, TargetPattern):
        raise ContractViolation(FITS, f"it made a {type(target).__name__}")
    if target.shape != grid.shape:
        raise ContractViolation(FITS, f"on {_called(grid)} it made one of {target.shape}")
    return target


def _called(grid: SiteGrid) -> str:
    return f"a {grid.lattice} grid of {grid.n_rows} x {grid.n_cols}"


Case: TypeAlias = tuple[TargetPattern, Occupancy]


def examples(n_random: int, targets: Sequence[TargetPattern] = ()) -> list[Case]:
    """Reproducible random cases, the smallest first, so that a failure is shown on a small case.

    Args:
        n_random: Number of random cases.
        targets: Targets of the cases. Default random targets on up to 6 x 6 sites, after all cases of one
            or two sites.
    """
    random = np.random.default_rng(225)
    made: list[Case] = []
    for _ in range(n_random):
        if targets:
            target = targets[int(random.integers(len(targets)))]
        else:
            shape = tuple(random.integers(1, 7, 2).tolist())
            fill = random.random(shape) < random.random()
            target = TargetPattern(fill, ~fill & (random.random(shape) < random.random()))
        made.append((target, random.random(target.shape) < random.random()))
    made.sort(key=lambda case: (case[1].size, np.count_nonzero(case[1])))
    return made if targets else _of_two_sites() + made


def _of_two_sites() -> list[Case]:
    """All cases of one or two sites, each to be filled, to be empty or neither, with or without an atom."""
    states = [(wish == 1, wish == 2, atom) for wish in range(3) for atom in (False, True)]
    made: list[Case] = []
    for shape in ((1, 1), (1, 2), (2, 1)):
        for sites in product(states, repeat=shape[0] * shape[1]):
            fill, clear, atoms = np.array(sites, np.bool_).T.reshape(3, *shape)
            made.append((TargetPattern(fill, clear), atoms.copy()))
    return made


def paper_cases() -> list[Case]:
    """The paper's 15 x 15 out of 20 x 20, and a checkerboard whose other sites must be empty."""
    compact = np.zeros((20, 20), np.bool_)
    compact[2:17, 2:17] = True
    inside = compact.copy()
    board = inside & (np.indices(inside.shape).sum(axis=0) % 2 == 0)
    return [
        loaded(TargetPattern(compact, np.zeros_like(compact), "compact")),
        loaded(TargetPattern(board, inside & ~board, "checkerboard")),
    ]


def loaded(target: TargetPattern, filling: float = 0.75) -> Case:
    """The target with a reproducible random loading that has enough atoms for it."""
    order = np.random.default_rng(225).permutation(target.fill.size)
    n_atoms = max(target.n_atoms, round(filling * target.fill.size))
    atoms = np.zeros(target.fill.size, np.bool_)
    atoms[order[:n_atoms]] = True
    return target, atoms.reshape(target.shape)


def small_targets() -> list[TargetPattern]:
    """Targets on the smallest grids, with all sites, none, every other site, and all to be empty."""
    made: list[TargetPattern] = []
    for shape in ((1, 1), (1, 2), (1, 9), (9, 1), (2, 2), (3, 3)):
        none, every = np.zeros(shape, np.bool_), np.ones(shape, np.bool_)
        other = _every_other(shape)
        made += [TargetPattern(every, none), TargetPattern(none, none), TargetPattern(none, every)]
        made += [TargetPattern(other, ~other), TargetPattern(other, none)]
    return made


def extreme_cases(targets: Iterable[TargetPattern]) -> list[Case]:
    """Each target with no atom, with an atom on every site, and on every other site."""
    return [
        (target, atoms)
        for target in targets
        for atoms in (
            np.zeros(target.shape, np.bool_),
            np.ones(target.shape, np.bool_),
            ~_every_other(target.shape),
        )
    ]


def _every_other(shape: tuple[int, int]) -> NDArray[np.bool_]:
    return np.indices(shape).sum(axis=0) % 2 == 0


RETURNS_A_PLAN: Final = "plan() returns a Plan, whatever the grid, the loading and the target"
NO_ATOM_CREATED: Final = "no atom is created: every move takes an atom that is there"


MAX_WAIT_S: Final = 60.0
"""Real time after which plan() counts as hung. The first call may compile."""
_SIGNATURE: Final = "def plan(self, occupancy, target)"
_COPY: Final = "begin plan() with 'occupancy = as_occupancy(occupancy, target.shape)' of labseq.plugin"


_HANGING: Final[dict[type, str]] = {}
"""Class of a planner that hangs -> the case, so that the suite waits for each planner only once."""


def plan_of(
    planner: Planner, target: TargetPattern, atoms: Occupancy, max_wait_s: float | None = None
) -> Plan:
    """The plan of a planner.

    Raises:
        ContractViolation: It is not a Plan, or the planner hangs or raises another error than LabseqError.
        CallHungError: The planner has not returned after ``max_wait_s``.
    """
    case = f"for\n{drawn(target, atoms)}"
    if type(planner) in _HANGING:
        raise ContractViolation(RETURNS_A_PLAN, _HANGING[type(planner)])
    try:
        plan: Any = in_time(max_wait_s or MAX_WAIT_S, "plan()", planner.plan, atoms, target)
    except LabseqError:
        raise
    except CallHungError as error:
        if max_wait_s is not None:
            raise
        _HANGING[type(planner)] = f"{error} {case}"
        raise ContractViolation(
            RETURNS_A_PLAN, f"{error} {case}", "end every loop, and wait for nothing"
        ) from None
    except Exception as error:
        is_signature = isinstance(error, TypeError) and "argument" in str(error)
        advice = f"write it as '{_SIGNATURE}'" if is_signature else "plan for this case, or raise PlanError"
        raise ContractViolation(RETURNS_A_PLAN, f"it {format_error(error)} {case}", advice) from error
    if not isinstance(plan, Plan):
        advice = "'return Plan.from_batches(batches)', a batch being two lists of (row, column), from and to"
        raise ContractViolation(RETURNS_A_PLAN, f"it returned a {type(plan).__name__}", advice)
    return plan


def replay(plan: Plan, atoms: Occupancy) -> Occupancy:
    """Follow every atom, even on illegal paths.

    Returns:
        The final sites of the atoms, bool (n_rows, n_cols).

    Raises:
        ContractViolation: A move starts on a site without an atom.
    """
    held = {(int(row), int(col)) for row, col in np.argwhere(atoms)}
    for index, batch in enumerate(plan.batches):
        for row, col in batch.from_sites.tolist():
            if (row, col) not in held:
                what = f"batch {index} takes an atom from ({row}, {col}), which is empty, for the loading"
                advice = "follow every atom from batch to batch, with rows and columns counted from 0"
                raise ContractViolation(NO_ATOM_CREATED, f"{what}\n{_sites(atoms)}", advice)
            held.remove((row, col))
        held.update((row, col) for row, col in batch.to_sites.tolist())
    end = np.zeros_like(atoms, order="C")
    for row, col in held:
        if 0 <= row < end.shape[0] and 0 <= col < end.shape[1]:
            end[row, col] = True
    return end


def _sites(atoms: Occupancy) -> str:
    """Draw an occupancy, one line per row."""
    return "\n".join("".join(".#"[atom] for atom in row) for row in atoms.tolist())


def same(target: TargetPattern) -> TargetPattern:
    """A copy, for a planner that may write into its input."""
    return TargetPattern(target.fill.copy(), target.clear.copy(), target.name)


PlannerFactory: TypeAlias = Callable[[Context], Planner]
Check: TypeAlias = Callable[[TargetPattern, Occupancy], None]

PASSES_THE_CHECK: Final = "the plan passes labseq.check_plan at the planner's degree of parallelism"


class PlannerContract:
    """Promises of a planner. Provide the fixture ``factory``.

    Attributes:
        fills_any_target: Whether the planner fills every target if there are enough atoms.
            If not, it fills ``targets``, and for any other target its plan is
            legal, or it raises a LabseqError.
        targets: Some targets that it fills. Needed without ``fills_any_target``.
        time_limit_s: Longest time for one plan of the paper's size (15 x 15 out of
            20 x 20 sites at 75 % filling) or the largest of ``targets``, in seconds.
        n_examples: Number of random cases per promise.
    """

    fills_any_target: ClassVar[bool] = True
    targets: ClassVar[Sequence[TargetPattern]] = ()
    time_limit_s: ClassVar[float] = 2.0
    n_examples: ClassVar[int] = 60

    @pytest.fixture
    def factory(self) -> PlannerFactory:
        """Constructs the planner from a context. Provided by the plugin's test."""
        no_factory(self, "context -> planner")

    def context(self, shape: tuple[int, int]) -> Context:
        """Context of the planner. Override it for other limits of motion."""
        return Context("planner", SiteGrid(*shape))

    def stopwatch(self) -> float:
        """The clock that times plans, in seconds."""
        return time.perf_counter()

    @promise(RETURNS_A_PLAN)
    def test_returns_a_plan(self, factory: PlannerFactory) -> None:
        """Plan for single sites and lines, empty and full loadings, and full size."""
        for case in self.extreme_cases():
            self.checked(factory, *case)
        for target, atoms in self.large_cases():
            self.planned(factory, target, atoms)

    @promise(NO_ATOM_CREATED)
    def test_creates_no_atom(self, factory: PlannerFactory) -> None:
        """Plan for random small arrays and any target."""

        def check(target: TargetPattern, atoms: Occupancy) -> None:
            plan = self.answered(self.made(factory, self.context(target.shape)), target, atoms)
            if plan is not None:
                replay(plan, atoms)

        self.on_examples(check)

    @promise(PASSES_THE_CHECK)
    def test_plans_are_legal(self, factory: PlannerFactory) -> None:
        """Plan for small random arrays with any number of atoms, and one of full size."""

        def check(target: TargetPattern, atoms: Occupancy) -> None:
            self.checked(factory, target, atoms)

        self.on_examples(check)
        for case in self.large_cases():
            check(*case)

    @promise(
        "the target is filled, and clear sites are emptied, when there are enough atoms",
        "if it fills only certain targets, set fills_any_target = False and list some of them in targets",
    )
    def test_fills_the_target(self, factory: PlannerFactory) -> None:
        """Plan for random small arrays with enough atoms, and one of full size."""

        def check(target: TargetPattern, atoms: Occupancy) -> None:
            report = self.checked(factory, target, atoms)
            if report is None or np.count_nonzero(atoms) < target.n_atoms:
                return
            left = f"the plan leaves {report.n_defects} defects and {report.n_surplus} surplus atoms"
            assert report.meets_target, f"{left} of\n{drawn(target, atoms)}"

        self.on_examples(check, served=True)
        for case in self.large_cases():
            check(*case)

    @promise("with too few atoms the plan leaves no more defects than it found")
    def test_does_what_it_can_with_too_few_atoms(self, factory: PlannerFactory) -> None:
        """Plan for random small arrays."""

        def check(target: TargetPattern, atoms: Occupancy) -> None:
            report = self.checked(factory, target, atoms)
            if report is not None and np.count_nonzero(atoms) < target.n_atoms:
                found = target.n_defects(atoms)
                text = f"it found {found} and leaves {report.n_defects} of\n{drawn(target, atoms)}"
                assert report.n_defects <= found, text

        self.on_examples(check, served=True)

    @promise(
        "the same input gives the same plan",
        "keep nothing between calls, and do not use the order of a set or random numbers",
    )
    def test_same_input_same_plan(self, factory: PlannerFactory) -> None:
        """Repeat, also after other calls and with a new instance."""
        for target, atoms in self.large_cases():
            planner = self.made(factory, self.context(target.shape))
            first = plan_of(planner, same(target), atoms.copy())
            again = {"the second time": plan_of(planner, same(target), atoms.copy())}
            self.answered(planner, same(target), ~atoms)
            again["after another input"] = plan_of(planner, same(target), atoms.copy())
            again["from a new instance"] = self.planned(factory, same(target), atoms.copy())
            for when, plan in again.items():
                assert first.is_same(plan), f"the plan differs {when}"

    @promise("the input is left untouched", f"{_COPY}, and change only a copy of it: occupancy.copy()")
    def test_leaves_the_input_untouched(self, factory: PlannerFactory) -> None:
        """Compare occupancy and target before and after. The occupancy belongs to the shot's record."""
        for target, atoms in self.large_cases():
            given_atoms = atoms.copy()
            fill, clear = target.fill.copy(), target.clear.copy()
            self.planned(factory, target, given_atoms)
            assert np.array_equal(given_atoms, atoms), "plan() changed the occupancy"
            assert np.array_equal(target.fill, fill), "plan() changed the target's fill"
            assert np.array_equal(target.clear, clear), "plan() changed the target's clear"

    @promise("read-only and non-contiguous occupancies are planned like others", _COPY)
    def test_takes_any_memory_layout(self, factory: PlannerFactory) -> None:
        """Recorded occupancies are read-only, and a view of a larger array is not contiguous."""
        for target, atoms in self.large_cases():
            expected = target.n_defects(replay(self.planned(factory, target, atoms.copy()), atoms))
            read_only = atoms.copy()
            read_only.flags.writeable = False
            strided = np.repeat(atoms, 2, axis=1)[:, ::2]
            layouts = {"read-only": read_only, "Fortran": np.asfortranarray(atoms), "strided": strided}
            for layout, same_atoms in layouts.items():
                with doing(f"a {layout} occupancy"):
                    plan = self.planned(factory, target, same_atoms)
                    with as_this_promise():
                        left = target.n_defects(replay(plan, atoms))
                    assert left == expected, f"the plan leaves {left} defects, not {expected}"

    @promise(
        "an array that is not an occupancy of the target's shape raises LabseqError or ValueError", _COPY
    )
    def test_refuses_wrong_input(self, factory: PlannerFactory) -> None:
        """Pass wrong arrays, which must give neither a plan nor an obscure error."""
        target, atoms = self.large_cases()[0]
        planner = self.made(factory, self.context(target.shape))
        plan_of(planner, target, atoms.copy())
        wrong: dict[str, NDArray[Any]] = {
            "an occupancy of one row too few": atoms[:-1],
            "an occupancy of one column too many": np.pad(atoms, ((0, 0), (0, 1))),
            "a flat occupancy": atoms.ravel(),
            "a stack of occupancies": atoms[None],
            "an occupancy of 0.5": np.full(target.shape, 0.5),
            "an occupancy of text": np.full(target.shape, "atom"),
        }
        for what, values in wrong.items():
            refusal((LabseqError, ValueError), what, planner.plan, values, target)

    @promise(
        "a plan is made within the time limit",
        "write the loops as kernels (labseq.plugin.kernel), or raise time_limit_s and timeouts.plan",
    )
    def test_plans_in_time(self, factory: PlannerFactory) -> None:
        """Time plans of full size after compiling. The best of three counts."""
        for target, atoms in self.large_cases():
            planner = self.ready(factory, target)
            taken_s: list[float] = []
            for _ in range(3):
                start_s = self.stopwatch()
                plan_of(planner, target, atoms.copy(), 2 * self.time_limit_s)
                taken_s.append(self.stopwatch() - start_s)
                if taken_s[-1] <= self.time_limit_s:
                    break
            text = f"plan() took {min(taken_s):.3g} s, and the limit is {self.time_limit_s:g} s"
            assert min(taken_s) <= self.time_limit_s, text

    @promise("plan() is pure: no I/O, no change of shared state")
    def test_is_pure(self, factory: PlannerFactory) -> None:
        """Other plugins also draw from the global random numbers."""
        for target, atoms in self.large_cases():
            planner = self.ready(factory, target)
            plan_of(planner, target, atoms.copy())
            with quietly():
                planner.plan(atoms.copy(), target)

    def made(self, factory: PlannerFactory, context: Context) -> Planner:
        """A new planner with compiled kernels, as in a run. Compiling may take longer than any plan."""
        try:
            planner = factory(context)
        except TypeError as error:
            advice = "the fixture 'factory' takes the context alone, as in partial(MyPlanner, MySettings())"
            detail = f"its constructor {format_error(error)}"
            raise ContractViolation(RETURNS_A_PLAN, detail, advice) from error
        if not callable(getattr(planner, "plan", None)):
            detail = f"factory(context) made a {type(planner).__name__}, which has no method plan"
            raise ContractViolation(RETURNS_A_PLAN, detail, f"write '{_SIGNATURE}'")
        if isinstance(planner, NeedsWarmUp):
            planner.warm()
            load_kernels()
        return planner

    def planned(self, factory: PlannerFactory, target: TargetPattern, atoms: Occupancy) -> Plan:
        """The plan of a new planner, which receives the array itself and not a copy."""
        return plan_of(self.made(factory, self.context(target.shape)), target, atoms)

    def answered(self, planner: Planner, target: TargetPattern, atoms: Occupancy) -> Plan | None:
        """The plan of a planner. None if it refuses a target that it need not fill."""
        try:
            return plan_of(planner, target, atoms.copy())
        except LabseqError as error:
            if self.fills_any_target or any(target is served for served in self.targets):
                detail = f"it {format_error(error)} for\n{drawn(target, atoms)}"
                raise ContractViolation(RETURNS_A_PLAN, detail) from error
            return None

    def checked(self, factory: PlannerFactory, target: TargetPattern, atoms: Occupancy) -> PlanReport | None:
        """The check's report on a new planner's plan. None if it refuses a target that it need not fill."""
        context = self.context(target.shape)
        planner = self.made(factory, context)
        plan = self.answered(planner, target, atoms)
        if plan is None:
            return None
        replay(plan, atoms)
        dop = getattr(planner, "degree_of_parallelism", context.motion.max_tweezers)
        try:
            return check_plan(plan, atoms, target, dop, grid=context.grid, motion=context.motion)
        except InvalidPlanError as error:
            detail = f"{error}; for\n{drawn(target, atoms)}"
            advice = f"rule '{error.rule}': {RULES[error.rule]} (draw the plan with 'labseq plan --png')"
            raise ContractViolation(PASSES_THE_CHECK, detail, advice) from None

    def ready(self, factory: PlannerFactory, target: TargetPattern) -> Planner:
        """A new planner, which has chosen another planner for the target if it makes such a choice."""
        planner = self.made(factory, self.context(target.shape))
        if isinstance(planner, ChoosesPlanner):
            planner.choose(target, math.inf)
        return planner

    def on_examples(self, check: Check, *, served: bool = False) -> None:
        """Check all cases of one or two sites, and random ones, the smallest first.

        Args:
            check: Function of a target and an occupancy.
            served: Whether the planner must be able to fill the target.
        """
        for target, atoms in examples(self.n_examples, self.served_targets() if served else ()):
            check(target, atoms)

    def served_targets(self) -> Sequence[TargetPattern]:
        """The targets that the planner fills. Empty if it fills any."""
        if self.fills_any_target or self.targets:
            return () if self.fills_any_target else self.targets
        example = "targets = (labseq.make_target('compact', rows=4, cols=4, grid=(8, 8)),)"
        what = f"{type(self).__name__} has fills_any_target = False and no targets"
        raise ContractViolation(RETURNS_A_PLAN, what, f"list some that it always fills: {example}")

    def large_cases(self) -> list[Case]:
        """Cases of full size with enough atoms."""
        return (
            paper_cases() if self.fills_any_target else [loaded(target) for target in self.served_targets()]
        )

    def extreme_cases(self) -> list[Case]:
        """Cases of extreme size and loading."""
        return extreme_cases(small_targets() if self.fills_any_target else self.served_targets())
