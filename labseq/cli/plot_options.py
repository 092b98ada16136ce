"""The options of ``labseq plot``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

EXAMPLES = """\b
Examples:
  labseq plot
  labseq plot data/2026-11-21/0004_scan-dop --what scan -o scan.pdf
  labseq plot --shot 3
  labseq plot --shot 3 --cycle 1 -o first_cycle.svg
  labseq plot data/2026-11-21/0003_figure5 --figure 5 --compare data/2026-11-20/0007_figure5
"""

What = Annotated[
    str | None,
    typer.Option(
        metavar="PART",
        help="One part of the picture alone: filling, success, survival, defects, timing, scan or losses.",
    ),
]
Shot = Annotated[
    int | None,
    typer.Option(metavar="N", help="The images of a shot, with what was seen and the moves that followed."),
]
Cycle = Annotated[
    int | None,
    typer.Option(metavar="K", help="Of that shot only one cycle, large: the images before and after it."),
]
Figure = Annotated[
    str | None,
    typer.Option(
        metavar="4|5",
        help="A figure of the paper. 4: filling against the degree of parallelism; 5: defect-free "
        "probability against the number of cycles.",
    ),
]
Output = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        metavar="FILE",
        help="A PNG, SVG or PDF file; overview.png, shot-3.png, ... in the current folder if left out.",
    ),
]
Compare = Annotated[
    Path | None, typer.Option(metavar="RUN2", help="Another run, drawn into the same figure of the paper.")
]
