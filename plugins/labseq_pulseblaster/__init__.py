"""Lines on a PulseBlaster of SpinCore, through its library SpinAPI."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the lines ``pulseblaster``, with a simulated board in a dry run."""
    registry.lines(
        "pulseblaster",
        "labseq_pulseblaster.lines:PulseBlasterLines",
        "labseq_pulseblaster.settings:PulseBlasterSettings",
        simulated="labseq_pulseblaster.library:simulated_settings",
    )
