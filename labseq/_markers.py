"""pluggy's markers under labseq's project name."""

from __future__ import annotations

from typing import Final

import pluggy

hookspec: Final = pluggy.HookspecMarker("labseq")
hookimpl: Final = pluggy.HookimplMarker("labseq")
