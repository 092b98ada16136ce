from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given, settings, strategies as st

from labseq.pictures.plans import MAX_PANELS, Axis, BatchSummary, Panel, make_panels

STORIES = st.lists(
    st.builds(
        BatchSummary,
        axis=st.sampled_from(["row", "column"]),
        lines=st.sets(st.integers(0, 4), min_size=1, max_size=2).map(sorted).map(tuple),
        n_atoms=st.just(1),
        n_ejected=st.just(0),
        n_sites=st.just(1),
    ),
    max_size=120,
)


def summary(axis: Axis, line: int) -> BatchSummary:
    return BatchSummary(axis, (line,), 1, 0, 1)


@settings(deadline=None)
@given(STORIES, st.integers(2, 40))
def test_every_batch_is_in_one_panel_in_order_and_panels_are_few_enough(
    summaries: list[BatchSummary], max_panels: int
) -> None:
    panels = make_panels(summaries, max_panels)
    assert len(panels) <= max_panels
    assert sum(panel.n_batches for panel in panels) == len(summaries)
    assert all(after.first == before.last + 1 for before, after in pairwise(panels))
    assert (panels[0].first if panels else 0) == 0
    for panel in panels:
        named = {(axis, line) for axis, lines in panel.moves_along for line in lines}
        here = summaries[panel.first : panel.last + 1]
        assert named == {(told.axis, line) for told in here for line in told.lines}


@settings(deadline=None)
@given(STORIES)
def test_a_batch_is_alone_while_there_is_room(summaries: list[BatchSummary]) -> None:
    panels = make_panels(summaries, max(1, len(summaries)))
    assert all(panel.n_batches == 1 for panel in panels)
    assert len(make_panels(summaries)) <= MAX_PANELS


def test_axes_are_kept_apart_while_there_is_room() -> None:
    summaries = [summary("row", i) for i in range(9)] + [summary("column", i) for i in range(3)]
    panels = make_panels(summaries, 4)
    assert [panel.title for panel in panels] == [
        "batches 1-3: rows 0-2",
        "batches 4-6: rows 3-5",
        "batches 7-9: rows 6-8",
        "batches 10-12: columns 0-2",
    ]


@pytest.mark.parametrize(
    ("panel", "title"),
    [
        (Panel(0, 0, (("row", (3,)),)), "batch 1: row 3"),
        (Panel(1, 2, (("row", (3,)), ("column", (1, 5)))), "batches 2-3: row 3; columns 1, 5"),
        (Panel(0, 9, (("row", tuple(range(0, 40, 2))),)), "batches 1-10: 20 rows"),
    ],
)
def test_titles(panel: Panel, title: str) -> None:
    assert panel.title == title
