"""The command line and the live view: parse, call the session, print, exit code."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import NoReturn


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line; the console entry point.

    Args:
        arguments: Without the program's name; those of the process by default.

    Raises:
        SystemExit: Always, with the exit code.
    """
    from labseq.cli.app import app
    from labseq.cli.arguments import arrange
    from labseq.cli.failures import report
    from labseq.cli.output import forgive_encoding

    arranged = arrange(sys.argv[1:] if arguments is None else arguments)
    forgive_encoding()
    try:
        app(args=arranged, prog_name="labseq")
    except BaseException as error:  # the one place where a failure becomes an exit code
        if isinstance(error, SystemExit):
            raise
        sys.exit(report(error, debug="--debug" in arranged[:1]))
    sys.exit(0)
