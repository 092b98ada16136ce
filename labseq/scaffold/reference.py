"""The reference: every key, plugin, command, role, event and field of a file, as topics.

A topic is a list of blocks. :func:`plain` writes them for the terminal, docs/make_reference.py for the site.
The names of topics are words: ``step image``, ``profile grid spacing``, ``command bench planners``.
"""

from __future__ import annotations

import inspect
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from signal import SIGINT, SIGTERM
from typing import Any, Final, TypeAlias

from labseq import builtin, errors, hookspecs, roles
from labseq.assembly.plugin_choice import load_plugins
from labseq.config.profile import ProfileSpec
from labseq.config.scan import AdaptiveChoice
from labseq.config.sequence import DEFAULT_PLANNER, SequenceSpec
from labseq.console.errors import EXIT_CODES, exit_code_of
from labseq.console.output import say
from labseq.errors import ConfigError, LabseqError, Problem, StopRequested
from labseq.files import PLUGINS
from labseq.messages import clean, closest
from labseq.model.policies import StepPolicy
from labseq.registry import Entry, Registry
from labseq.roles import EVENTS, ROLES
from labseq.scaffold.printed import COLUMNS, ENVIRONMENT, OUTCOMES, STAGES
from labseq.scaffold.words import default_of, docstring, summary, value_of
from labseq.settings import Choice, Setting, SettingsType, has_settings, models_at, settings_of
from labseq.units import EXAMPLES, UNITS, unit_names


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of Markdown cells. The first cell of a row is its name, the last cell its meaning."""

    header: tuple[str, ...]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Definition:
    """A name or the signature of a function, and its text."""

    term: str
    text: str


@dataclass(frozen=True, slots=True)
class Code:
    """Lines to copy."""

    language: str
    text: str


Block: TypeAlias = str | Table | Definition | Code
"""A part of a topic. Text is Markdown with paragraphs and lists."""


@dataclass(frozen=True, slots=True, eq=False)
class Topic:
    """Something that can be looked up.

    Attributes:
        about: Its description, on one line.
        blocks: Makes its full text.
    """

    about: str
    blocks: Callable[[], list[Block]]


# How topics are written


def plain(blocks: Iterable[Block], width: int) -> list[str]:
    """Blocks as lines of a terminal."""
    return [line for block in blocks for line in (*_plain(block, width), "")][:-1]


def _plain(block: Block, width: int) -> list[str]:
    if isinstance(block, Table):
        return _plain_table(block, width)
    if isinstance(block, Definition):
        return [*_wrapped(block.term, width, "", "    "), *_plain_text(block.text, width, "    ")]
    return (
        _plain_text(block, width) if isinstance(block, str) else textwrap.indent(block.text, "  ").split("\n")
    )


def _plain_text(text: str, width: int, indent: str = "") -> list[str]:
    lines: list[str] = []
    for paragraph in text.split("\n\n"):
        is_list = paragraph.startswith("- ")
        parts = paragraph.split("\n") if is_list else [paragraph]
        lines += ["", *(line for one in parts for line in _wrapped(one, width, indent, "  " * is_list))]
    return lines[1:]


def _plain_table(table: Table, width: int) -> list[str]:
    """The name of each row, its meaning next to the name, and then the cells between them."""
    rows = [list(map(_unmarked, row)) for row in table.rows]
    room = min(max((len(row[0]) for row in rows), default=0), 26)
    lines: list[str] = []
    for name, *between, meaning in rows:
        titled = zip(table.header[1:], between, strict=False)
        facts = ", ".join(_fact(title, cell) for title, cell in titled if cell)
        about = f"{meaning} ({facts})" if facts and meaning else meaning or facts
        found = _wrapped(about, width, " " * (room + 4)) or [""]
        is_beside = len(name) <= room
        first = f"  {name}".ljust(room + 4) + found[0].lstrip() if is_beside else f"  {name}"
        lines += [first.rstrip(), *found[is_beside:]]
    return lines


def _fact(title: str, cell: str) -> str:
    if title != "default":
        return cell
    if cell.startswith("required"):
        return cell
    return "may be left out" if cell == "none" else f"default: {cell}"


def _wrapped(text: str, width: int, indent: str, hang: str = "") -> list[str]:
    clear = _unmarked(" ".join(text.split()))
    return textwrap.wrap(
        clear,
        max(width, 40),
        initial_indent=indent,
        subsequent_indent=indent + hang,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _unmarked(text: str) -> str:
    return re.sub(r"\[([^]]+)\]\([^)]+\)", r"\1", text).replace("`", "")


# Settings: files, and what plugins offer

FILES: Final[Mapping[str, SettingsType]] = {"sequence": SequenceSpec, "profile": ProfileSpec}
"""Kind of file -> its model."""
_PLUGIN_KINDS: Final = {"target": "pattern", "devices": "device", "shot": "step", "scan": "scanner"}
"""Key that names plugins -> their kind, if that is not the key itself."""
_ADDED_BY_LOADER: Final[Mapping[tuple[SettingsType | None, str], str]] = {
    (SequenceSpec, "planner"): f"`{{use: {DEFAULT_PLANNER}}}`",
    (SequenceSpec, "shots"): "required without `scan`",
}
"""Keys that the model needs but the loader can add -> their defaults, or when they are required."""
_KEY_HEADER: Final = ("key", "value", "default", "meaning")
_NO_SETTINGS: Final = "It takes no settings."


def settings(model: SettingsType | None, *, top: bool = False) -> Block:
    """A row per key. The keys of a mapping follow it as ``mapping.key``.

    Args:
        top: Leave out the keys of mappings.
    """
    rows = [_row(key, owner, setting) for key, owner, setting in _keys_of(model, top=top)]
    return Table(_KEY_HEADER, rows) if rows else _NO_SETTINGS


def _keys_of(
    model: SettingsType | None, *, top: bool = False, prefix: str = ""
) -> Iterator[tuple[str, SettingsType | None, Setting]]:
    """Every key of a model and of its mappings, with the model that owns it and its setting."""
    for setting in settings_of(model):
        key = prefix + setting.key
        yield key, model, setting
        inner = _inner_model(setting)
        if inner is not None and not top:
            yield from _keys_of(inner, prefix=f"{key}.NAME." if setting.is_by_name else f"{key}.")


def _inner_model(setting: Setting) -> SettingsType | None:
    """The model of a mapping. None for the choice of a plugin, which has its own settings."""
    return next((one for one in setting.models if not issubclass(one, Choice)), None)


def _row(key: str, owner: SettingsType | None, setting: Setting) -> tuple[str, ...]:
    is_mapping = has_settings(type(setting.default))
    default = "as below" if is_mapping else _ADDED_BY_LOADER.get((owner, key)) or default_of(setting)
    return f"`{key}`", value_of(setting), default, setting.description


def entry_blocks(entry: Entry) -> list[Block]:
    """The description, origin and settings of an entry of a plugin."""
    return [_about_entry(entry), settings(entry.settings_model)]


def _about_entry(entry: Entry) -> str:
    text = summary(entry.factory, entry.settings_model)
    return text if entry.origin == builtin.__name__ else f"{text} From the plugin `{entry.origin}`.".lstrip()


def units() -> list[Block]:
    """A row per dimension, with its units."""
    rows = [(one, f"`{EXAMPLES[one]}`", ", ".join(f"`{unit}`" for unit in unit_names(one))) for one in UNITS]
    return [Table(("quantity", "example", "units"), rows)]


def definition(function: Callable[..., Any], *, is_value: bool = False, name: str = "") -> Definition:
    """The signature and docstring of a function.

    Args:
        is_value: Whether it is a property.
        name: Name for calls, if it is not its own name.
    """
    signature = inspect.signature(function)
    arguments = [parameter for key, parameter in signature.parameters.items() if key != "self"]
    text = str(signature.replace(parameters=arguments)).replace("'", "").replace("Ellipsis", "...")
    called = f": {text.partition(' -> ')[2]}" if is_value else text.removesuffix(" -> None")
    return Definition((name or function.__name__) + called, docstring(function))


def public(module: Any, is_kind: Callable[[object], bool]) -> list[Any]:
    """The public objects of a module, or of a package with its modules, in the order of the source."""
    members = [
        member for name, member in vars(module).items() if is_kind(member) and not name.startswith("_")
    ]
    home = module.__name__
    return [
        member for member in members if member.__module__ == home or member.__module__.startswith(f"{home}.")
    ]


# Roles, hooks, errors, events


def roles_by_name() -> dict[str, type]:
    """Name -> role."""
    return {role_type.__name__: role_type for role_type in public(roles, inspect.isclass)}


def role(role_type: type) -> list[Block]:
    """The docstring of a role, and a definition per method."""
    shared = [base.__name__ for base in role_type.__bases__ if base.__name__ in roles_by_name()]
    blocks: list[Block] = [docstring(role_type)]
    blocks += [f"Everything that `{', '.join(shared)}` requires, and:"] if shared else []
    for member in vars(role_type).values():
        function = member.fget if isinstance(member, property) else member
        if inspect.isfunction(function) and not function.__name__.startswith("_"):
            blocks.append(definition(function, is_value=isinstance(member, property)))
    return blocks


def hooks() -> list[Block]:
    """A definition per hook."""
    return [definition(hook) for hook in public(hookspecs, inspect.isfunction)]


def errors_by_name() -> dict[str, type[LabseqError]]:
    """Name -> error, each after its base class."""

    def walk(error: type[LabseqError]) -> Iterator[type[LabseqError]]:
        yield error
        for kind in kinds_of(error):
            yield from walk(kind)

    return {error.__name__: error for error in walk(LabseqError)}


def error(error_type: type[LabseqError]) -> Definition:
    """An error, its fields and its exit code."""
    code = str(error_type.exit_code)
    if error_type is StopRequested:
        hang_up = 1  # Windows does not have this signal
        numbers = (hang_up, int(SIGINT), int(SIGTERM))
        code = ", ".join(str(exit_code_of(StopRequested(number))) for number in numbers)
    return Definition(error_type.__name__, f"{docstring(error_type)}\n\nExit code {code}.")


def kinds_of(error_type: type[LabseqError]) -> list[type[LabseqError]]:
    """The subclasses of an error."""
    return [kind for kind in error_type.__subclasses__() if kind.__module__ == errors.__name__]


def exit_codes() -> list[Block]:
    """A row per exit code."""
    return [Table(("code", "meaning"), [*EXIT_CODES.items()])]


def plan_rules() -> list[Block]:
    """The rules against which every plan is checked."""
    from labseq.motion import RULES

    return [_named("rule", RULES)]


def events() -> list[Block]:
    """A row per event of a run."""
    return [_named("event", EVENTS)]


def environment() -> list[Block]:
    """A row per environment variable."""
    return [_named("name", ENVIRONMENT)]


def _named(title: str, rows: Mapping[str, str]) -> Table:
    return Table((title, "meaning"), [(f"`{name}`", about) for name, about in rows.items()])


# The shot's file

_TYPES: Final = {"i2": "int16", "i4": "int32", "f8": "float64", "?": "bool"}


def datasets() -> list[Block]:
    """A row per dataset of a shot's file."""
    from labseq.recording.contents import datasets_of_file

    rows = [
        (f"`/entry/{one.path}`", one.dtype, one.axes, one.units, one.description)
        for one in datasets_of_file()
    ]
    return [Table(("path", "type", "axes", "unit", "description"), rows)]


