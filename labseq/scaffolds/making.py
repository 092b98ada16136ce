"""Writes what is new: whole or not at all, and never over something that is there."""

from __future__ import annotations

import shutil
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from labseq import __version__
from labseq.config import find_profile, packaged_profiles_dir
from labseq.config.file_schema import FileKind
from labseq.config.wording import visible
from labseq.errors import ConfigError, Problem
from labseq.plugins import PluginHost
from labseq.scaffolds.names import check_file_name, check_plugin_name
from labseq.scaffolds.schemas import KINDS as FILE_KINDS, refresh_schemas, schema_path, write_schema
from labseq.scaffolds.templates import class_prefix, filled, plugin_sections, read_template
from labseq.session import load_plugins

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
    with _explained_errors(path), path.open("x", encoding="utf-8", newline="\n") as file:  # last: with it all is there
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
