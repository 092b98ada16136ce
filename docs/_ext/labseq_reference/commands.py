"""Commands of the command line as Markdown."""

from __future__ import annotations

import re
from typing import Any

import typer

from labseq.cli.app import app
from labseq_reference.tables import table

_LIMIT = re.compile(r"x(>=|<=|>|<)(\S+)")
_LIMIT_WORDS = {">=": "at least", "<=": "at most", ">": "more than", "<": "less than"}


def describe(*names: str) -> list[str]:
    """Usage, arguments, options and examples of a command.

    Args:
        *names: "run"; "bench", "planners"; none for the options of all commands.

    Raises:
        LookupError: There is no such command.
    """
    command = command_of(*names)
    arguments = [one for one in command.params if one.param_type_name == "argument"]
    options = [one for one in command.params if one.param_type_name == "option"]
    usage = ["labseq", *names, *map(argument_name, arguments)]
    usage += (["COMMAND", "..."] if is_group(command) else []) + (["[OPTIONS]"] if options else [])
    lines = ["```text", " ".join(usage), "```", "", command.help, ""]
    classes = ("command", "-".join(names)) if names else ("command",)
    for title, spell, found in (("argument", argument_name, arguments), ("option", option_name, options)):
        rows = [(f"`{spell(one)}`", _meaning(command, one)) for one in found]
        lines += [*table((title, "meaning"), rows, classes), ""] if rows else []
    examples = [line.strip() for line in (command.epilog or "").splitlines() if "labseq " in line]
    return [*lines, "```console", *examples, "```"] if examples else lines


def command_of(*names: str) -> Any:
    """A command as typer sees it; the whole program if none is named.

    Raises:
        LookupError: There is no such command.
    """
    command: Any = typer.main.get_command(app)
    for name in names:
        known = command.commands if is_group(command) else {}
        if name not in known:
            raise LookupError(f"'{name}' is not one of {', '.join(known) or 'none'}")
        command = known[name]
    return command


def is_group(command: Any) -> bool:
    """Whether it only leads to other commands."""
    return hasattr(command, "commands")


def argument_name(argument: Any) -> str:
    """An argument as the usage line shows it, in brackets if it may be left out."""
    name = (argument.metavar or argument.name).strip("[]{}").upper()
    return name if argument.required else f"[{name}]"


def option_name(option: Any) -> str:
    """All spellings of an option, and what follows it."""
    spellings = ", ".join(sorted([*option.opts, *option.secondary_opts], key=len))
    if option.is_flag or option.count:
        return spellings
    value = option.metavar or "VALUE"
    return spellings + value if value.startswith("[=") else f"{spellings} {value}"


def _meaning(command: Any, parameter: Any) -> str:
    """The help with its limits and default in words."""
    text: str = parameter.get_help_record(typer.Context(command))[1]
    text, _, extra = text.rstrip("]").partition("  [")
    for one in filter(None, extra.split("; ")):
        if limit := _LIMIT.fullmatch(one):
            text += f" {_LIMIT_WORDS[limit[1]].capitalize()} {limit[2]}."
        elif one.startswith("default: "):
            text += f" Default: `{one.removeprefix('default: ')}`."
    return text
