"""`labseq new` and `labseq schema`: new files and plugins that run at once, and schemas for editors.

A template of a plugin consists of sections, each begun by a line ``==> name <==``. The sections are ``about``
(a sentence about the plugin), the files, and ``use`` (the command that runs a sequence with it).
"""

from __future__ import annotations

import builtins
import keyword
import re
import shutil
import sys
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from string import Template
from typing import Final

from labseq import __version__
from labseq.assembly.plugin_choice import load_plugins
from labseq.config.find import find_profile
from labseq.console.options import measurements
from labseq.console.output import say, write_text
from labseq.errors import ConfigError, Problem
from labseq.files import PLUGINS, packaged_profiles_dir, packaged_sequences_dir
from labseq.messages import clean, did_you_mean, install_hint, listing, visible
from labseq.plugins.host import PluginHost
from labseq.registry import Registry
from labseq.roles import ROLES
from labseq.scaffold.schemas import (
    KINDS as FILE_KINDS,
    SCHEMA_FOLDER,
    FileKind,
    schema_path,
    schema_text,
    write_schema,
)

MAX_LENGTH: Final = 40
"""Maximum length of a name."""
FIRST: Final = "first"
"""Name of the sequence that the examples run."""
PACKAGE_PREFIX: Final = "labseq_"
"""Beginning of the names of plugins with their own distribution."""

