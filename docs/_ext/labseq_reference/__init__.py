"""Directives that write the reference from labseq's models, commands and docstrings.

Each makes Markdown, which the page's own parser then reads:

- ``{settings} sequence``, ``{settings} profile grid``, ``{settings} pattern kagome``:
  the keys of a file, of a part of it (``:top:`` leaves out the keys of its parts),
  or of what is registered
- ``{registered} planner``: everything that is registered for a role, with its keys
- ``{quantities}``: the quantities and their units
- ``{command} run``, ``{command} bench planners``: one command; without a name, the options of all
- ``{shot-file} datasets``, ``columns``, ``attributes``, ``index``: what a shot's file and the index hold
- ``{registry}``, ``{scripts}``, ``{names}``: how plugins offer things, what scripts call, all public names
- ``{contract} camera``, ``{strategies}``, ``{fakes}``: what ``labseq.testing`` has for plugins
- ``{hooks}``, ``{role} Camera``, ``{errors}``, ``{error-tree}``, ``{plan-rules}``
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

from docutils import nodes
from docutils.parsers.rst import directives
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from labseq_reference import commands, namespace, python, shot_file, tables, testing


class _Generated(SphinxDirective):
    """Replaced by the Markdown that it makes."""

    def run(self) -> list[nodes.Node]:
        try:
            lines = self.lines()
        except LookupError as error:
            raise self.error(str(error)) from None
        parent = nodes.Element()
        self.state.nested_parse(StringList(lines, source=__file__), 0, parent, match_titles=True)
        return parent.children

    def lines(self) -> list[str]:
        raise NotImplementedError


class _Settings(_Generated):
    required_arguments = 1
    optional_arguments = 2
    option_spec: ClassVar = {"top": directives.flag}

    def lines(self) -> list[str]:
        return tables.settings_table(*self.arguments, top="top" in self.options)


class _Registered(_Generated):
    required_arguments = 1

    def lines(self) -> list[str]:
        return tables.registered(*self.arguments)


class _Command(_Generated):
    optional_arguments = 2

    def lines(self) -> list[str]:
        return commands.describe(*self.arguments)


class _Role(_Generated):
    required_arguments = 1

    def lines(self) -> list[str]:
        return python.role(*self.arguments)


class _Contract(_Generated):
    required_arguments = 1

    def lines(self) -> list[str]:
        return testing.contract(*self.arguments)


class _ShotFile(_Generated):
    required_arguments = 1

    def lines(self) -> list[str]:
        return shot_file.part(*self.arguments)


def _plain(make: Callable[[], list[str]]) -> type[_Generated]:
    """A directive without arguments."""

    class Plain(_Generated):
        def lines(self) -> list[str]:
            return make()

    return Plain


def setup(app: Sphinx) -> dict[str, Any]:
    """Add the directives."""
    app.add_directive("settings", _Settings)
    app.add_directive("registered", _Registered)
    app.add_directive("quantities", _plain(tables.quantities_table))
    app.add_directive("command", _Command)
    app.add_directive("role", _Role)
    app.add_directive("shot-file", _ShotFile)
    app.add_directive("contract", _Contract)
    app.add_directive("strategies", _plain(testing.strategy_list))
    app.add_directive("fakes", _plain(testing.fake_list))
    app.add_directive("hooks", _plain(python.hooks))
    app.add_directive("registry", _plain(namespace.registry))
    app.add_directive("scripts", _plain(namespace.scripts))
    app.add_directive("names", _plain(namespace.names))
    app.add_directive("errors", _plain(python.error_list))
    app.add_directive("error-tree", _plain(python.error_tree))
    app.add_directive("plan-rules", _plain(python.plan_rules))
    return {"parallel_read_safe": True}
