"""How the parts of the simulated camera say which functions of the SDK they answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeVar

F = TypeVar("F", bound=Callable[..., int])

_MARK: Final = "_labseq_andor_sdk"


@dataclass(frozen=True, slots=True)
class Rule:
    """What holds for a function of the SDK.

    Attributes:
        names: Its name; some functions have several.
        only_idle: It is refused while the camera acquires.
        waits: It waits, so that others must be let through.
    """

    names: tuple[str, ...]
    only_idle: bool = False
    waits: bool = False


@dataclass(frozen=True, slots=True)
class Answer:
    """A function of the SDK.

    Attributes:
        rule: What holds for it.
        call: Takes the arguments of the C function, pointers too, and returns its code.
    """

    rule: Rule
    call: Callable[..., int]


def answers(*names: str, only_idle: bool = False, waits: bool = False) -> Callable[[F], F]:
    """Mark a method as the answer to functions of the SDK."""

    def mark(method: F) -> F:
        setattr(method, _MARK, Rule(names, only_idle, waits))
        return method

    return mark


def names_of(kind: type) -> frozenset[str]:
    """Names of the functions of the SDK that objects of a class answer."""
    rules = [getattr(attribute, _MARK, None) for attribute in vars(kind).values()]
    return frozenset(name for rule in rules if isinstance(rule, Rule) for name in rule.names)


def answers_of(part: object) -> Mapping[str, Answer]:
    """Functions of the SDK that an object answers: name -> answer."""
    found: dict[str, Answer] = {}
    for attribute in vars(type(part)).values():
        rule: Any = getattr(attribute, _MARK, None)
        if isinstance(rule, Rule):
            found |= {name: Answer(rule, attribute.__get__(part)) for name in rule.names}
    return found
