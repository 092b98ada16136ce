"""The command that comes first; its body is imported only when it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from labseq.cli.shared_options import Output


def demo(
    shots: Annotated[
        int | None, typer.Option(metavar="N", help="Number of shots; 10 by default.", show_default=False)
    ] = None,
    output: Output = None,
    copy: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Run nothing; copy the sequences and profiles that come with labseq there, to be changed.",
        ),
    ] = None,
) -> None:
    """Run a sequence that comes with labseq on its virtual lab: a first look, without any file."""
    if copy is None:
        from labseq.cli.demo import run_demo

        run_demo(shots, output)
        return
    if shots is not None or output is not None:
        raise typer.BadParameter("it runs nothing; leave out --shots and --output", param_hint="--copy")
    from labseq.cli.demo import copy_files

    copy_files(copy)
