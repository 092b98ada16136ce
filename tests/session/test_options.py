from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from labseq.errors import ConfigError
from labseq.session import Session

SEQUENCE = Path(__file__).parents[2] / "sequences" / "compact_225.yaml"


@pytest.mark.parametrize("sequence", [None, 5, b"a.yaml"])
def test_the_sequence_is_a_path(sequence: Any) -> None:
    with pytest.raises(ConfigError, match=r"^sequence is .*; expected a path$"):
        Session.open(sequence)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"output": 5}, "output is 5; expected a path"),
        ({"profile": 5}, "profile is 5; expected the name or the path of a hardware profile"),
        ({"shots": "many"}, "--shots many: shots is 'many'; expected a whole number"),
        ({"seed": -1}, "--seed -1: seed is -1; expected at least 0"),
    ],
)
def test_options_say_what_was_expected(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Session.open(SEQUENCE, **given)
    assert str(caught.value) == message
