"""The patterns keep the promises of target patterns."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
from labseq_patterns import (
    patterns as checkerboard,
    patterns as honeycomb,
    patterns as kagome,
    patterns as ring,
    patterns as settings,
    patterns as sierpinski,
)
from labseq_scans.pattern import InterleavedSettings, interleaved

from labseq import SiteGrid, TargetPattern
from labseq.builtin.patterns import BitmapSettings, CompactSettings, bitmap, compact
from labseq.testing import PatternContract

BLOCK = settings.BlockSettings(rows=7, cols=8)
PATTERNS: dict[str, Callable[[SiteGrid], TargetPattern]] = {
    "compact": partial(compact, CompactSettings(rows=5, cols=6)),
    "bitmap": partial(bitmap, BitmapSettings(sites=".#.\n###")),
    "kagome": partial(kagome.kagome, BLOCK),
    "link_kagome": partial(kagome.link_kagome, BLOCK),
    "honeycomb": partial(honeycomb.honeycomb, BLOCK),
    "checkerboard": partial(checkerboard.checkerboard, BLOCK),
    "sierpinski": partial(sierpinski.sierpinski, settings.SierpinskiSettings(order=3)),
    "ring": partial(ring.ring, settings.RingSettings(radius=4)),
    "interleaved": partial(interleaved, InterleavedSettings(rows=6, cols=6)),
}


@pytest.mark.parametrize("name", PATTERNS)
class TestPatterns(PatternContract):
    @pytest.fixture
    def factory(self, name: str) -> Callable[[SiteGrid], TargetPattern]:
        return PATTERNS[name]


def test_every_pattern_is_held_to_them() -> None:
    import labseq_patterns
    import labseq_scans

    import labseq.builtin
    from labseq.registry import Registry

    registry, modules = Registry(), (labseq.builtin, labseq_patterns, labseq_scans)
    for module in modules:
        plugin: Any = module
        plugin.labseq_register(registry)
    assert {*registry.names("pattern")} == {*PATTERNS}
