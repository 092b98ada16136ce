"""The commands `labseq new`, `labseq schema` and `labseq explain`."""

from pathlib import Path
from typing import Annotated, Final

import typer

from labseq.console.options import Plugins, file_kinds, measurements, new_kinds, profile_names

NEW_EXAMPLES: Final = """\b
Examples:
  labseq new sequence first
  labseq new sequence my_rabi --like rabi
  labseq new planner spiral
  labseq new camera mycam --package
"""
SCHEMA_EXAMPLES: Final = """\b
Examples:
  labseq schema sequence -o .labseq/sequence.schema.json
  labseq schema profile --plugins my_plugins
"""
EXPLAIN_EXAMPLES: Final = """\b
Examples:
  labseq explain
  labseq explain step rearrange
  labseq explain profile.camera
  labseq explain psca
"""


def new(
    kind: Annotated[
        str,
        typer.Argument(
            metavar="KIND",
            help=f"What to make: {', '.join(new_kinds(''))}.",
            show_default=False,
            autocompletion=new_kinds,
        ),
    ],
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="Its name, for sequences and profiles.", show_default=False)
    ],
    package: Annotated[
        bool, typer.Option("--package", help="Make the plugin a Python package that can be installed.")
    ] = False,
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile",
            "-p",
            metavar="NAME|FILE",
            help="Profile that a new sequence runs on.",
            autocompletion=profile_names,
        ),
    ] = None,
    like: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="A measurement of labseq from which a new sequence is made, such as rabi, ramsey, "
            "lifetime, release_recapture or trap_depth.",
            autocompletion=measurements,
        ),
    ] = None,
    folder: Annotated[
        Path,
        typer.Option(
            metavar="DIR", help="Folder of your sequences and profiles. By default the current folder."
        ),
    ] = Path(),
) -> None:
    """Make a plugin, a sequence or a profile that runs at once.

    A plugin goes into the folder `plugins`, with its settings, the contract tests of its role and a README.
    New sequences and profiles load plugins from there. No existing file is changed, except schemas.
    """
    from labseq.scaffold.new import make_new

    make_new(kind, name, folder, package=package, profile=profile, like=like)


def schema(
    kind: Annotated[
        str,
        typer.Argument(
            metavar="KIND",
            help="Kind of file: sequence or profile.",
            show_default=False,
            autocompletion=file_kinds,
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="Write the schema to this file instead of stdout."
        ),
    ] = None,
    plugins: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR",
            help="Folder of plugins whose settings the schema includes. May be given several times. By "
            "default the folder plugins, if it exists.",
        ),
    ] = None,
) -> None:
    """Write the JSON schema of sequences or profiles for editors, with the settings of every plugin."""
    from labseq.scaffold.new import print_schema

    print_schema(kind, output, plugins)


def explain(
    context: typer.Context,
    what: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="WHAT",
            help="Words such as step image, profile.camera or psca. Without words, all topics are listed.",
            show_default=False,
        ),
    ] = None,
    _plugins: Plugins = None,
) -> None:
    """Explain a key of a file, a step, a plugin, a command, a quantity, an error or a unit.

    The text is as in the reference pages, including the installed plugins and those of --plugins.
    """
    from labseq.scaffold.reference import explain_topic

    explain_topic(" ".join(what or ()), context.find_root().command)
