"""The reference for Python code: public names, classes with their attributes, contract suites.

The suites of :mod:`labseq.testing` need pytest, which few computers of a lab have, so they are read from
their source.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator, Mapping
from functools import cached_property, partial
from pathlib import Path
from types import FunctionType, SimpleNamespace
from typing import Any, Final

import labseq
from labseq.data.shot import Shot
from labseq.errors import LabseqError
from labseq.scaffold.reference import Block, Definition, Table, Topic, definition
from labseq.scaffold.words import docstring, summary

SCRIPTS: Final = (
    "open_run",
    "serve",
    "make_planner",
    "make_target",
    "check_plan",
    "tone_program",
    "render",
    "as_occupancy",
)
"""Functions that scripts and notebooks call."""
_ALIASES: Final = {
    "Occupancy": "a boolean array (rows, columns), True for sites with an atom",
}
"""Names whose docstring is not their own."""
_CONTRACTS: Final = Path(labseq.__file__).parent / "testing" / "contracts"


def scripts() -> list[Block]:
    """A definition for each function that scripts call."""
    return [definition(getattr(labseq, name), name=f"labseq.{name}") for name in SCRIPTS]


def names() -> list[Block]:
    """All public names in a table."""
    public = sorted(name for home in vars(labseq)["_HOMES"].values() for name in home)
    return [summaries("`labseq.`", {name: getattr(labseq, name) for name in public})]


def summaries(title: str, objects: Mapping[str, Any]) -> Table:
    """A row per object, with its name and the first line of its docstring."""
    rows = [(f"`{name}`", _about(name, item)) for name, item in objects.items()]
    return Table((title, "what it is"), rows)


def class_reference(kind: type[Any]) -> list[Block]:
    """The docstring of a class, a row per property, and a definition per public method."""
    rows: list[tuple[str, ...]] = []
    methods: list[Block] = []
    for name in _public(kind):
        member = inspect.getattr_static(kind, name)
        if isinstance(member, classmethod | staticmethod) or inspect.isfunction(member):
            methods.append(definition(getattr(kind, name), name=f"{kind.__name__}.{name}"))
        else:
            getter = _getter(member)
            returned = str(inspect.signature(getter).return_annotation).replace("'", "")
            rows.append((f"`{name}`", f"`{returned}`", summary(getter)))
    attributes: list[Block] = [Table(("attribute", "type", "what it is"), rows)] if rows else []
    return [docstring(kind), *attributes, *methods]


def _public(kind: type[Any]) -> Iterator[str]:
    """Names of the methods and properties of a class and its bases, in the order of the source."""
    described = (FunctionType, property, cached_property, classmethod, staticmethod)
    found: dict[str, None] = {}
    for base in reversed(kind.__mro__[:-1]):
        found |= {
            name: None for name, item in vars(base).items() if name[0] != "_" and isinstance(item, described)
        }
    return iter(found)


def _getter(member: property | cached_property[Any]) -> Any:
    return member.fget if isinstance(member, property) else member.func


def contract(name: str) -> list[Block]:
    """The docstring of a contract suite, and a row for each of its own promises."""
    module, suite = dict(_suites())[name]
    bases = [base.id for base in suite.bases if isinstance(base, ast.Name)]
    inherited = [f"The promises of `{', '.join(bases)}`, and:"] if bases else []
    rows = list(_promises(suite, module))
    text = docstring(SimpleNamespace(__doc__=ast.get_docstring(suite)))
    return [Definition(name, text), *inherited, Table(("test", "promise"), rows)]


def _promises(suite: ast.ClassDef, module: ast.Module) -> Iterator[tuple[str, str]]:
    """The test and the text of each promise, which may be a constant of the module."""
    constants = {
        node.target.id: node.value
        for node in module.body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    for function in (node for node in suite.body if isinstance(node, ast.FunctionDef)):
        for call in function.decorator_list:
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "promise":
                text = call.args[0]
                value = constants.get(text.id) if isinstance(text, ast.Name) else text
                yield f"`{function.name}`", ast.literal_eval(value or text)


def _suites() -> Iterator[tuple[str, tuple[ast.Module, ast.ClassDef]]]:
    for file in sorted(_CONTRACTS.glob("*.py")):
        module = ast.parse(file.read_text("utf-8"))
        for node in module.body:
            if isinstance(node, ast.ClassDef) and node.name.endswith("Contract"):
                yield node.name, (module, node)


def python_topics() -> dict[str, Topic]:
    """Public names and contract suites, by "python NAME" and "contract NAME"."""
    topics: dict[str, Topic] = {}
    for name in sorted(vars(labseq)["_HOME_OF"]):
        item = getattr(labseq, name)
        if inspect.isfunction(item):
            topics[f"python {name}"] = Topic(_about(name, item), partial(_one, item))
        elif inspect.isclass(item) and not issubclass(item, LabseqError):
            topics[f"python {name}"] = Topic(_about(name, item), partial(class_reference, item))
    topics["python Shot"] = Topic(summary(Shot), partial(class_reference, Shot))
    for name, (_, suite) in _suites():
        about = (ast.get_docstring(suite) or "").split("\n")[0]
        topics[f"contract {name}"] = Topic(about.removesuffix("."), partial(contract, name))
    return topics


def _one(function: Any) -> list[Block]:
    return [definition(function, name=f"labseq.{function.__name__}")]


def _about(name: str, item: Any) -> str:
    return _ALIASES.get(name) or summary(item).removesuffix(".")
