"""Analyses of a sequence's shots, and the settings of those that come with labseq."""

from __future__ import annotations

from typing import Annotated, Final, Literal, TypeAlias

from pydantic import AfterValidator, Field

from labseq.config.fields import Choice, empty_is, setting_error
from labseq.config.settings import Duration, Settings

ANALYSIS_KEYS: Final = frozenset({"finish_within"})
"""Keys that stand beside the settings of an analysis, and belong to the core."""


class AnalysisChoice(Choice):
    """An analysis chosen by name; its settings stand beside the name."""

    finish_within: Duration = Field(
        default=10.0, description="how long it may go on after the run, for the shots it has not come to"
    )


def _listed(choices: tuple[AnalysisChoice, ...]) -> tuple[AnalysisChoice, ...]:
    """Give each its location, and each name to one only: it names the file of the results."""
    first: dict[str, int] = {}
    for i, choice in enumerate(choices):
        if first.setdefault(choice.use, i) != i:
            what = f"the analysis '{choice.use}' stands here a second time"
            raise setting_error(what, "each analysis once", at=(i, "use"))
    return tuple(choice.placed("analysis", i) for i, choice in enumerate(choices))


Analyses: TypeAlias = Annotated[tuple[AnalysisChoice, ...], empty_is(()), AfterValidator(_listed)]
"""The analyses of a sequence."""


class SurvivalSettings(Settings):
    """How many atoms are there on the next image, site by site."""

    atoms: Literal["all", "moved", "held"] = Field(
        default="all",
        description="which atoms count: all, those that were moved in between, or those that were not",
    )
