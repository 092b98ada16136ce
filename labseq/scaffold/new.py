"""`labseq new`: plugins, sequences and profiles that run at once.

A template of a plugin consists of sections, each begun by a line ``==> name <==``: ``about`` (what the
plugin does, in a sentence), the files, and ``use`` (the command that runs a sequence with it).
"""

from __future__ import annotations

import builtins
import keyword
import re
import shutil
import sys
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from string import Template
from typing import Final

from labseq import __version__
from labseq.config import find_profile, packaged_profiles_dir
from labseq.errors import ConfigError, Problem
from labseq.messages import clean, visible
from labseq.plugins import PluginHost
from labseq.scaffold.schemas import KINDS as FILE_KINDS, FileKind, refresh_schemas, schema_path, write_schema
from labseq.session import load_plugins

MAX_LENGTH: Final = 40

_PLUGIN: Final = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
_FILE: Final = re.compile(r"[A-Za-z][A-Za-z0-9]*([_-][A-Za-z0-9]+)*")
_YAML: Final = frozenset({"true", "false", "null"})
_OURS: Final = frozenset({"labseq", "labseq_local", "plugins", "conftest"})
_WINDOWS: Final = frozenset({"con", "prn", "aux", "nul"}) | {
    f"{p}{n}" for p in ("com", "lpt") for n in range(10)
}


def check_plugin_name(kind: str, name: str, package: str, host: PluginHost) -> None:
    """Refuse a name that a plugin cannot have, or that is taken.

    Args:
        kind: Kind of the plugin.
        name: Its name.
        package: Name of the Python package that it will be.
        host: The plugins that there are.

    Raises:
        ConfigError: With what would be right.
    """
    if not _PLUGIN.fullmatch(name) or len(name) > MAX_LENGTH:
        guess = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_0123456789")[:MAX_LENGTH]
        expected = (
            f"a lower-case word of at most {MAX_LENGTH} letters, digits and '_' that begins with a letter"
        )
        raise _refused(
            kind,
            name,
            "it is no name for a part of Python",
            expected,
            guess if _PLUGIN.fullmatch(guess) else "",
        )
    hint = f"my_{name}"
    if keyword.iskeyword(name) or hasattr(builtins, name):
        raise _refused(kind, name, "it is a word of Python itself", "another name", hint)
    if name in sys.stdlib_module_names or name in _OURS:
        raise _refused(kind, name, "a part of Python or labseq is called so", "another name", hint)
    if name in _WINDOWS:
        raise _refused(kind, name, "it is no name for a file on Windows", "another name", hint)
    _check_is_free(kind, name, package, host)


def _check_is_free(kind: str, name: str, package: str, host: PluginHost) -> None:
    called, hint = kind.replace("_", " "), f"my_{name}"
    entry = host.registry.find(kind, name)
    if entry is not None:
        what = f"the plugin '{entry.origin}' offers a {called} of that name"
        raise _refused(kind, name, what, "another name", hint)
    taken = next((info for info in host.infos if info.name == package), None)
    if taken is not None:
        what = f"there is a plugin '{package}' ({taken.origin})"
        raise _refused(kind, name, what, "another name", hint)
    if _is_installed(package):
        what = f"there is a Python package '{package}', which the plugin would hide"
        raise _refused(kind, name, what, "another name", hint)


def check_file_name(kind: str, name: str, profiles: Path) -> None:
    """Refuse a name that a sequence or profile cannot have.

    Args:
        kind: "sequence" or "profile".
        name: Its name, without an ending.
        profiles: Folder of the profiles that come with labseq.

    Raises:
        ConfigError: With what would be right.
    """
    if not _FILE.fullmatch(name) or len(name) > MAX_LENGTH:
        guess = re.sub(r"\.ya?ml$", "", name, flags=re.IGNORECASE)
        guess = re.sub(r"[^A-Za-z0-9]+", "_", guess).strip("_0123456789")[:MAX_LENGTH]
        expected = f"at most {MAX_LENGTH} letters, digits, '-' and '_', from a letter on, without an ending"
        raise _refused(
            kind, name, "it is no name for a file", expected, guess if _FILE.fullmatch(guess) else ""
        )
    if name.lower() in _WINDOWS:
        raise _refused(kind, name, "it is no name for a file on Windows", "another name", f"my_{name}")
    if name.lower() in _YAML:
        raise _refused(kind, name, "in YAML it is no text", "another name", f"my_{name}")
    if kind == "profile" and (profiles / f"{name}.yaml").exists():
        what = "a profile of that name comes with labseq, and yours would hide it"
        raise _refused(kind, name, what, "another name", f"my_{name}")