_PLUGIN_NAME: Final = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
_FILE_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9]*([_-][A-Za-z0-9]+)*")
_RESERVED: Final = frozenset({"labseq", "labseq_local", "plugins", "conftest"}) | sys.stdlib_module_names
_WINDOWS_DEVICES: Final = frozenset(
    {"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(10))}
)


@dataclass(frozen=True, slots=True)
class CreatedFiles:
    """The files that `labseq new` has created, and the next commands.

    Attributes:
        path: The file, or the plugin's folder.
        files: All files that were written.
        commands: The next command lines.
    """

    path: Path
    files: tuple[Path, ...]
    commands: tuple[str, ...]


def make_new(
    kind: str, name: str, folder: Path, *, package: bool, profile: str | None, like: str | None
) -> None:
    """Make a plugin, a sequence or a profile, and print its files and the next commands."""
    if kind not in (*ROLES, *FILE_KINDS):
        kinds = (*ROLES, *FILE_KINDS)
        what = f"there is no kind '{clean(kind)}'"
        raise ConfigError(Problem(what, expected=listing(kinds), hint=did_you_mean(kind, kinds)))
    if package and kind in FILE_KINDS:
        raise ConfigError(Problem(f"--package does not apply to a {kind}", hint="leave it out"))
    for option, value in (("--profile", profile), ("--like", like)):
        if value is not None and kind != "sequence":
            raise ConfigError(Problem(f"{option} does not apply to a {_called(kind)}", hint="leave it out"))
    if kind in FILE_KINDS:
        created = make_file(kind, name, folder, profile=profile or "virtual", like=like)
    else:
        created = make_plugin(kind, name, folder, package=package)
    say(*lines_of(kind, name, created))


def lines_of(kind: str, name: str, created: CreatedFiles) -> list[str]:
    """The printed lines about the new files.

    Example:
        >>> lines_of("sequence", "a", CreatedFiles(Path("a.yaml"), (Path("a.yaml"),), ("labseq run a.yaml",)))
        ['made the sequence a:', '  a.yaml', '', 'next:', '  labseq run a.yaml']
    """
    files = [f"  {path}" for path in created.files]
    return [f"made the {_called(kind)} {name}:", *files, "", "next:", *(f"  {c}" for c in created.commands)]


def _called(kind: str) -> str:
    return kind.replace("_", " ")


def make_plugin(kind: str, name: str, folder: Path, *, package: bool = False) -> CreatedFiles:
    """Make a plugin that runs at once, with settings, tests of its contract, and a README.

    Args:
        folder: Folder of sequences and profiles. The plugin goes into ``plugins`` there.
        package: Whether to make a distribution of its own, in ``folder``.

    Raises:
        ConfigError: The name is not allowed or taken, or a file cannot be written.
    """
    module = name if not package or name.startswith(PACKAGE_PREFIX) else f"{PACKAGE_PREFIX}{name}"
    check_plugin_name(kind, name, module, _plugins_of(folder))
    distribution = module.replace("_", "-")
    path = folder / distribution if package else folder / PLUGINS / name
    where = path.relative_to(folder).as_posix()
    sections = plugin_sections(kind)
    source, tests = (f"src/{module}/", "tests/") if package else ("", "")
    words = {
        "name": name,
        "Name": class_prefix(name),
        "kind": _called(kind),
        "kind_file": kind,
        "about": sections.pop("about").strip(),
        "home": f"{module}." if package else ".",
        "source": source,
        "tests": tests,
        "package": module,
        "distribution": distribution,
        "version": __version__,
        "sequence": f"{FIRST}.yaml",
    }
    install = [f"pip install -e {where}"] if package else []
    use = fill(sections.pop("use"), words).strip()
    commands = [*install, f"pytest {where}", f"labseq new sequence {FIRST}", use]
    words["commands"] = "\n".join(commands)

    texts = {"README.md": read_template("README.md")}
    texts |= {f"{tests if f.startswith('test_') else source}{f}": text for f, text in sections.items()}
    if package:
        texts |= {"pyproject.toml": read_template("pyproject.txt"), f"{source}py.typed": ""}
    with _reporting(path):
        made = _write_folder(path, {fill(file, words): fill(text, words) for file, text in texts.items()})
        schemas = _refresh_schemas(folder)
    return CreatedFiles(path, (*made, *schemas), _needed(commands, folder))


def _refresh_schemas(folder: Path) -> list[Path]:
    """Update the existing schemas of a folder, because there are other plugins now."""
    kinds: list[FileKind] = [kind for kind in FILE_KINDS if schema_path(kind, folder).is_file()]
    registry = _plugins_of(folder).registry if kinds else Registry()
    return [write_schema(kind, folder, registry) for kind in kinds]


def _needed(commands: list[str], folder: Path) -> tuple[str, ...]:
    """The commands, without making a sequence that exists, and with the installation of test tools."""
    has_sequence = (folder / f"{FIRST}.yaml").exists()
    can_test = all(find_spec(module) is not None for module in ("pytest", "hypothesis"))
    install = () if can_test else (install_hint("testing"),)
    return (*install, *(c for c in commands if not (has_sequence and c == f"labseq new sequence {FIRST}")))


def make_file(
    kind: FileKind, name: str, folder: Path, *, profile: str = "virtual", like: str | None = None
) -> CreatedFiles:
    """Make a sequence or a profile that runs at once, and the schema that editors read with it.

    Args:
        name: Its name. The file is ``NAME.yaml``.
        profile: The profile that a sequence names.
        like: Name of a measurement of labseq from which the sequence is made.

    Raises:
        ConfigError: The name is not allowed or taken, there is no such profile or measurement, or a file
            cannot be written.
    """
    host = _plugins_of(folder)
    check_file_name(kind, name, packaged_profiles_dir())
    find_profile(profile, folder)
    path, plugins, schema = folder / f"{name}.yaml", folder / PLUGINS, schema_path(kind, folder)
    if like is None:
        text = fill(read_template(f"{kind}.yaml"), {"name": name, "profile": profile})
    else:
        text = measurement_text(like, name, profile)
    further: list[Path] = []
    with _reporting(path):
        if path.exists():
            raise FileExistsError
    with _reporting(plugins):
        if not plugins.is_dir():
            further += _write_folder(plugins, {"README.md": read_template("plugins.md")})
    with _reporting(schema):
        further.append(write_schema(kind, folder, host.registry))
    with _reporting(path), path.open("x", encoding="utf-8", newline="\n") as file:
        file.write(text)
    commands = {
        "sequence": (f"labseq check {name}.yaml", f"labseq run {name}.yaml"),
        "profile": (f"labseq devices {name}", f"labseq new sequence {FIRST} --profile {name}"),
    }
    return CreatedFiles(path, (path, *further), commands[kind])


def measurement_text(like: str, name: str, profile: str) -> str:
    """The text of a packaged sequence for a measurement, with a new name and profile.

    Raises:
        ConfigError: There is no such sequence, or it fits nothing.
    """
    known = measurements("")
    if like not in known:
        what = f"there is no measurement '{clean(like)}' to begin with"
        raise ConfigError(Problem(what, "--like", expected=listing(known), hint=did_you_mean(like, known)))
    text = (packaged_sequences_dir() / f"{like}.yaml").read_text("utf-8")
    for key, value in (("name", name), ("profile", profile)):
        text = re.sub(rf"^{key}: .*$", f"{key}: {value}", text, count=1, flags=re.MULTILINE)
    head, _, _ = read_template("sequence.yaml").partition("\n")
    return fill(head, {}) + "\n" + text.replace(f"sequences/{like}.yaml", f"{name}.yaml")


def check_plugin_name(kind: str, name: str, package: str, host: PluginHost) -> None:
    """Refuse a name that is not allowed for a plugin, or is taken.

    Raises:
        ConfigError: The name cannot be used. The message suggests another name.
    """
    if not _PLUGIN_NAME.fullmatch(name) or len(name) > MAX_LENGTH:
        guess = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_0123456789")[:MAX_LENGTH]
        allowed = f"a lower-case word of at most {MAX_LENGTH} letters, digits and '_'"
        what = "it is not a valid name for a Python package"
        expected = f"{allowed} that begins with a letter"
        raise _name_error(kind, name, what, expected, guess if _PLUGIN_NAME.fullmatch(guess) else "")
    entry = host.registry.find(kind, name)
    taken = next((info for info in host.infos if info.name == package), None)
    reasons = (
        (keyword.iskeyword(name) or hasattr(builtins, name), "Python itself uses this word"),
        (name in _RESERVED, "a part of Python or labseq has this name"),
        (name in _WINDOWS_DEVICES, "Windows allows no file of this name"),
        (entry, f"the plugin '{entry and entry.origin}' offers a {_called(kind)} of that name"),
        (taken, f"there is a plugin '{package}' ({taken and taken.origin})"),
        (_is_installed(package), f"there is a Python package '{package}', which the plugin would hide"),
    )
    _refuse_if(reasons, kind, name)


def check_file_name(kind: str, name: str, profiles: Path) -> None:
    """Refuse a name that is not allowed for a sequence or profile.

    Raises:
        ConfigError: The name cannot be used. The message suggests another name.
    """
    if not _FILE_NAME.fullmatch(name) or len(name) > MAX_LENGTH:
        guess = re.sub(r"\.ya?ml$", "", name, flags=re.IGNORECASE)
        guess = re.sub(r"[^A-Za-z0-9]+", "_", guess).strip("_0123456789")[:MAX_LENGTH]
        expected = f"at most {MAX_LENGTH} letters, digits, '-' and '_', first a letter, without an ending"
        what = "it is not a valid file name"
        raise _name_error(kind, name, what, expected, guess if _FILE_NAME.fullmatch(guess) else "")
    reasons = (
        (name.lower() in _WINDOWS_DEVICES, "Windows allows no file of this name"),
        (name.lower() in ("true", "false", "null"), "YAML does not read it as text"),
        (
            kind == "profile" and (profiles / f"{name}.yaml").exists(),
            "a profile of that name comes with labseq, and yours would hide it",
        ),
    )
    _refuse_if(reasons, kind, name)


def _refuse_if(reasons: Iterable[tuple[object, str]], kind: str, name: str) -> None:
    for is_refused, why in reasons:
        if is_refused:
            raise _name_error(kind, name, why, "another name", f"my_{name}")


def _name_error(kind: str, name: str, why: str, expected: str, guess: str) -> ConfigError:
    called = _called(kind)
    what = f"{'an' if called[0] in 'aeiou' else 'a'} {called} cannot be called '{clean(name)}': {why}"
    return ConfigError(Problem(what, expected=expected, hint=f"for example '{guess}'" if guess else ""))


def _is_installed(package: str) -> bool:
    """Whether Python finds such a package. A plain folder of that name does not count."""
    try:
        spec = find_spec(package)
    except (ImportError, ValueError):  # it is loaded, but not by the import system
        return True
    return spec is not None and spec.origin is not None


def _plugins_of(folder: Path) -> PluginHost:
    """The plugins that the files of a folder can name.

    Raises:
        ConfigError: There is no such folder.
    """
    if not folder.is_dir():
        raise ConfigError(Problem("there is no such folder", visible(str(folder)), hint="make it first"))
    own = folder / PLUGINS
    host = load_plugins([own] if own.is_dir() else [])
    host.import_all()
    return host


def read_template(name: str) -> str:
    """The text of a template."""
    return (files("labseq.scaffold") / "templates" / name).read_text(encoding="utf-8")


def plugin_sections(kind: str) -> dict[str, str]:
    """The sections of a plugin's template by name, before their words are filled in."""
    _, *parts = re.split(r"^==> (.+) <==\n", read_template(f"{kind}.txt"), flags=re.MULTILINE)
    return dict(zip(parts[::2], parts[1::2], strict=True))


def fill(text: str, words: Mapping[str, str]) -> str:
    """Fill words into a template.

    Example:
        >>> fill("class ${Name}Planner:", {"Name": "Spiral"})
        'class SpiralPlanner:'
    """
    return Template(text).substitute(words)


def class_prefix(name: str) -> str:
    """The beginning of the names of a plugin's classes.

    Example:
        >>> class_prefix("my_spiral_2")
        'MySpiral2'
    """
    return "".join(word.capitalize() for word in name.split("_"))


def _write_folder(path: Path, texts: Mapping[str, str]) -> Iterable[Path]:
    """Write a folder completely or not at all.

    Raises:
        OSError: The folder exists already, or cannot be written.
    """
    if path.exists() or path.is_symlink():
        raise FileExistsError
    part = path.with_name(f".{path.name}.part")
    try:
        for name, text in texts.items():
            file = part / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8", newline="\n")
        part.rename(path)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    return [path / name for name in texts]


@contextmanager
def _reporting(path: Path) -> Generator[None]:
    """Report errors of the operating system as errors about a path."""
    try:
        yield
    except FileExistsError:
        hint = "choose another name, or remove it first"
        raise ConfigError(Problem("this already exists", visible(str(path)), hint=hint)) from None
    except OSError as error:
        what = f"this cannot be made ({error.strerror or error})"
        raise ConfigError(Problem(what, visible(str(path)))) from error


def print_schema(kind: str, output: Path | None, plugins: Sequence[Path] | None) -> None:
    """Write the schema to a file, or print it."""
    if kind not in FILE_KINDS:
        what = f"there is no schema of a '{clean(kind)}'"
        raise ConfigError(Problem(what, expected=listing(FILE_KINDS), hint=did_you_mean(kind, FILE_KINDS)))
    if plugins is None:
        plugins = [Path(PLUGINS)] if Path(PLUGINS).is_dir() else []
    host = load_plugins(plugins)
    host.import_all()
    text = schema_text(kind, host.registry)
    if output is None:
        say(text.rstrip())
        return
    if output.parent.name == SCHEMA_FOLDER:  # where new files refer to it
        with suppress(OSError):  # writing reports the error
            output.parent.mkdir(exist_ok=True)
    write_text(output, text)
    say(f"wrote {output}")
