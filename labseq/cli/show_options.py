"""The options of ``labseq show``."""

from __future__ import annotations

from typing import Annotated

import typer

Shots = Annotated[bool, typer.Option("--shots", help="A row for each shot, all of them.")]
Timing = Annotated[
    bool, typer.Option("--timing", help="A row for each stage of a shot: its budget, and what it took.")
]
Scan = Annotated[bool, typer.Option("--scan", help="A row for each point of the scan, all of them.")]
Devices = Annotated[bool, typer.Option("--devices", help="What each device said of itself.")]
