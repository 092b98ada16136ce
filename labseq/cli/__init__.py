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
    from labseq.cli.main import USAGE_ERROR, arrange, end_process, refuse
    from labseq.console.errors import report
    from labseq.console.output import discard_unwritten, replace_unencodable

    arranged = arrange(sys.argv[1:] if arguments is None else arguments)
    replace_unencodable()
    try:
        code = app(args=arranged, prog_name="labseq", standalone_mode=False) or 0
    except SystemExit as leaving:
        code = leaving.code
    except USAGE_ERROR as error:
        code = refuse(error, arranged)
    except BaseException as error:  # noqa: BLE001 - the one place where a failure becomes an exit code
        code = report(error, debug="--debug" in arranged[:1])
    discard_unwritten()
    if arguments is None:
        end_process(code)
    sys.exit(code)
