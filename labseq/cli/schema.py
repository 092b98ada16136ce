"""``labseq schema``: JSON schema of the files, for editors."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from labseq.cli.files import write_text
from labseq.cli.output import say
from labseq.config.wording import clean, did_you_mean, listing
from labseq.errors import ConfigError, Problem
from labseq.scaffolds import FILE_KINDS, PLUGINS, SCHEMA_FOLDER, schema_text
from labseq.session import load_plugins


def write_schema(kind: str, output: Path | None, plugins: Sequence[Path] | None) -> None:
    """Write the schema to a file, or print it.

    Args:
        kind: "sequence" or "profile".
        output: The file; None prints it.
        plugins: Folders of plugins; None for the folder ``plugins``, if there is one.

    Raises:
        ConfigError: There is no such kind or folder, or the file cannot be written.
    """
    if kind not in FILE_KINDS:
        what = f"there is no schema of a '{clean(kind)}'"
        raise ConfigError(Problem(what, expected=listing(FILE_KINDS), hint=did_you_mean(kind, FILE_KINDS)))
    if plugins is None:
        plugins = [Path(PLUGINS)] if Path(PLUGINS).is_dir() else []
    text = schema_text(kind, load_plugins(plugins).registry)
    if output is None:
        say(text.rstrip())
        return
    if output.parent.name == SCHEMA_FOLDER:  # where new files look for it
        with suppress(OSError):  # the writing tells of it
            output.parent.mkdir(exist_ok=True)
    write_text(output, text)
    say(f"wrote {output}")