def columns() -> list[Block]:
    """A table for each table of the file, with a row per column."""
    from labseq.recording import schema

    blocks: list[Block] = []
    for one in schema.TABLES:
        rows = [
            (f"`{of.name}`", _TYPES.get(of.dtype, of.dtype), of.units, of.description) for of in one.columns
        ]
        blocks += [f"`/entry/{one.path}`: {one.description}."]
        blocks += [Table(("column", "type", "unit", "description"), rows)]
    return blocks


def index_keys() -> list[Block]:
    """A row per value of a shot's record that is in the index."""
    from labseq.recording import schema

    rows = [(f"`{field.name}`", field.dtype, field.description) for field in schema.IN_INDEX]
    return [Table(("key", "type", "description"), rows)]


def quantities() -> list[Block]:
    """A row per quantity of a shot, which a scan can optimise and a policy can watch."""
    from labseq.data.columns import DESCRIPTIONS, GROUPS, QUANTITIES

    rows = {name: DESCRIPTIONS[name] for name in QUANTITIES}
    return [_named("quantity", rows | {f"{prefix}NAME": about for prefix, about in GROUPS.items()})]


def words() -> list[Block]:
    """Tables of the words that commands print."""
    return [_named("word", OUTCOMES), _named("word", STAGES), _named("word", COLUMNS)]


