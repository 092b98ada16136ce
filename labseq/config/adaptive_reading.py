"""``scan: {use: ..., over: ...}`` in a sequence file, read and checked.

Whether there is such a scanner, and such a figure, is checked where the plugins are known,
in ``labseq.session.adaptive``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from labseq.config.adaptive import Adaptive, AdaptiveChoice, Ends
from labseq.config.addresses import Override
from labseq.config.collect import ProblemCollector
from labseq.config.document import Document
from labseq.config.nodes import Node
from labseq.config.scan import Axis, Group, Scan
from labseq.config.scan_places import is_free, placed_axis, refuse_twice
from labseq.config.scan_values import alike
from labseq.config.wording import clean, shown


def is_adaptive(node: Node) -> bool:
    """Whether the points of a scan are chosen while the run goes on: ``use`` names by what."""
    return isinstance(node.value, dict) and "use" in node.value


def read_adaptive(document: Document, repeats: int, fixed: Sequence[Override], found: ProblemCollector) -> Scan:
    """Read an adaptive scan.

    Args:
        document: The sequence, overrides included.
        repeats: Shots of each point.
        fixed: The overrides; an axis that one of them sets is left out.
        found: Where the problems go.

    Returns:
        The scan; each axis has two values, the ends of its range.

    Raises:
        ConfigError: Everything that is wrong with its form.
    """
    choice = document.validate(AdaptiveChoice, ("scan",), called="an adaptive scan").placed("scan")
    if document.data.get("order") is not None:
        what = "'order' is given, but the points are chosen one after another"
        found.add(document.error(("order",), what, "no 'order' beside 'use'", key=True))
    notes: list[str] = []
    groups: list[Group] = []
    ends: list[Ends] = []
    n_points = 1
    for address, range_ in choice.over.items():
        with found:
            own = _ends(document, address, range_.steps or 0)
            axis = _axis(document, address)
            if is_free(axis, fixed, document, notes):
                groups.append((axis,))
                ends.append(own)
    with found:
        refuse_twice([axis for group in groups for axis in group], document.name)
    with found:
        n_points = choice.points or _points_of(document, repeats)
    found.raise_any()
    if not groups:
        raise document.error(("scan", "over"), "nothing is left to choose: options set every address")
    figure = choice.maximise or choice.minimise or ""
    adaptive = Adaptive(choice, tuple(ends), n_points, figure, choice.maximise is not None)
    return Scan(document.name, tuple(groups), repeats, "sequential", tuple(notes), adaptive)


def _ends(document: Document, address: str, n_steps: int) -> Ends:
    loc = ("scan", "over", address)
    nodes = [document.root.at((*loc, key)) for key in ("from", "to")]
    low, high = alike([node for node in nodes if node is not None], document.name)
    if not low.amount < high.amount:
        told = [shown(node.plain(), node.raw) for node in nodes if node is not None]
        what = f"'{clean(address)}' goes from {told[0]} to {told[1]}"
        raise document.error((*loc, "to"), what, "a greatest value above the least")
    mark = document.root.mark_at(loc)
    return Ends(low, high, n_steps, mark if mark.origin else mark._replace(origin=document.name))


def _axis(document: Document, address: str) -> Axis:
    over = document.root.at(("scan", "over"))
    assert over is not None
    values = [over.at((address, key)) for key in ("from", "to")]
    return placed_axis(
        address, over.keys[address], [value for value in values if value is not None], document
    )


def _points_of(document: Document, repeats: int) -> int:
    shots = document.data.get("shots")
    if type(shots) is int and shots >= 1:
        return math.ceil(shots / repeats)
    raise document.error(("scan",), "'points' is missing from 'scan' (the most points)", "a whole number")
