"""A value of a shot by the name that its column has, from its line in the index."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from labseq.recording.columns import figures_of
from labseq.recording.shot import Shot, load_content


def value_in(row: Mapping[str, Any], name: str) -> float:
    """A value of a shot.

    Args:
        row: The shot's line in the index.
        name: As :meth:`labseq.Run.to_dataframe` calls its column: "filling_fraction", "stage.plan_s",
            "reading.laser.power_w".

    Returns:
        The value; nan if the shot has none of that name, or one that is no number.

    Example:
        >>> value_in({"shot": 0, "filling_fraction": 0.5, "stage_s": {"plan": 0.1}}, "stage.plan_s")
        0.1
    """
    return figures_of(Shot(Path(), dict(row), load_content)).get(name, math.nan)