def _is_installed(package: str) -> bool:
    """Whether Python finds such a package; a mere folder of that name in the way does not count."""
    try:
        spec = find_spec(package)
    except (ImportError, ValueError):  # one that is loaded in an odd way
        return True
    return spec is not None and spec.origin is not None


def _refused(kind: str, name: str, why: str, expected: str, guess: str) -> ConfigError:
    called = kind.replace("_", " ")
    what = f"{'an' if called[0] in 'aeiou' else 'a'} {called} cannot be called '{clean(name)}': {why}"
    return ConfigError(Problem(what, expected=expected, hint=f"for example '{guess}'" if guess else ""))


_FOLDER: Final = "templates"
_SECTION: Final = re.compile(r"^==> (.+) <==\n", re.MULTILINE)


def read_template(name: str) -> str:
    """The text of a template.

    Args:
        name: Name of its file.
    """
    return (files("labseq.scaffolds") / _FOLDER / name).read_text(encoding="utf-8")


def filled(text: str, values: Mapping[str, str]) -> str:
    """A template with its words put in; a word that is missing is an error of ours.

    Example:
        >>> filled("class ${Name}Planner:", {"Name": "Spiral"})
        'class SpiralPlanner:'
    """
    return Template(text).substitute(values)


def plugin_sections(kind: str) -> dict[str, str]:
    """The sections of a plugin's template, not filled in, by their names."""
    _, *parts = _SECTION.split(read_template(f"{kind}.txt"))
    return dict(zip(parts[::2], parts[1::2], strict=True))


def class_prefix(name: str) -> str:
    """What the names of a plugin's classes begin with.

    Example:
        >>> class_prefix("my_spiral_2")
        'MySpiral2'
    """
    return "".join(word.capitalize() for word in name.split("_"))


PLUGINS: Final = "plugins"
"""Folder of the plugins, beside the sequences and profiles that name it."""
FIRST: Final = "first"
"""Name of the sequence that examples run."""
ENTRY_POINTS: Final = "labseq_"
"""What the names of plugins that are distributions of their own begin with."""

__all__ = ["FILE_KINDS", "CreatedFiles", "make_file", "make_plugin"]


@dataclass(frozen=True, slots=True)
class CreatedFiles:
    """What was made.

    Attributes:
        path: The file, or the plugin's folder.
        files: Every file of it, and further ones that were written for it.
        commands: What to do next, one command line each.
    """

    path: Path
    files: tuple[Path, ...]
    commands: tuple[str, ...]


