"""A timing box with open firmware, on a serial line."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the lines ``ttl``, with a simulated box in a dry run."""
    simulated = {"port": "simulated", "start": "serial"}
    registry.lines(
        "ttl", "labseq_ttl.go_lines:ttl_lines", "labseq_ttl.settings:TtlSettings", simulated=simulated
    )
