from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from labseq.assembly.options import Options
from labseq.errors import ConfigError
from labseq.session.session import Session

SEQUENCE = Path(__file__).parents[2] / "sequences" / "compact_225.yaml"


@pytest.mark.parametrize("sequence", [None, b"a.yaml"])
def test_the_sequence_is_a_path(sequence: Any) -> None:
    with pytest.raises(ConfigError, match=r"^sequence is .*; expected a path$"):
        Session.open(sequence)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"output": 5}, "output is 5; .* path"),
        ({"profile": 5}, "profile is 5; .* hardware profile"),
        ({"shots": "many"}, "--shots many: .* a whole number"),
        ({"dry_run": "slow"}, "dry_run is 'slow'; .*'off', 'full', 'fast'"),
        ({"overrides": "shots=5"}, r"overrides is 'shots=5'; .*\['shots=5'\]"),
        ({"seed": -1}, "--seed -1: .* at least 0"),
    ],
)
def test_options_say_what_was_expected(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{message}"):
        Session.open(SEQUENCE, **given)


@pytest.mark.parametrize(
    "options",
    [
        Options(),
        Options(shots=5, seed=7, profile="lab", dry_run="full"),
        Options(overrides=("shots=0x10", "seed=~", "planner={use: lsap}", "planner.x=a=b", "attempts=1")),
    ],
)
def test_options_come_back_from_what_they_changed(options: Options) -> None:
    again = Options.of(options.changes(), realtime=True)
    assert again.changes() == options.changes()
    assert list(again.changes()) == list(options.changes())
    assert again.realtime