def fits() -> list[Block]:
    """A row per model for fitting a scan."""
    from labseq.data.fit_models import MODELS

    return [_named("fit", {name: model.formula for name, model in MODELS.items()})]


# Commands

_COMPARISONS: Final = {">=": "At least", "<=": "At most", ">": "More than", "<": "Less than"}


def command(names: Sequence[str], typer_command: Any) -> list[Block]:
    """Usage, arguments, options and examples of a command.

    Args:
        names: For example ["bench", "planners"]. Empty for the options of all commands.
        typer_command: The command, as typer sees it.
    """
    arguments = [param for param in typer_command.params if param.param_type_name == "argument"]
    options = [
        param for param in typer_command.params if param.param_type_name == "option" and not param.hidden
    ]
    usage = ["labseq", *names, *map(_argument_name, arguments)]
    usage += ["COMMAND", "..."] if hasattr(typer_command, "commands") else []
    usage += ["[OPTIONS]"] if options else []
    blocks: list[Block] = [Code("text", " ".join(usage)), typer_command.help]
    for title, spell, params in (("argument", _argument_name, arguments), ("option", _option_name, options)):
        rows = [(f"`{spell(param)}`", _meaning(typer_command, param)) for param in params]
        blocks += [Table((title, "meaning"), rows)] if rows else []
    examples = [line.strip() for line in (typer_command.epilog or "").splitlines() if "labseq " in line]
    return [*blocks, Code("console", "\n".join(examples))] if examples else blocks


