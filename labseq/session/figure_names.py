"""Names of the figures that come of a shot, where a sequence speaks of one: a misspelt one is found early."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from labseq.config import Document
from labseq.config.nodes import Loc
from labseq.config.wording import clean, did_you_mean, listing
from labseq.recording.columns import FIGURES
from labseq.roles import Step

_JUDGED: Final = frozenset(
    {"success", "filling_fraction", "n_defects", "n_surplus", "seen_defect_free_cycle"}
)
"""Figures that only a shot with an image has."""
_UNFORESEEN: Final = ("reading.", "stage.")
"""What the names of figures begin with that only a shot can tell."""


def check_figure(
    document: Document, place: Loc, figure: str, purpose: str, steps: Sequence[tuple[str, Step]] | None
) -> None:
    """See whether shots may have a figure.

    Args:
        document: The sequence.
        place: Where it is named.
        figure: Its name.
        purpose: What it is for: "to climb on".
        steps: The steps of a shot, if all are known.

    Raises:
        ConfigError: No shot can have it.
    """
    if figure not in FIGURES and not figure.startswith(_UNFORESEEN):
        what = f"there is no figure '{clean(figure)}' {purpose}"
        known = [*FIGURES, "reading.<name>", "stage.<name>_s"]
        raise document.error(place, what, listing(known), did_you_mean(figure, FIGURES))
    if figure in _JUDGED and steps is not None and not any(step.takes_image for _, step in steps):
        what = f"no shot has a {figure}: it takes no image"
        raise document.error(place, what, "an 'image' step in the shot, or another figure")


def missing_figure(shot: int, figure: str, purpose: str, figures: Iterable[str]) -> str:
    """What to say of a shot that has not the figure that it should have.

    Args:
        shot: Its index.
        figure: Name of the figure.
        purpose: What it is for: "to climb on".
        figures: Names of those that it has.
    """
    known = list(figures)
    hint = did_you_mean(figure, known) or f"it has {listing(known)}"
    return f"shot {shot + 1} has no '{clean(figure)}' {purpose} ({hint})"
