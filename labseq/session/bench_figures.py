"""The paper's figures 2 and 3 as comparisons (W. Tian et al., sections "Reduced move complexity").

What the paper leaves open is chosen here and said in ``docs/explanation/planners.md``:
the size of the grid beside that of the target, and in figure 3 the degree of
parallelism.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, Literal

from labseq.config.wording import clean, did_you_mean
from labseq.errors import ConfigError, Problem, one_of
from labseq.session.bench_spec import BARE_MOTION, Condition, PlannerEntry, Words

Quantity = Literal["n_target_atoms", "degree_of_parallelism", "n_batches", "motion_s"]


@dataclass(frozen=True, slots=True)
class Figure:
    """What a figure shows.

    Attributes:
        name: Its name in the paper.
        title: What is compared, and how.
        x: What differs between the conditions.
        y: What is drawn over it.
        entrants: A curve each.
        conditions: A point each.
        fitted: Whether the curves are power laws of x.
        paper: What the paper states of it, in words.
        paper_points: What the paper states of it: (x, y) each.
        histograms_at: Values of x for which the first planner's batches are drawn as histograms.
    """

    name: str
    title: str
    x: Quantity
    y: Quantity
    planner_entries: tuple[PlannerEntry, ...]
    conditions: tuple[Condition, ...]
    fitted: bool
    paper: str
    paper_points: tuple[tuple[float, float], ...] = ()
    histograms_at: tuple[int, ...] = ()

    def with_motion(self, motion: Words) -> list[Condition]:
        """The conditions with some settings of the motion changed."""
        return [replace(condition, motion=(*condition.motion, *motion)) for condition in self.conditions]


PSCA: Final = PlannerEntry("psca")
PSCA_OF_THE_PAPER: Final = PlannerEntry("psca", (("variant", "paper"),))

EBADI: Final[Words] = (("speed", "75 um/ms"), ("pick_up", "15 us"), ("drop_off", "15 us"))
"""Transport speed and capture time of S. Ebadi et al., Nature 595, 227 (2021)."""


def _compact(side: int) -> Condition:
    """A centred square, four sites of the grid for three of the target along each side, as 20 for 15."""
    grid = round(side * 4 / 3)
    return Condition((grid, grid), f"compact:{side}x{side}", 0.75, 15)


def _interleaved(side: int) -> Condition:
    """Target rows with a reservoir row after each, and a tenth of the columns more on both sides.

    At 55 % loading that makes 1.32 atoms per target site, nearly as many as 20 x 20
    for 15 x 15 at 75 %. All atoms of a line may move at once.
    """
    rows, cols = 2 * side, round(1.2 * side)
    limits = ("max_tweezers", "max_row_tones", "max_column_tones")
    motion = (*BARE_MOTION, *EBADI, *((limit, str(rows)) for limit in limits))
    return Condition((rows, cols), f"interleaved:{side}x{side}", 0.55, rows, motion)


_COMPACT: Final = tuple(_compact(side) for side in (6, 9, 12, 15))
_INTERLEAVED: Final = tuple(_interleaved(side) for side in (5, 7, 10, 13, 15, 18, 20))
_MTA1: Final = (PSCA, PSCA_OF_THE_PAPER, PlannerEntry("mta1"))

FIGURES: Final[Mapping[str, Figure]] = MappingProxyType(
    {
        figure.name: figure
        for figure in (
            Figure(
                name="2b",
                title="compact targets, 75 % loading, degree of parallelism 15",
                x="n_target_atoms",
                y="n_batches",
                planner_entries=(PSCA, PSCA_OF_THE_PAPER, PlannerEntry("lsap_squared")),
                conditions=_COMPACT,
                fitted=True,
                paper="PSCA 0.48(2), modified LSAP 1.16(1)",
            ),
            Figure(
                name="2c",
                title="15 x 15 out of 20 x 20, 75 % loading",
                x="degree_of_parallelism",
                y="n_batches",
                planner_entries=(PSCA, PSCA_OF_THE_PAPER),
                conditions=tuple(Condition((20, 20), "compact:15x15", 0.75, dop) for dop in range(2, 16)),
                fitted=False,
                paper="PSCA 160.0(2) batches at 2, 29.61(3) at 15",
                paper_points=((2, 160.0), (15, 29.61)),
                histograms_at=(2, 3, 5, 7, 15),
            ),
            Figure(
                name="3a",
                title="interleaved targets, 55 % loading, any degree of parallelism",
                x="n_target_atoms",
                y="n_batches",
                planner_entries=_MTA1,
                conditions=_INTERLEAVED,
                fitted=True,
                paper="PSCA 0.388(2), MTA1 0.47(1)",
            ),
            Figure(
                name="3b",
                title="interleaved targets, 55 % loading, any degree of parallelism",
                x="n_target_atoms",
                y="motion_s",
                planner_entries=_MTA1,
                conditions=_INTERLEAVED,
                fitted=True,
                paper="at 400 atoms PSCA takes a quarter of MTA1's time",
            ),
        )
    }
)
"""Name -> figure."""


def find_figure(name: str) -> Figure:
    """The figure of that name.

    Raises:
        ConfigError: There is none.
    """
    figure = FIGURES.get(name)
    if figure is None:
        hint = did_you_mean(name, FIGURES)
        expected = one_of(list(FIGURES))
        raise ConfigError(
            Problem("there is no such figure", clean(f"--figure {name}"), expected=expected, hint=hint)
        )
    return figure