def make_plugin(kind: str, name: str, folder: Path, *, package: bool = False) -> CreatedFiles:
    """Make a plugin that runs at once: the plugin, its settings, tests of its promises, a README.

    Args:
        kind: One of :data:`labseq.registry.KINDS`.
        name: Its name, for sequences and profiles.
        folder: Where sequences and profiles are; the plugin goes into ``plugins`` there.
        package: Whether to make it a distribution of its own, beside them.

    Raises:
        ConfigError: The name cannot be or is taken, or something cannot be written.
    """
    host = _plugins_of(folder)
    module = name if not package or name.startswith(ENTRY_POINTS) else f"{ENTRY_POINTS}{name}"
    check_plugin_name(kind, name, module, host)
    distribution = module.replace("_", "-")
    path = folder / distribution if package else folder / PLUGINS / name
    sections = plugin_sections(kind)
    source, tests = (f"src/{module}/", "tests/") if package else ("", "")
    where = path.relative_to(folder).as_posix()
    words = {
        "name": name,
        "Name": class_prefix(name),
        "kind": kind.replace("_", " "),
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
    use = filled(sections.pop("use"), words).strip()
    install = [f"pip install -e {where}"] if package else []
    commands = (*install, f"pytest {where}", f"labseq new sequence {FIRST}", use)
    texts = {"README.md": read_template("README.md"), **_placed(sections, source, tests)}
    if package:
        texts |= {"pyproject.toml": read_template("pyproject.txt"), f"{source}py.typed": ""}
    words["commands"] = "\n".join(commands)
    with _explained_errors(path):
        made = _write_folder(path, {filled(file, words): filled(text, words) for file, text in texts.items()})
        written = refresh_schemas(folder, _plugins_of(folder).registry)
    return CreatedFiles(path, (*made, *written), (*_missing_for_tests(), *_still_to_do(commands, folder)))


def make_file(kind: FileKind, name: str, folder: Path, *, profile: str = "virtual") -> CreatedFiles:
    """Make a sequence or a profile that runs at once, and the schema that editors read with it.

    Args:
        kind: "sequence" or "profile".
        name: Its name; the file is ``NAME.yaml``.
        folder: Where to.
        profile: Name of the profile that a sequence runs on.

    Raises:
        ConfigError: The name cannot be or is taken, there is no such profile, or something cannot be
            written.
    """
    host = _plugins_of(folder)
    check_file_name(kind, name, packaged_profiles_dir())
    find_profile(profile, folder)
    path = folder / f"{name}.yaml"
    text = filled(read_template(f"{kind}.yaml"), {"name": name, "profile": profile})
    further: list[Path] = []
    plugins, schema = folder / PLUGINS, schema_path(kind, folder)
    with _explained_errors(path):
        if path.exists():
            raise FileExistsError
    with _explained_errors(plugins):
        if not plugins.is_dir():
            further += _write_folder(plugins, {"README.md": read_template("plugins.md")})
    with _explained_errors(schema):
        further.append(write_schema(kind, folder, host.registry))
    with (
        _explained_errors(path),
        path.open("x", encoding="utf-8", newline="\n") as file,
    ):  # last: with it all is there
        file.write(text)
    commands = {
        "sequence": (f"labseq check {name}.yaml", f"labseq run {name}.yaml"),
        "profile": (f"labseq devices {name}", f"labseq new sequence {FIRST} --profile {name}"),
    }
    return CreatedFiles(path, (path, *further), commands[kind])


def _plugins_of(folder: Path) -> PluginHost:
    """The plugins that the files of a folder find.

    Raises:
        ConfigError: There is no such folder.
    """
    if not folder.is_dir():
        raise ConfigError(Problem("there is no such folder", visible(str(folder)), hint="make it first"))
    own = folder / PLUGINS
    return load_plugins([own] if own.is_dir() else [])


def _missing_for_tests() -> list[str]:
    """The command that installs what the tests of a plugin need, if it is not there."""
    is_there = all(find_spec(module) is not None for module in ("pytest", "hypothesis"))
    return [] if is_there else ['pip install "labseq[testing]"']


def _still_to_do(commands: Sequence[str], folder: Path) -> list[str]:
    """The commands without the one that makes the sequence of the examples, if there is one."""
    done = {f"labseq new sequence {FIRST}"} if (folder / f"{FIRST}.yaml").exists() else set[str]()
    return [command for command in commands if command not in done]


def _placed(sections: Mapping[str, str], source: str, tests: str) -> dict[str, str]:
    """The files of a plugin, each in its place."""
    return {f"{tests if file.startswith('test_') else source}{file}": text for file, text in sections.items()}


def _write_folder(path: Path, texts: Mapping[str, str]) -> list[Path]:
    """Write a folder that is there whole or not at all.

    Args:
        path: The folder.
        texts: Path of each file in it, with '/', and its text.

    Raises:
        OSError: Something is there already, or it cannot be written; nothing is left of it.
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
def _explained_errors(path: Path) -> Generator[None]:
    """Say of what the system refuses why."""
    try:
        yield
    except FileExistsError:
        hint = "choose another name, or remove it first"
        raise ConfigError(Problem("it exists already", visible(str(path)), hint=hint)) from None
    except OSError as error:
        what = f"it cannot be made: {error.strerror or error}"
        raise ConfigError(Problem(what, visible(str(path)))) from error
