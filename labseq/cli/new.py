"""``labseq new``: what was made, and what to do with it."""

from __future__ import annotations

from pathlib import Path

from labseq.cli.output import say
from labseq.config.wording import clean, did_you_mean, listing
from labseq.errors import ConfigError, Problem
from labseq.registry import KINDS
from labseq.scaffolds import FILE_KINDS, CreatedFiles, make_file, make_plugin


def make_new(kind: str, name: str, folder: Path, *, package: bool, profile: str | None) -> None:
    """Make it and say so.

    Args:
        kind: A kind of plugin, "sequence" or "profile".
        name: Its name.
        folder: Folder of the sequences and profiles.
        package: Whether a plugin shall be a distribution of its own.
        profile: Profile that a sequence runs on.

    Raises:
        ConfigError: The name cannot be or is taken, an option does not go with the kind, or something
            cannot be written.
    """
    if kind not in (*KINDS, *FILE_KINDS):
        known = (*KINDS, *FILE_KINDS)
        what = f"there is no kind '{clean(kind)}'"
        raise ConfigError(Problem(what, expected=listing(known), hint=did_you_mean(kind, known)))
    if package and kind in FILE_KINDS:
        raise ConfigError(Problem(f"--package does not go with a {kind}", hint="leave it out"))
    if profile is not None and kind != "sequence":
        raise ConfigError(Problem(f"--profile does not go with a {_called(kind)}", hint="leave it out"))
    if kind in KINDS:
        made = make_plugin(kind, name, folder, package=package)
    else:
        made = make_file(kind, name, folder, profile=profile or "virtual")
    say(*lines_of(kind, name, made))


def lines_of(kind: str, name: str, made: CreatedFiles) -> list[str]:
    """What is printed.

    Example:
        >>> lines_of("sequence", "a", Made(Path("a.yaml"), (Path("a.yaml"),), ("labseq run a.yaml",)))
        ['made the sequence a:', '  a.yaml', '', 'go on with', '  labseq run a.yaml']
    """
    files = [f"  {path}" for path in made.files]
    return [f"made the {_called(kind)} {name}:", *files, "", "go on with", *(f"  {c}" for c in made.commands)]


def _called(kind: str) -> str:
    return kind.replace("_", " ")
