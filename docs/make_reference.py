"""The generated parts of the pages, which ``conf.py`` puts where a page has the comment ``reference: ...``.

They are Markdown like the rest of the page; what they contain is in ``labseq.scaffold.reference``. The
comment names the part and its arguments: ``settings profile grid``, ``plugins camera``, ``command run``.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import textwrap
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from inspect import signature
from pathlib import Path
from typing import Any, Final

import typer

import labseq
from labseq import builtin
from labseq.cli.app import app
from labseq.data.shot import Shot
from labseq.errors import LabseqError, Problem
from labseq.model.policies import StepPolicy
from labseq.plugins.host import ENTRY_POINT_GROUP, PluginHost
from labseq.registry import Registry
from labseq.roles import ROLES
from labseq.scaffold import python_reference, reference
from labseq.scaffold.reference import Block, Code, Definition, Table, definition, docstring, summary
from labseq.settings import models_at
from labseq.testing import SUITES, fakes, strategies
from labseq.testing.contracts import HardwareContract

DOCS: Final = Path(__file__).parent
PART: Final = re.compile(r"<!-- reference: (.+?) -->")
"""The place of a generated part on a page: the part's name and arguments."""
PROGRAM: Final[Any] = typer.main.get_command(app)

_GIVEN: Final = {"self", "device", "shape", "seed", "kind", "duration_s"}
"""Arguments of what a plugin's test may override; methods with others serve the suite itself."""


def complete(page: str) -> str:
    """The text of a page with its generated parts."""
    return PART.sub(lambda part: text_of(part[1]), page)


def text_of(part: str) -> str:
    """The Markdown of a part.

    Raises:
        LookupError: There is no such part.
    """
    name, *arguments = part.split()
    return markdown(PARTS[name](*arguments))


def markdown(blocks: Iterable[Block]) -> str:
    """Blocks as a part of a page."""
    return "\n\n".join(map(_markdown, blocks))


def _markdown(block: Block) -> str:
    if isinstance(block, Table):
        lines = [block.header, ["---"] * len(block.header), *block.rows]
        cells = [[cell.replace("|", r"\|") for cell in line] for line in lines]
        return "\n".join(f"| {' | '.join(line)} |" for line in cells)
    if isinstance(block, Definition):
        return f"- `{block.term}`\n\n{textwrap.indent(block.text, '  ')}"
    return block if isinstance(block, str) else f"```{block.language}\n{block.text}\n```"


@cache
def registry() -> Registry:
    """What labseq's own plugins offer: not what happens to be installed beside them."""
    host = PluginHost()
    host.load_builtin(builtin)
    project = tomllib.loads((DOCS.parent / "pyproject.toml").read_text("utf-8"))
    for module in project["project"]["entry-points"][ENTRY_POINT_GROUP].values():
        host.load_builtin(importlib.import_module(module))
    return host.registry


def settings(kind: str, *names: str) -> list[Block]:
    """The keys of a file, of a part of it, or of a plugin; "top" leaves out those of its parts."""
    if kind in ROLES:
        return [reference.settings(registry().get(kind, *names).settings_model)]
    keys = [name for name in names if name != "top"]
    return [file_settings(kind, *keys, top="top" in names)]


def file_settings(kind: str, *names: str, top: bool = False) -> Block:
    """The keys of a file, or of the mapping of one of its keys.

    Raises:
        LookupError: There is no such key, or it has no keys of its own.
    """
    found = [StepPolicy] if names == ("shot", "policy") else models_at(reference.FILES[kind], names)
    if len(found) != 1 or (names and found == [reference.FILES[kind]]):
        raise LookupError(f"'{' '.join((kind, *names))}' has no keys of its own")
    return reference.settings(found[0], top=top)


def command(*names: str) -> list[Block]:
    """A command; without a name, the options of all."""
    found = dict(reference.commands_below(PROGRAM))[names] if names else PROGRAM
    return reference.command(names, found)


def contract(kind: str) -> list[Block]:
    """A suite: what a plugin's test passes to it, and a row for each promise of its own."""
    suite = {**SUITES, "hardware": HardwareContract}[kind]
    own = [one for one in _members(suite) if one.__name__ not in _inherited(suite)]
    hooks = [one for one in own if not hasattr(one, "promise") and {*signature(one).parameters} <= _GIVEN]
    rows = [(one.promise, f"`{one.__name__}`", summary(one)) for one in own if hasattr(one, "promise")]
    blocks: list[Block] = [f"`{suite.__name__}`", docstring(suite)]
    blocks += ["May be overridden:", *map(definition, hooks)] if hooks else []
    return [*blocks, Table(("promise", "test", "tried"), rows)]


