"""What planners are tried on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy
from numpy.typing import NDArray

from labseq.model import Occupancy, TargetPattern
from labseq.testing.strategies import occupancies

Case: TypeAlias = tuple[TargetPattern, Occupancy]


def cases_of(targets: Sequence[TargetPattern]) -> SearchStrategy[Case]:
    """One of the targets, with any occupancy."""
    return st.sampled_from(targets).flatmap(lambda t: st.tuples(st.just(t), occupancies(t.shape)))


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
    """The target with a random loading, always the same, that has enough atoms for it."""
    order = np.random.default_rng(225).permutation(target.fill.size)
    n_atoms = max(target.n_atoms, round(filling * target.fill.size))
    atoms = np.zeros(target.fill.size, np.bool_)
    atoms[order[:n_atoms]] = True
    return target, atoms.reshape(target.shape)


def small_targets() -> list[TargetPattern]:
    """On the smallest grids: all sites, none, every other one, and none with all to be empty."""
    made: list[TargetPattern] = []
    for shape in ((1, 1), (1, 2), (1, 9), (9, 1), (2, 2), (3, 3)):
        none, every = np.zeros(shape, np.bool_), np.ones(shape, np.bool_)
        other = _every_other(shape)
        made += [TargetPattern(every, none), TargetPattern(none, none), TargetPattern(none, every)]
        made += [TargetPattern(other, ~other), TargetPattern(other, none)]
    return made


def extreme_cases(targets: Iterable[TargetPattern]) -> list[Case]:
    """Each target with no atom, with all, and with one on every other site."""
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
