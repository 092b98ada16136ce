"""A timing box with open firmware, on a serial line."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the lines ``ttl``; in a dry run the box is simulated."""
    from labseq_ttl.go_lines import ttl_lines
    from labseq_ttl.settings import SIMULATED, TtlSettings

    registry.lines("ttl", ttl_lines, TtlSettings, simulated={"port": SIMULATED, "start": "serial"})