def _members(suite: type[Any]) -> list[Any]:
    """Public methods in the order of the source, those of its own first."""
    found: dict[str, Any] = {}
    for of in suite.__mro__:
        for name, one in vars(of).items():
            if inspect.isfunction(one) and not name.startswith("_") and name != "factory":
                found.setdefault(name, one)
    return list(found.values())


def _inherited(suite: type[Any]) -> set[str]:
    """What another suite is documented with: the promises of all hardware."""
    if suite is HardwareContract or not issubclass(suite, HardwareContract):
        return set()
    return {one.__name__ for one in _members(HardwareContract)}


def strategy_list() -> list[Block]:
    """A definition per hypothesis strategy."""
    found = reference.public(strategies, inspect.isfunction)
    return [definition(one) for one in found if one.__module__ == strategies.__name__]


def fake_list() -> list[Block]:
    """A row per fake."""
    return [python_reference.summaries("name", {name: getattr(fakes, name) for name in fakes.__all__})]


def class_members(name: str) -> list[Block]:
    """A public class of labseq, with its attributes and methods."""
    kind = Shot if name == "Shot" else getattr(labseq, name)
    return python_reference.class_reference(kind)


def source(path: str, name: str = "") -> list[Block]:
    """A Python file of the repository, or one class of it."""
    text = (DOCS.parent / path).read_text("utf-8")
    if name:
        found = next(one for one in ast.parse(text).body if getattr(one, "name", "") == name)
        text = ast.get_source_segment(text, found) or ""
    return [Code("python", text.rstrip())]


def role(name: str) -> list[Block]:
    """A role and its methods."""
    return reference.role(reference.roles_by_name()[name])


def plugins(kind: str) -> list[Block]:
    """A section for each plugin of a kind."""
    blocks: list[Block] = []
    for entry in (one for one in registry().entries() if one.kind == kind):
        title = f"### {kind.replace('_', ' ').capitalize()} `{entry.name}`"
        blocks += [title, *reference.entry_blocks(entry)]
    return blocks or [f"labseq itself brings no {kind}."]


def registry_methods() -> list[Block]:
    """A definition for each method by which a plugin offers something."""
    return [definition(getattr(Registry, kind), name=f"registry.{kind}") for kind in ROLES]


def error_list() -> list[Block]:
    """A definition per error, in the order of the tree, and of the problems that they hold."""
    return [
        *map(reference.error, reference.errors_by_name().values()),
        Definition(Problem.__name__, docstring(Problem)),
    ]


def error_tree() -> list[Block]:
    """Every error below the one that it is a kind of."""
    return [Code("text", "\n".join(_branch(LabseqError, "")))]


def _branch(found: type[LabseqError], indent: str) -> Iterator[str]:
    others = [b.__name__ for b in found.__bases__ if not issubclass(b, LabseqError) and b is not Exception]
    yield f"{indent}{found.__name__}" + (f" (also a {', '.join(others)})" if others else "")
    for kind in reference.kinds_of(found):
        yield from _branch(kind, f"{indent}    ")


def attributes() -> list[Block]:
    """A row per attribute: those of every dataset first."""
    from labseq.recording import contents

    rows = [("every dataset", f"`{name}`", "text", about) for name, about in contents.EVERYWHERE.items()]
    for path, found in contents.attributes().items():
        rows += [(f"`{path}`", f"`{name}`", kind, about) for name, (kind, about) in found.items()]
    return [Table(("of", "attribute", "type", "description"), rows)]


PARTS: Final[Mapping[str, Callable[..., list[Block]]]] = {
    "settings": settings,
    "plugins": plugins,
    "command": command,
    "role": role,
    "contract": contract,
    "strategies": strategy_list,
    "fakes": fake_list,
    "class": class_members,
    "scripts": python_reference.scripts,
    "names": python_reference.names,
    "source": source,
    "environment": reference.environment,
    "units": reference.units,
    "registry": registry_methods,
    "hooks": reference.hooks,
    "errors": error_list,
    "error-tree": error_tree,
    "exit-codes": reference.exit_codes,
    "plan-rules": reference.plan_rules,
    "events": reference.events,
    "quantities": reference.quantities,
    "datasets": reference.datasets,
    "columns": reference.columns,
    "attributes": attributes,
    "index": reference.index_keys,
    "words": reference.words,
}
"""Name of a part -> makes it."""
