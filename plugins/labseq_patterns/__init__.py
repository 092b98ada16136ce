"""Target patterns: diluted triangular lattices, fractals, rings."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the patterns."""
    for name, settings in (
        ("kagome", "BlockSettings"),
        ("link_kagome", "BlockSettings"),
        ("honeycomb", "BlockSettings"),
        ("checkerboard", "BlockSettings"),
        ("sierpinski", "SierpinskiSettings"),
        ("ring", "RingSettings"),
    ):
        registry.pattern(name, f"labseq_patterns.patterns:{name}", f"labseq_patterns.patterns:{settings}")
