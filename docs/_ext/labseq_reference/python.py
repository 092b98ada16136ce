"""Hooks, roles and errors as Markdown, from their docstrings."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from signal import SIGINT, SIGTERM
from typing import Any

from labseq import errors, hookspecs, roles
from labseq.console.errors import exit_code_of
from labseq.errors import LabseqError, StopRequested
from labseq.motion import RULES
from labseq_reference import prose
from labseq_reference.tables import table


def hooks() -> list[str]:
    """A definition per hook."""
    return [line for hook in public(hookspecs, inspect.isfunction) for line in definition(hook)]


def role(name: str) -> list[str]:
    """What a role is, and a definition per method.

    Raises:
        LookupError: There is no such role.
    """
    protocols = {one.__name__: one for one in public(roles, inspect.isclass)}
    if name not in protocols:
        raise LookupError(f"'{name}' is not one of {', '.join(protocols)}")
    found = protocols[name]
    shared = [base.__name__ for base in found.__bases__ if base.__name__ in protocols]
    lines = prose.markdown(found).splitlines()
    if shared:
        lines += ["", f"All that `{', '.join(shared)}` asks for, and:"]
    for member in vars(found).values():
        function = member.fget if isinstance(member, property) else member
        if inspect.isfunction(function) and not function.__name__.startswith("_"):
            lines += ["", *definition(function, is_value=isinstance(member, property))]
    return lines


def error_tree() -> list[str]:
    """Every error below the one that it is a kind of."""
    return ["```text", *_branch(LabseqError, ""), "```"]


def error_list() -> list[str]:
    """A definition per error, in the order of the tree."""
    lines: list[str] = []
    for error in walk(LabseqError):
        text = f"{prose.markdown(error)}\n\nExit code {_exit_code(error)}."
        lines += [f"`{error.__name__}`", *_indented(text), ""]
    return [*lines, f"`{errors.Problem.__name__}`", *_indented(prose.markdown(errors.Problem))]


def plan_rules() -> list[str]:
    """The rules that every plan is checked against."""
    return table(("rule", "meaning"), [(f"`{name}`", meaning) for name, meaning in RULES.items()])


def walk(error: type[LabseqError]) -> Iterator[type[LabseqError]]:
    """An error and all its kinds, in the order of the source."""
    yield error
    for kind in _kinds(error):
        yield from walk(kind)


def public(module: Any, is_kind: Callable[[object], bool]) -> list[Any]:
    """What a module, or a package with its modules, defines for others, in the order of the source."""
    found = [one for name, one in vars(module).items() if is_kind(one) and not name.startswith("_")]
    home = module.__name__
    return [one for one in found if one.__module__ == home or one.__module__.startswith(f"{home}.")]


def _exit_code(error: type[LabseqError]) -> str:
    if error is StopRequested:
        return " or ".join(str(exit_code_of(StopRequested(number))) for number in (SIGINT, SIGTERM))
    return str(error.exit_code)


def _kinds(error: type[LabseqError]) -> list[type[LabseqError]]:
    return [kind for kind in error.__subclasses__() if kind.__module__ == errors.__name__]


def _branch(error: type[LabseqError], indent: str) -> Iterator[str]:
    others = [b.__name__ for b in error.__bases__ if not issubclass(b, LabseqError) and b is not Exception]
    yield f"{indent}{error.__name__}" + (f" (also a {', '.join(others)})" if others else "")
    for kind in _kinds(error):
        yield from _branch(kind, f"{indent}    ")


def definition(function: Callable[..., Any], *, is_value: bool = False, name: str = "") -> list[str]:
    """How a function is called, and its docstring.

    Args:
        function: A function or method.
        is_value: Whether it is a property.
        name: What it is called by, where that is not its own name.
    """
    text = _signature(function).replace(function.__name__, name or function.__name__, 1)
    if is_value:
        text = f"{function.__name__}: {text.partition(' -> ')[2]}"
    return [f"`{text}`", *_indented(prose.markdown(function)), ""]


def _signature(function: Callable[..., Any]) -> str:
    signature = inspect.signature(function)
    arguments = [one for name, one in signature.parameters.items() if name != "self"]
    text = str(signature.replace(parameters=arguments)).replace("'", "").replace("Ellipsis", "...")
    return function.__name__ + text.removesuffix(" -> None")


def _indented(text: str) -> list[str]:
    """The body of a definition."""
    first, *rest = text.splitlines()
    return [f": {first}", *(f"  {line}" if line else "" for line in rest)]
