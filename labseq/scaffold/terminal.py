"""`labseq new`, `labseq schema` and `labseq explain`: make files, print what is known."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from labseq.console.output import say, write_text
from labseq.errors import ConfigError, Problem
from labseq.files import PLUGINS
from labseq.messages import clean, did_you_mean, listing
from labseq.registry import KINDS
from labseq.scaffold.new import CreatedFiles, make_file, make_plugin
from labseq.scaffold.schemas import KINDS as FILE_KINDS, SCHEMA_FOLDER, schema_text
from labseq.session.chosen import load_plugins


def make_new(kind: str, name: str, folder: Path, *, package: bool, profile: str | None) -> None:
    """Make a plugin, a sequence or a profile, and print its files and what to do next."""
    if kind not in (*KINDS, *FILE_KINDS):
        known = (*KINDS, *FILE_KINDS)
        what = f"there is no kind '{clean(kind)}'"
        raise ConfigError(Problem(what, expected=listing(known), hint=did_you_mean(kind, known)))
    if package and kind in FILE_KINDS:
        raise ConfigError(Problem(f"--package does not apply to a {kind}", hint="leave it out"))
    if profile is not None and kind != "sequence":
        raise ConfigError(Problem(f"--profile does not apply to a {_called(kind)}", hint="leave it out"))
    if kind in KINDS:
        made = make_plugin(kind, name, folder, package=package)
    else:
        made = make_file(kind, name, folder, profile=profile or "virtual")
    say(*lines_of(kind, name, made))


def lines_of(kind: str, name: str, made: CreatedFiles) -> list[str]:
    """What is printed about the new files.

    Example:
        >>> lines_of("sequence", "a", CreatedFiles(Path("a.yaml"), (Path("a.yaml"),), ("labseq run a.yaml",)))
        ['made the sequence a:', '  a.yaml', '', 'next:', '  labseq run a.yaml']
    """
    files = [f"  {path}" for path in made.files]
    return [f"made the {_called(kind)} {name}:", *files, "", "next:", *(f"  {c}" for c in made.commands)]


def _called(kind: str) -> str:
    return kind.replace("_", " ")


def write_schema(kind: str, output: Path | None, plugins: Sequence[Path] | None) -> None:
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
