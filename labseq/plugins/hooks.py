"""What a module must have to be a plugin, told in plainer words than pluggy's."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from inspect import signature
from types import ModuleType
from typing import Any, Final, cast

from labseq import hookspecs
from labseq.errors import one_of
from labseq.hookspecs import LABSEQ_API
from labseq.registry import Owner

_MARK: Final = "labseq_impl"  # what ``hookimpl`` puts on a function
_HOOKS: Final = [key for key, value in vars(hookspecs).items() if hasattr(value, "labseq_spec")]
_NO_FUNCTION: Final = (
    (inspect.iscoroutinefunction, "an 'async' function"),
    (inspect.isgeneratorfunction, "a generator"),
    (inspect.isasyncgenfunction, "a generator"),
)

Hooks = dict[str, Callable[..., object]]


def check_api(module: ModuleType, owner: Owner) -> None:
    """Refuse a plugin that was written for another labseq.

    Raises:
        PluginLoadError: With what to do.
    """
    written_for: object = getattr(module, "LABSEQ_API", None)
    if type(written_for) is int and written_for == LABSEQ_API:
        return
    here = f"this labseq has LABSEQ_API = {LABSEQ_API}"
    if written_for is None:
        remedy = f"write 'LABSEQ_API = {LABSEQ_API}' at its top"
        raise owner.fault(f"it does not state LABSEQ_API; {here}; {remedy}")
    came = f"it was written for LABSEQ_API {written_for!r:.100}"
    if type(written_for) is not int:
        raise owner.fault(f"{came}, which is no whole number; {here}")
    remedy = "update labseq, or take an older version of the plugin"
    if written_for < LABSEQ_API:
        remedy = "take a newer version of the plugin, or adapt it (the changelog tells what has changed)"
    raise owner.fault(f"{came}; {here}; {remedy}")


def hooks_of(module: ModuleType, owner: Owner) -> Hooks:
    """The hooks that a plugin implements.

    Raises:
        PluginLoadError: It implements none, or one that labseq would not call as meant; with what to change.
    """
    hooks: Hooks = {}
    unmarked: list[str] = []
    for attribute, value in vars(module).items():
        options = getattr(value, _MARK, None)
        if isinstance(options, dict):
            given = cast("dict[str, Any]", options)
            if given.get("wrapper") or given.get("hookwrapper"):
                raise owner.fault(f"its {attribute} is a wrapper; write '@hookimpl' without options")
            hooks[given.get("specname") or attribute] = value
        elif attribute in _HOOKS and inspect.isfunction(value):
            unmarked.append(attribute)
    if not hooks:
        raise owner.fault("it implements no hook; write '@hookimpl' above 'def labseq_register'")
    if unmarked:
        raise owner.fault(f"its {unmarked[0]} would not be called; write '@hookimpl' above it")
    for key, function in hooks.items():
        _check_hook(key, function, owner)
    return hooks


def _check_hook(key: str, function: Callable[..., object], owner: Owner) -> None:
    if key not in _HOOKS:
        raise owner.fault(f"it implements the unknown hook '{key}'; expected {one_of(_HOOKS)}")
    for is_it, called in _NO_FUNCTION:
        if is_it(function):
            raise owner.fault(f"its {key} is {called} and would never run; expected a plain function")
    known = signature(getattr(hookspecs, key)).parameters
    given = signature(function).parameters
    if unknown := [argument for argument in given if argument not in known]:
        raise owner.fault(f"its {key} has an argument '{unknown[0]}'; expected {one_of(list(known))}")
    if key == "labseq_register" and not given:
        raise owner.fault(f"its {key} has no argument; expected {one_of(list(known))}")
