"""The command line and the live view: read the arguments, call the session, print, exit with a code."""

from labseq.cli.entry import main

__all__ = ["main"]
