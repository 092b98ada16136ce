"""Fits in the live view of a terminal."""

from __future__ import annotations

import io
import re
from pathlib import Path

from rich.console import Console

import labseq
from labseq.cli.live import LiveView
from labseq.cli.summary import Summary
from labseq.data.follower import Follower

SEQUENCE = Path(__file__).parents[2] / "sequences" / "lifetime.yaml"


def test_the_view_shows_the_fitted_value_as_the_summary_does(tmp_path: Path) -> None:
    with labseq.Session.open(SEQUENCE, shots=14, seed=1, output=tmp_path) as session:
        run = session.run()
    view = LiveView(Console(file=io.StringIO(), force_terminal=True, width=80, height=24))
    for event in Follower(run.path).events():  # the last one comes before the pause after a fit is over
        view.event(event.name, event.values)
    screen = io.StringIO()
    Console(file=screen, width=80, height=24).print(view.picture)
    decay = run.fit("survival:before,after", "exponential").parameters["decay"]
    assert re.search(rf"decay +{re.escape(str(decay))}", screen.getvalue())


def test_the_summary_says_what_a_fit_that_failed_needs(tmp_path: Path) -> None:
    with labseq.Session.open(SEQUENCE, shots=2, seed=1, output=tmp_path) as session:
        run = session.run()
    ((_, reason),) = Summary.of(run).results
    assert reason.startswith("no fit exponential: 2 points are too few for a fit of 2 parameters")
    assert reason.endswith("expected at least 3 different values with a result")
