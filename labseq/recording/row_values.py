"""The numbers of a shot by the names that their columns have, from its line in the index."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from labseq.recording.columns import figures_of
from labseq.recording.shot import Shot, load_content


def figures_in(row: Mapping[str, Any]) -> dict[str, float]:
    """The numbers that came of a shot.

    Args:
        row: The shot's line in the index.

    Returns:
        Name -> value, as :meth:`labseq.Run.to_dataframe` calls its column: "filling_fraction",
        "stage.plan_s", "reading.laser.power_w". No nan is among them.

    Example:
        >>> figures_in({"shot": 0, "filling_fraction": 0.5, "stage_s": {"plan": 0.1}})
        {'filling_fraction': 0.5, 'stage.plan_s': 0.1}
    """
    return figures_of(Shot(Path(), dict(row), load_content))
