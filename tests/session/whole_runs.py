"""Whole runs in this process, on the virtual lab."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import labseq

ROOT = Path(__file__).parents[2]
COMPACT = ROOT / "sequences" / "compact_225.yaml"


def run(tmp_path: Path, sequence: Path = COMPACT, observer: Any = None, **options: Any) -> labseq.Run:
    with labseq.Session.open(sequence, output=tmp_path / "data", observer=observer, **options) as session:
        return session.run()
