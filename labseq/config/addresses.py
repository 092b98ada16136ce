"""Addresses of settings: in ``--set shot.2.rearrange.window="40 ms"``, scans, expressions and records."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Final, NamedTuple

from labseq.config.yaml_nodes import Node
from labseq.errors import ConfigError, Loc, Problem
from labseq.messages import clean, did_you_mean, listing, shown, visible

PROFILE: Final = "profile."
"""Prefix of addresses in the profile."""
VARIABLES: Final = "variables"
"""Key of the variables, which only expressions use."""
PROFILE_ROLES: Final = ("camera", "static_tweezers", "mobile_tweezers", "detector", "lines", "simulation")
"""The roles of a profile that are each played by one plugin."""
MAY_ADD: Final = ("timeouts", "budgets", "alarms", "calibrations")
"""Keys of the profile whose mappings an override may add."""
NAMED: Final = ("devices",)
"""Mappings of the profile whose keys are names that the user chose."""


class Override(NamedTuple):
    """A value that replaces one in a file.

    Attributes:
        address: For example "planner.degree_of_parallelism".
        value: As typed, YAML.
        origin: The option, for messages. "" means ``--set address=value``.
    """

    address: str
    value: str
    origin: str = ""

    @property
    def source(self) -> str:
        """The place of the value, for messages."""
        text = self.origin or f"--set {self.address}={self.value}"
        return visible(text if len(text) <= 80 else text[:77] + "...")


def split_overrides(options: Sequence[str]) -> tuple[list[Override], list[Override]]:
    """Read the values of ``--set``, split into settings of the sequence and of the profile.

    ``profile=lab`` chooses the sequence's profile. ``profile.camera.gain=5`` sets a value in it.

    Returns:
        The overrides of the sequence, and the overrides of the profile without "profile.".

    Raises:
        ConfigError: A value is not of the form ``address=value``.

    Example:
        >>> split_overrides(["shots=5", "profile.grid.rows=10"])[1][0].address
        'grid.rows'
    """
    if isinstance(options, str) or not all(isinstance(option, str) for option in options):  # pyright: ignore[reportUnnecessaryIsInstance]
        what = f"overrides is {options!r}"
        raise ConfigError(Problem(clean(what), expected="a list of texts such as ['shots=5']"))
    problems: list[Problem] = []
    sequence: list[Override] = []
    profile: list[Override] = []
    for option in options:
        address, equals, value = option.partition("=")
        address = address.strip()
        origin = f"--set {option}"
        if not equals or not all(part.strip() == part != "" for part in address.split(".")):
            what = "this does not have the form address=value"
            example = "for example --set planner.degree_of_parallelism=5"
            problems.append(Problem(what, clean(origin), expected=example))
        elif address.startswith(PROFILE):
            profile.append(Override(address.removeprefix(PROFILE), value, origin))
        else:
            sequence.append(Override(address, value, origin))
    if problems:
        raise ConfigError(problems)
    return sequence, profile


def profile_overrides(options: Sequence[str]) -> list[Override]:
    """Read the values of ``--set`` of a command that uses a profile but no sequence.

    Returns:
        The overrides, without "profile.".

    Raises:
        ConfigError: A value is not of the form ``profile.address=value``.
    """
    others, profile = split_overrides(options)
    if others:
        what = "this command uses no sequence, only a profile"
        hint = "write --set profile.{}=..."
        raise ConfigError(
            [
                Problem(
                    what,
                    o.source,
                    expected="an address that begins with 'profile.'",
                    hint=hint.format(clean(o.address)),
                )
                for o in others
            ]
        )
    return profile


def find(root: Node, address: str, source: str = "", may_add: Collection[str] | None = None) -> Loc:
    """Convert an address to a location in a file. The last key of a mapping need not exist yet.

    With ``may_add``, missing mappings may be created too. At the top of the file these are only the listed
    keys. Further down they can be anywhere except in ``devices``: "faults" of ``camera.faults.transient``.

    A list item with a ``name`` is addressed by it, and the address continues in its
    settings: ``shot.sort.window`` for ``shot.2.rearrange.window``.

    Args:
        source: The option with the address, for messages. "" for none.

    Raises:
        ConfigError: A part of the address does not exist.
    """
    parts = address.split(".")
    loc: Loc = ()
    node: Node | None = root
    for i, part in enumerate(parts):
        here = ".".join(parts[:i])
        if node is None or node.value is None:
            node = None
            loc = (*loc, part)
            continue
        keys = _keys_of_part(node, part)
        child = node.at(keys) if keys else None
        # names in `devices` come from the file, so any other name is a typing error
        new = i == len(parts) - 1 or (
            may_add is not None and (part in may_add if i == 0 else here not in NAMED)
        )
        if child is None and not (new and isinstance(node.value, dict)):
            where = f"'{here}'" if here else clean(root.mark.source)
            raise ConfigError(_missing_part(node, part, where, source))
        loc, node = loc + (keys or (part,)), child
    return loc


def _keys_of_part(node: Node, part: str) -> Loc:
    """The keys and indices of one part of an address, or () if it does not exist."""
    if isinstance(node.value, dict):
        return (part,) if part in node.value else ()
    if not isinstance(node.value, list):
        return ()
    if part.isascii() and part.isdigit():
        return (int(part),) if len(part) < 6 and int(part) < len(node.value) else ()
    for i, item in enumerate(node.value):
        if _item_name(item) == part and isinstance(item.value, dict):
            # a step maps its kind to settings, in which the rest of the address is
            kinds = [key for key in item.value if key != "name"]
            return (i, kinds[0]) if len(kinds) == 1 else (i,)
    return ()


def _missing_part(node: Node, part: str, where: str, source: str) -> Problem:
    """Explain why an address does not exist."""
    if isinstance(node.value, dict):
        keys = list(node.value)
        what = f"there is no '{clean(part)}' in {where}"
        return Problem(what, source, expected=listing(keys), hint=did_you_mean(part, keys))
    if isinstance(node.value, list):
        names = [item for item in map(_item_name, node.value) if item]
        what = f"{where} has no item '{clean(part)}'"
        last = len(node.value) - 1
        indices = f"an index from 0 to {last}" if last > 0 else "the index 0" if last == 0 else "nothing"
        expected = indices + (f" or a name ({', '.join(names)})" if names else "")
        return Problem(what, source, expected=expected, hint=did_you_mean(part, names))
    return Problem(f"{where} is {shown(node.value, node.raw)} and has no '{clean(part)}' in it", source)


def _item_name(item: Node) -> str:
    name = item.child("name")
    return name.value if name is not None and isinstance(name.value, str) else ""
