"""Target patterns: diluted triangular lattices, fractals, rings."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the patterns."""
    from labseq_patterns import (
        patterns as checkerboard,
        patterns as honeycomb,
        patterns as kagome,
        patterns as ring,
        patterns as settings,
        patterns as sierpinski,
    )

    registry.pattern("kagome", kagome.kagome, settings.BlockSettings)
    registry.pattern("link_kagome", kagome.link_kagome, settings.BlockSettings)
    registry.pattern("honeycomb", honeycomb.honeycomb, settings.BlockSettings)
    registry.pattern("checkerboard", checkerboard.checkerboard, settings.BlockSettings)
    registry.pattern("sierpinski", sierpinski.sierpinski, settings.SierpinskiSettings)
    registry.pattern("ring", ring.ring, settings.RingSettings)
