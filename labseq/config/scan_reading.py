"""``scan:`` in a sequence file, read and checked.

What is checked here is the scan's own form. Whether a plugin accepts a value is
checked where the plugins are known, in ``labseq.session.scan``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from labseq.config.adaptive_reading import is_adaptive, read_adaptive
from labseq.config.addresses import Override
from labseq.config.collect import ProblemCollector
from labseq.config.document import Document
from labseq.config.fields import ROLES
from labseq.config.nodes import Mark, Node
from labseq.config.scan import Axis, Group, Scan, ScanOrder
from labseq.config.scan_places import check_variable, find_axis, is_free, placed_axis, refuse_twice, unscannable
from labseq.config.scan_values import MAX_POINTS, values_of
from labseq.config.variables import VARIABLES
from labseq.config.wording import clean, shown
from labseq.errors import ConfigError

_MEANT: Final = "a mapping of addresses and their values, or a list of such mappings"


def read_scan(document: Document, fixed: Sequence[Override] = ()) -> Scan | None:
    """Read ``scan``, ``repeats`` and ``order`` of a sequence.

    Args:
        document: The sequence, overrides included.
        fixed: The overrides, those of the profile with their "profile."; an axis that one of
            them sets is left out, since ``--set`` wins.

    Returns:
        The scan, its profile axes not yet bound; None if the sequence has none.

    Raises:
        ConfigError: Everything that is wrong with its form.
    """
    found = ProblemCollector()
    node = document.root.child("scan")
    repeats, order = _options(document, has_scan=node is not None and node.value is not None, found=found)
    if node is not None and is_adaptive(node):
        return read_adaptive(document, repeats, fixed, found)
    groups: list[Group] = []
    notes: list[str] = []
    if node is not None and node.value is not None:
        for items in _mappings(node, document.name, found):
            group = tuple(
                axis for axis in _axes(items, document, found) if is_free(axis, fixed, document, notes)
            )
            with found:
                _check_together(group, document.name)
            groups += [group] if group else []
    if not found.problems:
        with found:
            refuse_twice([axis for group in groups for axis in group], document.name)
    found.raise_any()
    if node is None or node.value is None:
        return None
    scan = Scan(document.name, tuple(groups), repeats, order, tuple(notes))
    if scan.n_points > MAX_POINTS:
        shape = " x ".join(map(str, scan.shape))
        what = f"the scan has {shape} = {scan.n_points} points"
        raise ConfigError(node.mark.problem(document.name, what, f"at most {MAX_POINTS}"))
    return scan


def bind_scan(scan: Scan, document: Document) -> Scan:
    """A copy whose profile axes know their places in the profile.

    Args:
        scan: The scan as it was read.
        document: The profile's file.

    Raises:
        ConfigError: Addresses that lead nowhere in it, or to what a scan cannot change.
    """
    found = ProblemCollector()

    def bound(axis: Axis) -> Axis:
        if not axis.of_profile:
            return axis
        with found:
            loc = find_axis(document, axis, scan.name)
            if loc[0] == VARIABLES:
                check_variable(replace(axis, loc=loc), document, scan.name)
            elif not (loc[0] in ROLES or (loc[0] == "devices" and len(loc) > 1)):
                raise unscannable(axis.address, axis.key, scan.name)
            return replace(axis, loc=loc)
        return axis

    groups = tuple(tuple(bound(axis) for axis in group) for group in scan.groups)
    found.raise_any()
    refuse_twice([axis for group in groups for axis in group if axis.of_profile], scan.name)
    return replace(scan, groups=groups)


def _options(document: Document, *, has_scan: bool, found: ProblemCollector) -> tuple[int, ScanOrder]:
    """``repeats`` and ``order``, which belong to a scan; 1 and "sequential" where they are wrong."""
    values: dict[str, Any] = {}
    for key in ("repeats", "order"):
        value = document.data.get(key)
        if value is None:
            continue
        if not has_scan:
            found.add(
                document.error((key,), f"'{key}' is given without a scan", "a 'scan' beside it", key=True)
            )
        values[key] = value
    repeats = values.get("repeats", 1)
    is_number = type(repeats) is int and repeats >= 1  # what else it is, the model of the file says
    shuffled = values.get("order") == "shuffled"
    return repeats if is_number else 1, "shuffled" if shuffled else "sequential"


def _mappings(node: Node, name: str, found: ProblemCollector) -> list[dict[str, tuple[Mark, Node]]]:
    """The groups as written: address -> its place and values."""
    items = node.value if isinstance(node.value, list) else [node]
    groups: list[dict[str, tuple[Mark, Node]]] = []
    if not items:
        found.add(ConfigError(node.mark.problem(name, "scan is empty", _MEANT)))
    for item in items:
        if not isinstance(item.value, dict) or not item.value:
            called = "scan" if item is node else "a group of the scan"
            came = "empty" if item.value == {} else shown(item.plain(), item.raw)
            found.add(ConfigError(item.mark.problem(name, f"{called} is {came}", _MEANT)))
            continue
        written = {address: (item.keys[address], values) for address, values in item.value.items()}
        # In a mapping each address is a group of its own; in a list each mapping is a group.
        groups += [{address: one} for address, one in written.items()] if item is node else [written]
    return groups


def _axes(written: Mapping[str, tuple[Mark, Node]], document: Document, found: ProblemCollector) -> list[Axis]:
    axes: list[Axis] = []
    for address, (key, node) in written.items():
        with found:
            values = values_of(node, address, document.name)
            axes.append(placed_axis(address, key, values, document))
    return axes


def _check_together(group: Sequence[Axis], name: str) -> None:
    """Refuse a group whose axes differ in length, and one position that stands twice in it."""
    for axis in group[1:]:
        n, n_first = len(axis.values), len(group[0].values)
        if n != n_first:
            own, first = clean(axis.address), clean(group[0].address)
            own_values = "1 value" if n == 1 else f"{n} values"
            what = f"'{own}' has {own_values}, but '{first}' in its group has {n_first}"
            hint = "for every combination, make each a group of its own"
            raise ConfigError(axis.key.problem(name, what, "as many", hint))
    seen: set[str] = set()
    for i, node in enumerate(group[0].values if group else ()):
        position = json.dumps([axis.values[i].plain() for axis in group])
        if position in seen:
            what = f"{shown(node.plain(), node.raw)} stands twice in the scan of '{clean(group[0].address)}'"
            raise ConfigError(
                node.mark.problem(name, what, "each value once", "write 'repeats' for more shots")
            )
        seen.add(position)