def commands_below(group: Any, names: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command below the program or a group, with its names."""
    for name, subcommand in getattr(group, "commands", {}).items():
        yield (*names, name), subcommand
        yield from commands_below(subcommand, (*names, name))


def _argument_name(argument: Any) -> str:
    name = (argument.metavar or argument.name).strip("[]{}").upper()
    return name if argument.required else f"[{name}]"


def _option_name(option: Any) -> str:
    spellings = ", ".join(sorted([*option.opts, *option.secondary_opts], key=len))
    if option.is_flag or option.count:
        return spellings
    value = option.metavar or "VALUE"
    return spellings + value if value.startswith("[=") else f"{spellings} {value}"


def _meaning(typer_command: Any, parameter: Any) -> str:
    """The help with its limits and default in words."""
    import typer

    text: str = parameter.get_help_record(typer.Context(typer_command))[1]
    text, _, extra = text.rstrip("]").partition("  [")
    for note in filter(None, extra.split("; ")):
        if limit := re.fullmatch(r"x(>=|<=|>|<)(\S+)", note):
            text += f" {_COMPARISONS[limit[1]]} {limit[2]}."
        elif note.startswith("default: "):
            text += f" Default: `{note.removeprefix('default: ')}`."
    return text


# What can be looked up

_TABLES: Final[Mapping[str, tuple[str, Callable[[], list[Block]]]]] = {
    "unit": ("quantities and their units", units),
    "quantity": ("numbers of each shot, to plot, to optimise in a scan or to watch in a policy", quantities),
    "field": ("contents of a shot's HDF5 file, without /entry", datasets),
    "column": ("columns of the tables in a shot's HDF5 file", columns),
    "index": ("contents of a line of index.jsonl", index_keys),
    "event": ("events of a run, as in events.jsonl", events),
    "rule": ("rules against which every plan is checked", plan_rules),
    "exit": ("exit codes of the commands", exit_codes),
    "fit": ("models for the points of a scan", fits),
    "variable": ("environment variables", environment),
    "word": ("words that the commands print: heads of columns, names of rows, stages", words),
}
"""First word of topics -> their description, and a table with a row for each topic."""
_LISTED: Final = {
    "command": "the commands, with their arguments and options",
    "role": "the methods of a plugin's class, and their promises",
    "error": "the errors, with their fields",
}
"""First word of topics -> their description. Each is a separate topic."""


def topics(registry: Registry, program: Any) -> dict[str, Topic]:
    """Everything that can be looked up, by name.

    Args:
        registry: The loaded plugins.
        program: The command ``labseq``, as typer sees it.
    """
    by_name: dict[str, Topic] = {}
    for kind, model in FILES.items():
        by_name[kind] = Topic(f"the keys of a {kind}", partial(_blocks, settings, model, top=True))
        by_name |= _file_topics(kind, registry)
    for kind, group in groupby(registry.entries(), key=lambda entry: entry.kind):
        entries = list(group)
        by_name[kind] = Topic(", ".join(entry.name for entry in entries), partial(_offered, entries))
        for entry in entries:
            by_name[f"{kind} {entry.name}"] = Topic(_about_entry(entry), partial(entry_blocks, entry))
            by_name |= _key_topics((kind, entry.name), entry.settings_model)
    for name, (about, table) in _TABLES.items():
        by_name |= {name: Topic(about, table), **dict(_row_topics(name, table()))}
    core_topics = {
        f"role {name}": Topic(summary(kind), partial(role, kind)) for name, kind in roles_by_name().items()
    }
    core_topics |= {
        f"error {name}": Topic(summary(e), partial(_blocks, error, e)) for name, e in errors_by_name().items()
    }
    for names, subcommand in commands_below(program):
        about = subcommand.get_short_help_str(200)
        core_topics[f"command {' '.join(names)}"] = Topic(about, partial(command, names, subcommand))
    for name, about in _LISTED.items():
        rows = {
            key.partition(" ")[2]: topic.about
            for key, topic in core_topics.items()
            if key.startswith(f"{name} ")
        }
        by_name[name] = Topic(about, partial(_blocks, _named, name, rows))
    from labseq.scaffold.python_reference import python_topics

    return (
        by_name
        | core_topics
        | python_topics()
        | {"hook": Topic("functions of a plugin that labseq calls", hooks)}
    )


def _blocks(make: Callable[..., Block], *arguments: Any, **options: Any) -> list[Block]:
    return [make(*arguments, **options)]


def _offered(entries: Iterable[Entry]) -> list[Block]:
    return [_named("name", {entry.name: _about_entry(entry) for entry in entries})]


def _row_topics(name: str, blocks: Iterable[Block]) -> Iterator[tuple[str, Topic]]:
    """A topic for each row of the tables. If there are several, the path of a table is above it."""
    group = ""
    for block in blocks:
        if isinstance(block, str):
            group = block.partition("`: ")[0].rpartition("/")[2]
        elif isinstance(block, Table):
            for row in block.rows:
                words = (name, group, _unmarked(row[0]).removeprefix("/entry/"))
                topic = Topic(_unmarked(row[-1]), partial(_blocks, Table, block.header, [row]))
                yield " ".join(filter(None, words)), topic


def _key_topics(names: tuple[str, ...], model: SettingsType | None) -> dict[str, Topic]:
    return {
        " ".join((*names, *key.replace(".NAME", "").split("."))): Topic(
            setting.description, partial(_key_blocks, key, owner, setting)
        )
        for key, owner, setting in _keys_of(model)
    }


def _key_blocks(
    key: str, owner: SettingsType | None, setting: Setting, further: Iterable[Block] = ()
) -> list[Block]:
    """The row of a key, the rows of a mapping in it, and further blocks."""
    inner = _inner_model(setting)
    rows = [_row(key, owner, setting)]
    rows += [_row(f"{key}.{name}", model, nested) for name, model, nested in _keys_of(inner)]
    return [Table(_KEY_HEADER, rows), *further]


def _file_topics(kind: str, registry: Registry) -> dict[str, Topic]:
    """The keys of a file, with the available plugins for keys that name a plugin."""
    by_name = _key_topics((kind,), FILES[kind])
    for key, owner, setting in _keys_of(FILES[kind], top=True):
        plugin_kind = key if key in ROLES else _PLUGIN_KINDS.get(key, "")
        if not plugin_kind:
            continue
        models = [AdaptiveChoice] if key == "scan" else models_at(FILES[kind], (key,))
        by_name |= _key_topics((kind, key), next((m for m in models if issubclass(m, Choice)), None))
        further = partial(_choice_blocks, models, [e for e in registry.entries() if e.kind == plugin_kind])
        by_name[f"{kind} {key}"] = Topic(
            setting.description, lambda a=(key, owner, setting), more=further: _key_blocks(*a, more())
        )
    return by_name | _key_topics((kind, "shot", "policy"), StepPolicy if kind == "sequence" else None)


def _choice_blocks(models: Sequence[SettingsType], entries: Sequence[Entry]) -> list[Block]:
    """The keys next to the name of a plugin, and the plugins."""
    key_tables = [settings(model) for model in models if issubclass(model, Choice)]
    return [*key_tables, "The plugins, with their own settings:", *_offered(entries)]


def overview(by_name: Mapping[str, Topic], names: Iterable[str] | None = None) -> list[Block]:
    """A row for each of these topics, by default for topics with a name of one word."""
    shown = [name for name in by_name if " " not in name] if names is None else names
    return [_named("name", {name: by_name[name].about for name in shown})]


def find(by_name: Mapping[str, Topic], request: str) -> list[str]:
    """The names of the topics that a user means.

    Args:
        request: Words separated by spaces or dots, such as "step image", "profile.camera" or "psca".

    Returns:
        One name, or several if the words fit several names.

    Raises:
        ConfigError: There is no such topic.
    """
    words = _folded(request)
    folded = {_folded(name): name for name in by_name}
    if words in folded:
        return [folded[words]]
    ending = [name for key, name in folded.items() if words[-1:] == key[-1:] and _has_in_order(key, words)]
    begun = [name for key, name in folded.items() if len(key) == len(words) and _begins(key, words)]
    if ending or begun:
        return ending or begun
    near = closest(" ".join(words), (" ".join(key) for key in folded), None) or closest(
        words[-1] if words else "", (key[-1] for key in folded), None
    )
    hint = f"did you mean '{near}'?" if near else "`labseq explain` lists all topics"
    raise ConfigError(Problem(f"there is no topic '{clean(request)}' to explain", hint=hint))


def _has_in_order(key: tuple[str, ...], words: tuple[str, ...]) -> bool:
    rest = iter(key)
    return all(word in rest for word in words)


def _begins(key: tuple[str, ...], words: tuple[str, ...]) -> bool:
    return key[:-1] == words[:-1] and key[-1].startswith(words[-1])


def _folded(name: str) -> tuple[str, ...]:
    return tuple(name.lower().replace("-", "_").replace(".", " ").replace("/", " ").split())


def explain_topic(what: str, program: Any) -> None:
    """Print the explanation of a key, a plugin, a command, ... Without a name, print all topics.

    Args:
        program: The command ``labseq``, as typer sees it.

    Raises:
        ConfigError: There is no such topic.
    """
    host = load_plugins()
    host.import_all()
    left_out = [f"{info.origin} is not included; use --plugins {PLUGINS}" for info in host.unused()]
    left_out += [f"{info.name} did not load: {info.reason}" for info in host.infos if info.state == "failed"]
    by_name = topics(host.registry, program)
    width = min(shutil.get_terminal_size().columns, 110)
    try:
        names = find(by_name, what) if what else []
    except ConfigError:
        say(*left_out, stream=sys.stderr)
        raise
    if len(names) == 1:
        say(names[0], "", *plain(by_name[names[0]].blocks(), width))
    elif names:
        say(f"{what} can be:", "", *plain(overview(by_name, names), width))
    else:
        say(
            "labseq explain WHAT, for example labseq explain step image", "", *plain(overview(by_name), width)
        )
        say(*left_out, stream=sys.stderr)
