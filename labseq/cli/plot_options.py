"""The options of ``labseq plot``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

EXAMPLES = """\b
Examples:
  labseq plot --figure 5
  labseq plot data/2026-11-21/0003_figure5-multicycle --figure 5 -o figure5.pdf
  labseq plot data/2026-11-21/0004_figure4-dop-scan --figure 4 --compare data/2026-11-20/0007_figure4-dop-scan
"""

Figure = Annotated[
    str,
    typer.Option(
        metavar="4|5",
        help="4: filling against the degree of parallelism; 5: defect-free probability against the number of "
        "cycles.",
        show_default=False,
    ),
]
Output = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        metavar="FILE",
        help="A PNG, SVG or PDF file; figure-4.png or figure-5.png in the current folder if left out.",
    ),
]
Compare = Annotated[
    Path | None, typer.Option(metavar="RUN2", help="Another run, drawn into the same picture.")
]
