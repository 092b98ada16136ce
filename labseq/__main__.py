"""``python -m labseq`` is ``labseq``."""

from __future__ import annotations

from labseq.cli import main

if __name__ == "__main__":
    main()
