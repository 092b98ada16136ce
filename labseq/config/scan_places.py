"""Where a scan's addresses lead, and whether a scan may change what stands there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from labseq.config.addresses import Override, find
from labseq.config.document import Document
from labseq.config.fields import MAY_ADD
from labseq.config.nodes import Loc, Mark, Node
from labseq.config.scan import PROFILE, Axis
from labseq.config.variables import VARIABLES
from labseq.config.wording import clean, did_you_mean, listing
from labseq.errors import ConfigError, Problem

_SCANNABLE: Final = "an address in 'planner', 'shot.N.<step>', 'variables' or 'profile.<role or device>'"


def placed_axis(address: str, key: Mark, values: Sequence[Node], document: Document) -> Axis:
    """An axis that knows its place in the sequence; one of the profile is bound to it later.

    Args:
        address: The address.
        key: Where it stands.
        values: Its values.
        document: The sequence.

    Raises:
        ConfigError: The address leads nowhere, or to what a scan cannot change.
    """
    placed = _placed(key, document.name)
    axis = Axis(address, (), tuple(_placed_node(value, document.name) for value in values), placed)
    if not axis.of_profile:
        axis = replace(axis, loc=find_axis(document, axis, document.name))
        _check_place(axis, document)
    return axis


def _check_place(axis: Axis, document: Document) -> None:
    """Refuse what a run has only one of."""
    loc = axis.loc
    if loc[0] == "planner":
        return
    if loc[0] == VARIABLES:
        check_variable(axis, document, document.name)
        return
    if loc[0] == "shot" and len(loc) > 2 and loc[2] not in ("name", "policy") and document.root.at(loc[:3]):
        return
    raise unscannable(axis.address, axis.key, document.name)


def check_variable(axis: Axis, document: Document, name: str) -> None:
    """Refuse what is no variable of a file.

    Args:
        axis: The axis.
        document: The file.
        name: The sequence's name in messages.

    Raises:
        ConfigError: It is none.
    """
    if len(axis.loc) != 2 or document.root.at(axis.loc) is None:
        known = list(document.data.get(VARIABLES) or {})
        what = f"there is no variable '{clean(axis.address)}'"
        hint = did_you_mean(str(axis.loc[-1]), known)
        raise ConfigError(axis.key.problem(name, what, listing(known) if known else "'variables'", hint))


def unscannable(address: str, key: Mark, name: str) -> ConfigError:
    """Say that a scan cannot change what an address leads to."""
    return ConfigError(key.problem(name, f"a scan cannot change '{clean(address)}'", _SCANNABLE))


def find_axis(document: Document, axis: Axis, name: str) -> Loc:
    """Where an address leads; errors are placed at the scan's key."""
    try:
        return find(document.root, axis.address.removeprefix(PROFILE), document.name, "", MAY_ADD)
    except ConfigError as error:
        problems = [axis.key.problem(name, p.what, p.expected, p.hint) for p in error.problems]
        raise ConfigError(problems) from None


def is_free(axis: Axis, fixed: Sequence[Override], document: Document, notes: list[str]) -> bool:
    """Whether no option sets the value that the axis would change."""
    for override in fixed:
        other = _loc_of(override.address, document)
        own: Loc = tuple(axis.address.split(".")) if axis.of_profile else axis.loc
        if other and other == own[: len(other)]:
            notes.append(f"{override.source} replaces the scan of '{clean(axis.address)}'")
            return False
        if own and own == other[: len(own)]:
            what = f"the scan changes the whole of '{clean(axis.address)}'"
            raise ConfigError(Problem(what, override.source, expected=f"--set {clean(axis.address)}=..."))
    return True


def _loc_of(address: str, document: Document) -> Loc:
    if address.startswith(PROFILE):
        return tuple(address.split("."))
    try:
        return find(document.root, address, document.name, "")
    except ConfigError:  # told already, where it was applied
        return ()


def refuse_twice(axes: Sequence[Axis], name: str) -> None:
    """Refuse two addresses of which one holds the other."""
    for i, axis in enumerate(axes):
        for other in axes[:i]:
            n = min(len(axis.loc), len(other.loc))
            if n and axis.of_profile == other.of_profile and axis.loc[:n] == other.loc[:n]:
                own, others = clean(axis.address), clean(other.address)
                what = f"'{own}' is scanned, and so is '{others}', which holds the same value"
                raise ConfigError(axis.key.problem(name, what, "each value in one place of the scan"))


def _placed(mark: Mark, name: str) -> Mark:
    """A mark that keeps its file when its value goes into another one."""
    return mark if mark.origin else mark._replace(origin=name)


def _placed_node(node: Node, name: str) -> Node:
    value = node.value
    if isinstance(value, list):
        value = [_placed_node(child, name) for child in value]
    elif isinstance(value, dict):
        value = {key: _placed_node(child, name) for key, child in value.items()}
    keys = {key: _placed(mark, name) for key, mark in node.keys.items()}
    return replace(node, value=value, mark=_placed(node.mark, name), keys=keys)
