from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labseq.config import validate_values
from labseq.errors import ConfigError
from labseq.settings import Duration, Settings


class Colour(Enum):
    RED = "red"


class Model(Settings):
    rows: int = 1
    sizes: tuple[float, ...] = ()
    path: Path = Path()
    colour: Colour | None = None
    window: Duration = 0.06
    nested: dict[str, int] = {}  # noqa: RUF012 - pydantic copies defaults


def test_python_and_numpy_values() -> None:
    values = {
        "rows": np.int64(3),
        "sizes": np.array([1.0, 2.0]),
        "path": Path("a") / "b",
        "colour": Colour.RED,
        "window": "45 ms",
        "nested": {"a": 1},
    }
    made = validate_values(Model, values, "planner 'x'")
    assert made.model_dump() == {
        "rows": 3,
        "sizes": (1.0, 2.0),
        "path": Path("a") / "b",
        "colour": Colour.RED,
        "window": 0.045,
        "nested": {"a": 1},
    }


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"rows": "3"}, "rows is '3'; expected a whole number; write 3 without quotes"),
        (
            {"row": 3},
            "'row' is not a setting of it; expected one of rows, sizes, path, colour, window, nested; ",
        ),
        ({"sizes": (1, None)}, "sizes.1 is empty; expected a number"),
        ({"sizes": [float("nan")]}, "sizes.0 is nan; expected a finite number"),
        ({"rows": object()}, "a value of type object is no setting; expected a number, text, list or dict"),
        ({"window": 1e300}, "window is 1e+300; expected at most 720 h, which is 30 days"),
        ({"window": "721 h"}, "window is '721 h'; expected at most 720 h, which is 30 days"),
        ({"window": "1 K"}, "window: '1 K' is a temperature, not a time"),
    ],
)
def test_refusals(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        validate_values(Model, values, "planner 'x'")
    assert str(caught.value).startswith(f"planner 'x': {message}")


def test_nothing_to_set() -> None:
    assert validate_values(None, {}, "planner 'x'") is None
    with pytest.raises(
        ConfigError, match=r"^planner 'x': it takes no settings, but 'a' is given; remove it$"
    ):
        validate_values(None, {"a": 1}, "planner 'x'")
